"""Record episodes of a simulator in the `frames` layout: `--source tabletop`, `--source robomme`.

Every episode is played in a worker process that may hang or die; one that is recorded is not
played again. A recording is lossless, and the same on every machine that renders the same.
"""

import shutil
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from robomme_interference_data.build_dataset.encode import RECORDING, VideoEncoder
from robomme_interference_data.build_dataset.sources.base import Frame
from robomme_interference_data.build_dataset.sources.frames import FramesSource
from robomme_interference_data.constants import (
    DISTRACTORS,
    FAMILIES,
    FPS,
    IDENTITY_PATH,
    REPORT_PATH,
)
from robomme_interference_data.dataset import Dataset
from robomme_interference_data.errors import (
    BuildError,
    InvalidOptionError,
    UnknownNameError,
    nearest,
)
from robomme_interference_data.files import LocalFiles, atomic_path, read_json
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.simulators.base import CAMERAS, EpisodeInfo, Simulator, Status
from robomme_interference_data.simulators.registry import own_simulator
from robomme_interference_data.simulators.tabletop import SUITE_VERSION
from robomme_interference_data.simulators.tabletop.episodes import episode_ids
from robomme_interference_data.workers import run_tasks

__all__ = [
    "RecordedSource",
    "cameras_to_draw",
    "check_playable",
    "check_unbuilt",
    "list_episodes",
    "record_episodes",
    "recorded_from",
]

_PARTS = "parts"
_TABLE = "frames.parquet"

SCHEMA = pa.schema(
    [
        ("episode_id", pa.string()),
        ("frame_index", pa.int64()),
        ("state", pa.list_(pa.float32())),
        ("action", pa.list_(pa.float32())),
        ("is_demo", pa.bool_()),
        ("goal", pa.string()),
        ("seed", pa.int64()),
        ("difficulty", pa.string()),
        ("simulator", pa.string()),
    ]
)
"""Columns of the table in a frames folder, see docs/sources.md."""


class RecordedSource(FramesSource):
    """Episodes that were recorded from a simulator; datasets name the simulator as their source.

    Args:
        folder: Where they were recorded.
        simulator: Name of the simulator.
    """

    def __init__(self, folder: Path, simulator: str):
        super().__init__(folder)
        self.provenance = recorded_from(simulator)


def recorded_from(simulator: str) -> dict[str, Any]:
    """Return what a dataset records of a simulator that its episodes were played on.

    Of the tabletop that is its suite's version too: the same episode of another is another one.
    """
    if simulator == "tabletop":
        return {"kind": simulator, "suite_version": SUITE_VERSION}
    return {"kind": simulator}


def check_playable(simulator: str, kind: str) -> None:
    """Check that a simulator can play what a dataset of a kind needs.

    Raises:
        InvalidOptionError: Distractor units are wanted of RoboMME: they come from whole training
            episodes, and it has no policy that would play them.
    """
    if simulator == "robomme" and kind == DISTRACTORS:
        raise InvalidOptionError(
            "robomme plays demonstrations only, and distractor units need whole episodes",
            "Build the two datasets apart: build demonstrations --source robomme, and "
            "build distractors --source robomme-h5:DIR, from RoboMME's own training recordings.",
        )


def cameras_to_draw(wanted: Collection[str] | None) -> tuple[str, ...]:
    """Return the cameras that a recording needs where those of `wanted` are stored (None: all).

    A recording always has the front camera.

    Raises:
        UnknownNameError: Simulators have no such camera.
    """
    for camera in wanted or ():
        if camera not in CAMERAS:
            raise UnknownNameError(
                f"--cameras {camera}: simulators have no such camera", nearest(camera, CAMERAS)
            )
    return tuple(name for name in CAMERAS if wanted is None or name in {"front", *wanted})


def list_episodes(
    simulator: str,
    families: Sequence[str] | None,
    split: str | None,
    numbers: Collection[int] | None,
) -> list[EpisodeId]:
    """List the episodes that a simulator plays: RoboMME's numbers are those of the tabletop suite.

    Args:
        simulator: Name of the simulator.
        families: Task families; None for the nine that have demonstrations.
        split: `train`, `val` or `test`; None for all.
        numbers: Indices; None for all.

    Raises:
        UnknownNameError: There is no such family.
        InvalidIdError: There is no such split.
        InvalidOptionError: No episode is left.
    """
    for family in families or ():
        if family not in FAMILIES:
            raise UnknownNameError(
                f"{simulator} has no demonstrations of a family {family!r}",
                nearest(family, FAMILIES),
            )
    found = [
        episode
        for family in families or FAMILIES
        for episode in episode_ids(family, split)
        if numbers is None or episode.index in numbers
    ]
    if not found:
        raise InvalidOptionError(
            f"{simulator} has no episode of these numbers",
            "Expected 0 to 99 in train, 0 to 49 in val and test: give others with --episodes.",
        )
    return found


