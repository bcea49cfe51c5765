"""Build a dataset: plan, stage in worker processes, write with LeRobot, finish, give the name.

Whatever happens, the output folder is either absent or complete: everything is made in a hidden
folder beside it and renamed at the end. An interrupted build goes on from its staged episodes.
"""

import dataclasses
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from robomme_interference_data.build_dataset.encode import Codec
from robomme_interference_data.build_dataset.finish import finish_dataset
from robomme_interference_data.build_dataset.locks import locked, work_folder
from robomme_interference_data.build_dataset.plan import (
    Plan,
    PlannedEpisode,
    Skipped,
    plan_dataset,
    select,
)
from robomme_interference_data.build_dataset.sources.base import Source, SourceEpisode
from robomme_interference_data.build_dataset.stage import (
    StagedEpisode,
    read_staged,
    stage_episode,
    stage_name,
)
from robomme_interference_data.build_dataset.writer import (
    load_lerobot,
    require_lerobot,
    write_dataset,
)
from robomme_interference_data.constants import FPS, IDENTITY_PATH
from robomme_interference_data.dataset import Dataset
from robomme_interference_data.errors import (
    BuildError,
    InterferenceError,
    InvalidOptionError,
    SourceError,
    nearest,
)
from robomme_interference_data.files import LocalFiles
from robomme_interference_data.progress import BuildProgress
from robomme_interference_data.workers import run_tasks

__all__ = ["BuildResult", "Filters", "Settings", "build_dataset"]


@dataclass(frozen=True)
class Filters:
    """Which episodes of the sources to take; None for all."""

    families: tuple[str, ...] | None = None
    split: str | None = None
    numbers: frozenset[int] | None = None


@dataclass(frozen=True)
class Settings:
    """How to build.

    Attributes:
        codec: Video settings.
        cameras: Cameras to store; None for all.
        version: Version of the dataset, e.g. `1.0.0`.
        workers: Processes that encode side by side.
        time_limit: Seconds that one episode may take before it is tried again, or None.
    """

    codec: Codec
    cameras: tuple[str, ...] | None = None
    version: str = "1.0.0"
    workers: int = 1
    time_limit: float | None = None


@dataclass(frozen=True)
class BuildResult:
    """What a build made.

    Attributes:
        out: The dataset.
        episodes: Stored episodes.
        frames: Stored frames.
        skipped: Episodes that yielded nothing.
        existed: Whether it had been built before.
    """

    out: Path
    episodes: int
    frames: int
    skipped: tuple[Skipped, ...]
    existed: bool


def build_dataset(
    kind: str,
    sources: Sequence[Source],
    out: Path,
    filters: Filters,
    settings: Settings,
    progress: BuildProgress,
) -> BuildResult:
    """Build demonstrations or distractor units as a LeRobot v3 dataset.

    Args:
        kind: `demonstrations` or `distractors`.
        sources: Where to read recorded episodes.
        out: Folder of the dataset; made by the build.
        filters: Which episodes to take.
        settings: How to build.
        progress: Where to show how far the build is.

    Raises:
        SourceError: The recordings cannot be used, or yield nothing.
        BuildError: `out` holds something else, another build of it is running, or episodes
            failed (those that succeeded are kept for the next attempt).
        InvalidOptionError: An option does not fit the sources.
        MissingExtraError: lerobot is not installed.
    """
    require_lerobot()
    out = out.resolve()  # a folder cannot be given the name of a link, or "."
    with progress.status("Listing episodes"):
        listed = [source.episodes() for source in sources]
    plan = _plan(kind, listed, filters, settings.cameras)
    existed = _is_built(out, plan, settings)
    if not existed:
        with locked(out) as work:
            existed = _is_built(out, plan, settings)  # another build may have ended just now
            if not existed:
                _make(work, plan, sources, settings, progress).rename(out)
    shutil.rmtree(work_folder(out), ignore_errors=True)
    frames = sum(len(item.indices) for item in plan.episodes)
    return BuildResult(out, len(plan.episodes), frames, plan.skipped, existed)


def _make(
    work: Path,
    plan: Plan,
    sources: Sequence[Source],
    settings: Settings,
    progress: BuildProgress,
) -> Path:
    """Make the dataset in the work folder, going on from what an earlier build left there."""
    cameras = _cameras(plan)
    staged = _stage_all(work / "episodes", plan, cameras, sources, settings, progress)
    episodes = list(zip(plan.episodes, staged, strict=True))
    with progress.status("Loading lerobot"):
        load_lerobot()
    made = work / "dataset"
    shutil.rmtree(made, ignore_errors=True)
    progress.start("Writing the LeRobot dataset", sum(item.length for item in staged))
    for count in write_dataset(made, plan.kind, episodes, cameras, settings.codec, FPS):
        progress.advance(count)
    with progress.status("Checking and hashing"):
        provenance = [source.provenance for source in sources]
        finish_dataset(
            made, plan.kind, settings.version, plan, episodes, settings.codec, provenance
        )
        os.sync()
    return made


def _cameras(plan: Plan) -> tuple[str, ...]:
    return tuple(sorted(plan.episodes[0].episode.cameras))


