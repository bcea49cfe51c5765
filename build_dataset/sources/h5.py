"""Source `robomme-h5`: official RoboMME recordings, `record_dataset_<Family>.h5`.

Layout (RoboMME, `doc/h5_data_format.md`, and the files themselves): `episode_<N>/setup/` with
seed, difficulty and goals; `episode_<N>/timestep_<T>/{obs,action,info}`. Numbers may start at 0 or
1, and keys come in text order, so both are sorted as numbers here. The observation at t is the one
after action t.
"""

import re
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, override

import h5py
import numpy as np

from robomme_interference_data.constants import OFFICIAL
from robomme_interference_data.errors import (
    InterferenceError,
    InvalidIdError,
    MissingFileError,
    SourceError,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.evidence import spans_of_texts
from robomme_interference_data.simulators.episode import choose_cameras
from robomme_interference_data.storage.text import check_not_pointer

from .base import Frame, Recording, Robot, Source, SourceEpisode, demonstration_length, file_state
from .episode_columns import parse_column
from .robomme_families import ROBOMME, ROBOT

_FILE = re.compile(r"record_dataset_(?P<family>.+)\.h5")
_CAMERAS = {"front": "front_rgb", "wrist": "wrist_rgb"}
_SUBGOALS = ("simple_subgoal", "grounded_subgoal")
_AGAIN = "Record or download the file again, or move it out of the folder."
_LOCKED = "unable to lock file"
_UNLOCK = (
    "Close the program that writes the file. If there is none, the disk, such as a network drive, "
    "may not support locks: set the environment variable HDF5_USE_FILE_LOCKING=FALSE."
)
_OTHER_ROBOT = (
    "Write recordings of another robot as a frames folder: docs/how-to/your-own-recordings.md."
)

_SEEDS = (("val", 1_000_000, 10_000), ("test", 500_000, 10_000), ("train", 0, 1000))
"""Of each split, its first seed, and what a family's code is multiplied by."""


def identify(family: str, seeds: dict[int, int | None]) -> dict[int, EpisodeId]:
    """Return the ids of the recordings in a file, by their numbers; `seeds` may be unknown.

    RoboMME's seeds are fixed: `1000·code + 100·index + attempt` in train, `10000·code + …` from
    500,000 on in test and from 1,000,000 on in val (its `env_metadata` folder; a few val seeds are
    100 higher). So a seed shows the split, and whether the file counts from 0 or 1. Without a seed
    the split is train.
    """
    known = ROBOMME.get(family)
    splits, votes = {}, []
    for number, seed in seeds.items():
        value = seed or 0
        splits[number], least, scale = next((s for s in _SEEDS if value >= s[1]), _SEEDS[-1])
        if seed is not None and known is not None:
            votes.append(number - (value - least - scale * known.code) // 100)
    first = 0
    if 0 not in seeds:  # else numbers are indices, regardless of seeds
        first = max((0, 1), key=lambda number: (votes.count(number), number in seeds))
    return {number: EpisodeId(family, splits[number], number - first) for number in seeds}


class H5Source(Source):
    """A folder of `record_dataset_<Family>.h5` files, or one such file."""

    def __init__(self, location: str):
        folder = Path(location).expanduser()
        self.provenance = {"kind": "robomme-h5"}
        candidates = [folder] if folder.is_file() else sorted(folder.glob("*.h5"))
        self._files = {
            match["family"]: path for path in candidates if (match := _FILE.fullmatch(path.name))
        }
        for family, path in self._files.items():
            try:
                EpisodeId(family, "train", 0)
            except InvalidIdError as error:
                raise InvalidIdError(
                    f"{path}: {error.message}",
                    "If it is a second download of a file, remove it; else name it after its "
                    "family: record_dataset_<Family>.h5.",
                ) from None
        if not self._files:
            raise SourceError(
                f"{folder} holds no record_dataset_<Family>.h5 file",
                f"Point to the folder of RoboMME's recordings: robomme-h5:FOLDER. {_OTHER_ROBOT}",
            )

    @override
    def episodes(self) -> list[SourceEpisode]:
        listed = []
        for family, path in self._files.items():
            with _opened(path) as file:
                numbers = _numbers(file, "episode_")
                if not numbers:
                    raise SourceError(
                        f"{path} holds no episode_<N> group", f"{_AGAIN} {_OTHER_ROBOT}"
                    )
                ids = identify(family, {n: _seed(file[f"episode_{n}"]) for n in numbers})
            key = str(path.resolve()), file_state(path)
            listed += [SourceEpisode(ids[n], (n, *key)) for n in numbers]
        return sorted(listed, key=lambda episode: episode.id)

    @override
    def read(self, episode: SourceEpisode, cameras: tuple[str, ...] | None) -> Recording:
        number, path, _ = episode.key
        official = episode.id.family in ROBOMME
        where = f"{path}: episode_{number}"
        with _opened(path) as file, _complete(where):
            group = file[f"episode_{number}"]
            steps = _numbers(group, "timestep_")
            if not steps or steps != list(range(steps[0], steps[0] + len(steps))):
                raise SourceError(f"{where} does not hold consecutive timestep_<T> groups", _AGAIN)
            flags = [group[f"timestep_{step}/info/is_video_demo"][()] for step in steps]
            lesson = demonstration_length(flags, f"is_video_demo in {where}")
            setup, first = group["setup"], group[f"timestep_{steps[0]}/obs"]
            available = tuple(camera for camera, name in _CAMERAS.items() if name in first)
            if not available:
                raise SourceError(f"{where} has no {' or '.join(_CAMERAS.values())}", _AGAIN)
            chosen = choose_cameras(cameras, available)
            texts = (_subgoal(group[f"timestep_{step}/info"]) for step in steps[:lesson])
            return Recording(
                goals=tuple(_text(goal) for goal in np.atleast_1d(setup["task_goal"][()])),
                seed=_seed(group),
                difficulty=_text(setup["difficulty"][()]) if "difficulty" in setup else None,
                # Other recordings in this layout do not state their rate, robot or simulator.
                simulator=OFFICIAL if official else None,
                exact=True,
                frames=_frames(path, number, steps, lesson, chosen),
                evidence=spans_of_texts(texts),
                action_first=True,
                robot=ROBOT if official else Robot(),
            )


@contextmanager
def _complete(where: object) -> Iterator[None]:
    """Turn what h5py raises about something missing or damaged into one clear error."""
    try:
        yield
    except InterferenceError:
        raise
    except (OSError, KeyError, ValueError, TypeError, AttributeError, RuntimeError) as error:
        if _LOCKED in str(error):
            raise SourceError(f"{where} is locked by another program: {error}", _UNLOCK) from None
        raise SourceError(f"{where} is not a complete RoboMME recording: {error}", _AGAIN) from None


@contextmanager
def _opened(path: str | Path) -> Iterator[h5py.File]:
    if not Path(path).is_file():
        raise MissingFileError(f"{path} does not exist", "Start again.")
    with _complete(path):
        check_not_pointer(Path(path))
        with h5py.File(path, "r") as file:
            yield file


def _frames(
    path: str, number: int, steps: list[int], lesson: int, cameras: tuple[str, ...]
) -> Generator[Frame]:
    with _opened(path) as file:
        for count, step in enumerate(steps):
            group = f"episode_{number}/timestep_{step}"
            with _complete(f"{path}: {group}"):
                observation = file[f"{group}/obs"]
                # The gripper has two fingers that move alike; RoboMME's own loaders keep the
                # first. `gripper_state` is float64 for some families, `joint_action` for all.
                gripper = np.atleast_1d(observation["gripper_state"][()])[:1]
                state = np.concatenate([observation["joint_state"][()][:7], gripper])
                frame = Frame(
                    images={camera: observation[_CAMERAS[camera]][()] for camera in cameras},
                    state=state.astype(np.float32),
                    action=file[f"{group}/action/joint_action"][()].astype(np.float32),
                    is_demonstration=count < lesson,
                )
            yield frame


def _numbers(group: h5py.Group, prefix: str) -> list[int]:
    suffixes = [key.removeprefix(prefix) for key in group if key.startswith(prefix)]
    return sorted(int(suffix) for suffix in suffixes if suffix.isdigit())


def _seed(group: h5py.Group) -> int | None:
    if "setup/seed" not in group:
        return None
    value = np.asarray(group["setup/seed"][()]).item()
    seed: int | None = parse_column("seed", _text(value) if isinstance(value, bytes) else value)
    return seed


def _subgoal(info: h5py.Group) -> str:
    name = next((key for key in _SUBGOALS if key in info), None)
    return _text(info[name][()]) if name else ""


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)