def record_episodes(
    simulator: str,
    episodes: Sequence[EpisodeId],
    folder: Path,
    *,
    live: bool,
    options: Mapping[str, Any] | None = None,
    workers: int = 1,
    time_limit: float | None = None,
) -> Iterator[EpisodeId]:
    """Record episodes; yields each when it is there.

    A worker that dies or exceeds the time limit is replaced, and its episode played once more.

    Args:
        simulator: Name of the simulator.
        episodes: Which episodes.
        folder: Frames folder, made or gone on with.
        live: Whether to go on after the demonstration, with the oracle until the episode ends;
            without, a recording ends with the first live observation.
        options: For the simulator, such as `cameras`. A folder holds recordings of one set.
        workers: Processes that play side by side.
        time_limit: Seconds that one episode may take, or None.

    Raises:
        BuildError: Episodes failed; all others are recorded.
    """
    missing = []
    for episode in episodes:
        if _part(folder, episode).is_file():
            yield episode
        else:
            missing.append(episode)
    failed = []
    function = partial(_record, simulator, dict(options or {}), live, folder)
    for outcome in run_tasks(function, missing, workers=workers, time_limit=time_limit):
        if outcome.error is None:
            yield outcome.task
        else:
            why = (str(outcome.error).splitlines() or [repr(outcome.error)])[0]
            failed.append(f"  {outcome.task}: {why} (started {outcome.attempts} times)")
    if failed:
        more = f"\n  … and {len(failed) - 10} more" if len(failed) > 10 else ""
        raise BuildError(
            f"{len(failed)} of {len(episodes)} episodes could not be recorded:\n"
            + "\n".join(failed[:10])
            + more,
            "The others are kept: run the same command again, or leave these out "
            "(--families, --episodes).",
        )
    parts = [pq.read_table(_part(folder, episode), schema=SCHEMA) for episode in sorted(episodes)]
    table = pa.concat_tables(parts)
    if table["action"].null_count == len(table):  # a simulator that does not tell them
        table = table.drop_columns(["action"])
    with atomic_path(folder / _TABLE) as partial_table:
        pq.write_table(table, partial_table)


def check_unbuilt(out: Path, kind: str, episodes: Sequence[EpisodeId], simulator: str) -> bool:
    """Tell whether a dataset has yet to be built, before any episode is played for it.

    Returns:
        True if nothing is at `out`, False if the dataset of these episodes is.

    Raises:
        BuildError: Something else is there.
    """
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return True
    if (out / IDENTITY_PATH).is_file():
        dataset = Dataset(LocalFiles(out))
        played = recorded_from(simulator)
        if dataset.kind == kind and played not in dataset.identity["sources"]:
            raise BuildError(
                f"{out} exists and was built from {dataset.identity['sources']}, not from {played}",
                "Choose another --out, or remove the folder first.",
            )
        stored = set(dataset.episodes["episode_id"].to_pylist())
        skipped = {item["episode_id"] for item in read_json(out / REPORT_PATH)["skipped"]}
        if dataset.kind == kind and stored | skipped == set(map(str, episodes)):
            return False
    raise BuildError(
        f"{out} exists and holds something else than the {kind} of these {len(episodes)} episodes",
        "Choose another --out, or remove the folder first.",
    )


def _part(folder: Path, episode: EpisodeId) -> Path:
    return folder / _PARTS / f"{episode}.parquet"


def _record(
    name: str, options: dict[str, Any], live: bool, folder: Path, episode: EpisodeId
) -> None:
    """Play and record one episode; its rows come last, and say that it is complete."""
    frames, info = _play(own_simulator(name, **options), episode, live)
    first = next(frames)
    partial_folder = folder / f".{episode.family}.{episode.split}.{episode.index}.partial"
    shutil.rmtree(partial_folder, ignore_errors=True)
    partial_folder.mkdir(parents=True)
    encoders = {
        camera: VideoEncoder(partial_folder / f"{camera}.mkv", RECORDING, FPS, *image.shape[:2])
        for camera, image in first.images.items()
    }
    rows: list[dict[str, Any]] = []
    for index, frame in enumerate((first, *frames)):
        for camera, encoder in encoders.items():
            encoder.add(frame.images[camera])
        rows.append(
            {
                "episode_id": str(episode),
                "frame_index": index,
                "state": frame.state,
                "action": frame.action,
                "is_demo": frame.is_demonstration,
                "goal": info.goal,
                "seed": info.seed,
                "difficulty": info.difficulty,
                "simulator": info.simulator,
            }
        )
    for camera, encoder in encoders.items():
        encoder.close()
        video = folder / "videos" / camera / f"{episode}.mkv"
        video.parent.mkdir(parents=True, exist_ok=True)
        (partial_folder / f"{camera}.mkv").replace(video)
    partial_folder.rmdir()
    with atomic_path(_part(folder, episode)) as part:
        pq.write_table(pa.Table.from_pylist(rows, schema=SCHEMA), part)


def _play(
    simulator: Simulator, episode: EpisodeId, live: bool
) -> tuple[Iterator[Frame], EpisodeInfo]:
    """Play an episode: its demonstration, the first live observation, and the oracle if `live`.

    RoboMME tells no actions of its demonstrations, and has no oracle: there they are None.
    """
    lesson, first, info = simulator.reset(str(episode))
    told = len(lesson.actions) == len(lesson)

    def frames() -> Iterator[Frame]:
        for index in range(len(lesson)):
            images = {camera: shown[index] for camera, shown in lesson.images.items()}
            action = lesson.actions[index] if told else None
            yield Frame(images, lesson.states[index], action, True)
        if not (told or live):
            yield Frame(first.images, first.state, None, False)
            return
        seen, status = first, Status.ONGOING
        while status is Status.ONGOING:
            action = np.asarray(simulator.act("oracle"), np.float32)
            yield Frame(seen.images, seen.state, action, False)
            if not live:
                return
            seen, status = simulator.step(action)

    return frames(), info
