"""Build a dataset: list, stage with an executor, write with LeRobot, complete, give the name.

Whatever happens, the output folder is either absent or complete: everything is made in a hidden
folder beside it and renamed at the end. An interrupted build goes on from its staged episodes. A
dataset that is there grows by the episodes that it lacks: those that it has are neither read nor
encoded again.
"""

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from robomme_interference_data.build_dataset.identity import complete_dataset
from robomme_interference_data.build_dataset.lerobot_writer import (
    load_lerobot,
    require_lerobot,
    write_lerobot,
)
from robomme_interference_data.build_dataset.sources import Source, SourceEpisode
from robomme_interference_data.build_dataset.stage import StagedEpisode, StageTask, read_staged
from robomme_interference_data.build_dataset.stored import (
    Earlier,
    EarlierEpisode,
    NewEpisode,
    read_earlier,
)
from robomme_interference_data.console import WorkProgress
from robomme_interference_data.constants import ACTION, IDENTITY_PATH
from robomme_interference_data.encode import get_codec
from robomme_interference_data.errors import (
    BuildError,
    InterferenceError,
    InvalidOptionError,
    MissingExtraError,
    SourceError,
    first_line,
)
from robomme_interference_data.execution import Executor, Outcome
from robomme_interference_data.files import hold

__all__ = ["BuildPlan", "BuildResult", "build_dataset", "work_folder"]

Stored = NewEpisode | EarlierEpisode
_ADVICE = "Choose another --out, or remove the folder first."


@dataclass(frozen=True)
class BuildPlan:
    """What to build, and how.

    Attributes:
        kind: `demonstrations` or `distractors`.
        sources: Where to read.
        tasks: The episodes to store: number of the source, and episode.
        cameras: Cameras to store; None for all.
        codec: Name of the video settings.
        version: Version of the dataset.
        time_limit: Seconds that one episode may take; None for the sources' own.
    """

    kind: str
    sources: tuple[Source, ...]
    tasks: tuple[tuple[int, SourceEpisode], ...]
    cameras: tuple[str, ...] | None = None
    codec: str = "av1-lossless"
    version: str = "1.0.0"
    time_limit: float | None = None


@dataclass(frozen=True)
class BuildResult:
    """What a build made.

    Attributes:
        out: The dataset.
        episodes: Stored episodes.
        frames: Stored frames.
        added: How many of the episodes are new.
        skipped: Ids of episodes that yielded nothing, and why.
    """

    out: Path
    episodes: int
    frames: int
    added: int
    skipped: dict[str, str] = field(default_factory=dict)


def build_dataset(
    plan: BuildPlan, out: Path, executor: Executor, progress: WorkProgress
) -> BuildResult:
    """Build demonstrations or distractor units as a LeRobot v3 dataset, or let one grow.

    Args:
        plan: What to build.
        out: Folder of the dataset; made by the build.
        executor: Who stages the episodes.
        progress: Where to show how far the build is.

    Raises:
        SourceError: The recordings cannot be used, or yield nothing.
        BuildError: `out` holds something else, another build of it is running, or episodes
            failed (those that succeeded are kept for the next attempt).
        InvalidOptionError: An option does not fit the sources.
        MissingExtraError: lerobot is not installed.
    """
    require_lerobot()
    get_codec(plan.codec)
    out = out.resolve()  # a folder cannot be given the name of a link, or "."
    with _working(out) as work:
        earlier = _earlier(out, plan)
        known = earlier.ids() if earlier else set()
        stored: list[Stored] = list(earlier.episodes) if earlier else []
        skipped = dict(earlier.skipped) if earlier else {}
        todo = [task for task in plan.tasks if task[1].id not in known]
        if todo or not earlier:
            staged, more = _stage(work, plan, todo, executor, progress)
            stored += staged
            skipped |= more
            _write(work, out, plan, earlier, stored, skipped, progress)
        shutil.rmtree(work, ignore_errors=True)
    frames = sum(episode.length for episode in stored)
    added = sum(isinstance(episode, NewEpisode) for episode in stored)
    return BuildResult(out, len(stored), frames, added, skipped)


# --- what is there already ---------------------------------------------------------------------


def _earlier(out: Path, plan: BuildPlan) -> Earlier | None:
    """Return the dataset that is there; None if nothing is.

    Raises:
        BuildError: Something else is there, or it was built otherwise.
    """
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return None
    if not (out / IDENTITY_PATH).is_file():
        raise BuildError(f"{out} exists and is not a dataset of this package", _ADVICE)
    earlier = read_earlier(out)
    identity = earlier.dataset.identity
    cameras = tuple(sorted(plan.cameras)) if plan.cameras is not None else identity.cameras
    found = (identity.kind, identity.version, identity.codec, identity.cameras)
    wanted = (plan.kind, plan.version, plan.codec, cameras)
    if found != wanted:
        raise BuildError(
            f"{out} exists and was built otherwise: kind, version, codec and cameras are {found}, "
            f"not {wanted}",
            _ADVICE,
        )
    # Of a simulator, the same episode of another version is another one.
    told = {one.get("kind"): one for one in identity.sources}
    for source in plan.sources:
        before = told.get(source.provenance["kind"], source.provenance)
        if "suite_version" in before and before != source.provenance:
            raise BuildError(
                f"{out} exists and was built from {before}, not from {source.provenance}", _ADVICE
            )
    return earlier


def work_folder(out: Path) -> Path:
    """Return the hidden folder beside `out` in which `out` is made."""
    return out.parent / f".{out.name}.building"