def _with_cameras(
    episodes: Sequence[SourceEpisode], cameras: tuple[str, ...] | None
) -> list[SourceEpisode]:
    """Reduce the episodes to the chosen cameras."""
    if cameras is None:
        return list(episodes)
    reduced = []
    for episode in episodes:
        for camera in cameras:
            if camera not in episode.cameras:
                raise InvalidOptionError(
                    f"--cameras {camera}: {episode.id} has no such camera",
                    nearest(camera, episode.cameras),
                )
        chosen = {camera: episode.cameras[camera] for camera in cameras}
        reduced.append(dataclasses.replace(episode, cameras=chosen))
    return reduced


def _plan(
    kind: str,
    listed: Sequence[Sequence[SourceEpisode]],
    filters: Filters,
    cameras: tuple[str, ...] | None,
) -> Plan:
    everything = [episode for episodes in listed for episode in episodes]
    selected = select(
        everything,
        families=filters.families,
        split=filters.split,
        numbers=filters.numbers,
    )
    chosen = {id(episode) for episode in selected}
    plan = plan_dataset(
        kind,
        [
            _with_cameras([episode for episode in episodes if id(episode) in chosen], cameras)
            for episodes in listed
        ],
    )
    if not plan.episodes:
        reasons = "; ".join(f"{item.episode_id}: {item.reason}" for item in plan.skipped[:5])
        raise SourceError(
            f"no episode yields {kind}: {len(everything)} listed, {len(selected)} selected"
            + (f", {len(plan.skipped)} unusable ({reasons})" if reasons else ""),
            "Check --families, --split and --episodes against the sources.",
        )
    return plan


def _stage_all(
    folder: Path,
    plan: Plan,
    cameras: tuple[str, ...],
    sources: Sequence[Source],
    settings: Settings,
    progress: BuildProgress,
) -> list[StagedEpisode]:
    """Stage all planned episodes that are not staged yet."""
    folders = [folder / stage_name(item, cameras, settings.codec) for item in plan.episodes]
    progress.start(
        f"Encoding {len(folders)} episodes", sum(len(item.indices) for item in plan.episodes)
    )
    tasks = []
    for item, place in zip(plan.episodes, folders, strict=True):
        if read_staged(place) is None:
            tasks.append((item, place))
        else:
            progress.advance(len(item.indices), before=True)
    failures: list[tuple[PlannedEpisode, BaseException]] = []
    function = partial(_stage_task, tuple(sources), cameras, settings.codec)
    outcomes = run_tasks(function, tasks, workers=settings.workers, time_limit=settings.time_limit)
    for outcome in outcomes:
        item = outcome.task[0]
        if outcome.error is None:
            progress.advance(len(item.indices))
        else:
            failures.append((item, outcome.error))
    if failures:
        raise _failure(failures, len(plan.episodes))
    staged = [read_staged(place) for place in folders]
    return [item for item in staged if item is not None]


def _stage_task(
    sources: tuple[Source, ...],
    cameras: tuple[str, ...],
    codec: Codec,
    task: tuple[PlannedEpisode, Path],
) -> None:
    planned, folder = task
    stage_episode(sources[planned.source], planned, cameras, codec, FPS, folder)


def _failure(
    failures: Sequence[tuple[PlannedEpisode, BaseException]], total: int
) -> InterferenceError:
    _item, error = failures[0]
    if len(failures) == 1 and isinstance(error, InterferenceError):
        return error
    lines = []
    for item, error in failures[:10]:
        name = f"{item.episode.id}: "
        lines.append(f"  {name}{str(error).splitlines()[0].removeprefix(name)}")
    more = f"\n  … and {len(failures) - 10} more" if len(failures) > 10 else ""
    return BuildError(
        f"{len(failures)} of {total} episodes failed:\n" + "\n".join(lines) + more,
        "The others are kept. Mend these or leave them out (--families, --episodes), then run the "
        "same command again.",
    )


def _is_built(out: Path, plan: Plan, settings: Settings) -> bool:
    """Tell whether the dataset is there already.

    Raises:
        BuildError: Something else is there.
    """
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return False
    advice = "Choose another --out, or remove the folder first."
    if not (out / IDENTITY_PATH).is_file():
        raise BuildError(f"{out} exists and is not a dataset of this package", advice)
    dataset = Dataset(LocalFiles(out))
    identity = dataset.identity
    found = (dataset.kind, identity["version"], identity["codec"], tuple(identity["cameras"]))
    wanted = (plan.kind, settings.version, settings.codec.name, _cameras(plan))
    if found != wanted:
        raise BuildError(
            f"{out} exists and was built otherwise: kind, version, codec and cameras are {found}, "
            f"not {wanted}",
            advice,
        )
    stored = [(record.id, record.length, record.raw_length) for record in dataset.records()]
    planned = [
        (item.episode.id, len(item.indices), item.episode.raw_length) for item in plan.episodes
    ]
    if stored != planned:
        raise BuildError(
            f"{out} exists and holds other episodes: {len(stored)} stored, {len(planned)} planned",
            advice,
        )
    return True