@contextmanager
def _working(out: Path) -> Iterator[Path]:
    """Make the work folder of `out` and hold it; put back what a killed build had moved there.

    It goes unless episodes are staged in it.
    """
    work = work_folder(out)
    work.mkdir(parents=True, exist_ok=True)
    busy = BuildError(f"another build of {out} is running", "Wait for it to end, or stop it.")
    with hold(work / "lock", busy):
        if (work / "before").exists() and not out.exists():
            (work / "before").rename(out)
        try:
            yield work
        finally:
            if not any(work.glob("*/[!.]*")):
                shutil.rmtree(work, ignore_errors=True)


# --- stage and write ---------------------------------------------------------------------------


def _stage(
    work: Path,
    plan: BuildPlan,
    todo: Sequence[tuple[int, SourceEpisode]],
    executor: Executor,
    progress: WorkProgress,
) -> tuple[list[NewEpisode], dict[str, str]]:
    """Stage episodes; return those that yield something, and why the others do not.

    Raises:
        BuildError, SourceError: Episodes failed, or do not fit together; the others are kept.
    """
    task = StageTask(
        plan.kind, plan.sources, plan.cameras, get_codec(plan.codec), work / "episodes"
    )
    limits = [source.time_limit for source in plan.sources]
    limit = plan.time_limit or max(limits)
    staged: list[StagedEpisode] = []
    missing = []
    progress.start("Reading and encoding", len(todo))
    for one in todo:
        done = read_staged(task.place(one))
        if done is None:
            missing.append(one)
        else:
            staged.append(done)
            progress.advance(1, before=True)
    failures: list[Outcome] = []
    first = next((one for one in staged if one.staged.skipped is None), None)
    # Closed before anybody looks at what is staged: an error would keep the workers running.
    with closing(executor.run(task, missing, time_limit=limit)) as outcomes:
        for outcome in outcomes:
            if outcome.error is not None:
                failures.append(outcome)
                if isinstance(outcome.error, InvalidOptionError | MissingExtraError):
                    break  # the others will say the same
                continue
            staged.append(outcome.value)
            progress.advance(1)
            if outcome.value.staged.skipped is None:
                first = first or outcome.value
                _check_alike(first, outcome.value)
    if failures:
        raise _failure(failures, len(todo))
    skipped = {str(one.staged.episode_id): one.staged.skipped for one in staged}
    kept = [NewEpisode(one) for one in staged if one.staged.skipped is None]
    return kept, {name: why for name, why in skipped.items() if why is not None}


def _check_alike(first: StagedEpisode, other: StagedEpisode) -> None:
    """Check that two episodes can be in one dataset; one may lack actions."""
    shown = [
        {name: shape for name, shape in one.staged.features.items() if name != ACTION}
        for one in (first, other)
    ]
    actions = {
        one.staged.features[ACTION] for one in (first, other) if ACTION in one.staged.features
    }
    if shown[0] != shown[1] or len(actions) > 1:
        raise SourceError(
            f"{first.staged.episode_id} and {other.staged.episode_id} cannot be in one dataset: "
            f"their features are {first.staged.features} and {other.staged.features}",
            "Choose cameras that all have with --cameras, or build the sources apart.",
        )


def _failure(failures: Sequence[Outcome], total: int) -> InterferenceError:
    error = failures[0].error
    if len(failures) == 1 and isinstance(error, InterferenceError):
        return error
    lines = []
    for outcome in failures[:10]:
        _, episode = outcome.task
        why = first_line(outcome.error).removeprefix(f"{episode.id}: ")  # type: ignore[arg-type]
        lines.append(f"  {episode.id}: {why} (started {outcome.attempts} times)")
    more = f"\n  … and {len(failures) - 10} more" if len(failures) > 10 else ""
    return BuildError(
        f"{len(failures)} of {total} episodes failed:\n" + "\n".join(lines) + more,
        "The others are kept. Mend these or leave them out (--families, --episodes), then run the "
        "same command again.",
    )


def _write(
    work: Path,
    out: Path,
    plan: BuildPlan,
    earlier: Earlier | None,
    stored: Sequence[Stored],
    skipped: dict[str, str],
    progress: WorkProgress,
) -> None:
    """Write the whole dataset in canonical order, and give it its name."""
    if not stored:
        reasons = "; ".join(f"{name}: {why}" for name, why in list(skipped.items())[:5])
        raise SourceError(
            f"no episode yields {plan.kind}: {len(skipped)} unusable ({reasons})",
            "Check --families, --split and --episodes against the sources.",
        )
    ordered = sorted(stored, key=lambda one: one.episode_id.sort_key)
    shapes = [one.features for one in ordered]
    # Actions are kept only where all episodes have them: buffers do not show them.
    kept = all(ACTION in one for one in shapes)
    alike = [{n: s for n, s in one.items() if kept or n != ACTION} for one in shapes]
    features = alike[0]
    if any(one != features for one in alike):
        raise BuildError(f"{out} has episodes of other sizes than those to be added", _ADVICE)
    with progress.status("Loading lerobot"):
        load_lerobot()
    made = work / "dataset"
    shutil.rmtree(made, ignore_errors=True)
    progress.start("Writing the LeRobot dataset", len(ordered))
    for _ in write_lerobot(made, plan.kind, ordered, features, get_codec(plan.codec)):
        progress.advance(1)
    records = [one.record(index, tuple(features)) for index, one in enumerate(ordered)]
    told: list[dict[str, Any]] = list(earlier.dataset.identity.sources) if earlier else []
    for source in plan.sources:
        if source.provenance not in told:
            told.append(source.provenance)
    with progress.status("Hashing"):
        complete_dataset(made, plan.kind, plan.version, records, plan.codec, told, skipped)
        os.sync()
    if out.exists():
        out.rename(work / "before")  # put back by the next build, should this one end here
    made.rename(out)
