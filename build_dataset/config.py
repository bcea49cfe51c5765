"""The settings of a build."""

import dataclasses
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from robomme_interference_data.constants import (
    DATASETS,
    MANIFESTS,
    OPTIONAL_DATASETS,
    POSITION_LIMIT,
    UNIT_FRAMES,
    UNIT_STRIDE,
    Unit,
)
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.runtime.executor import WorkersConfig
from robomme_interference_data.runtime.memory import fitting_workers
from robomme_interference_data.schema.conditions import DEFAULT_CONDITIONS
from robomme_interference_data.schema.settings import (
    PYTHON_HELP,
    PYTHON_SHOWN,
    SETTING,
    SIMULATOR_OPTION_HELP,
    setting,
)

QUESTIONS = "questions"

FURTHER_PARTS = (*OPTIONAL_DATASETS, QUESTIONS)
"""Parts of a buffer set that it may lack."""

PARTS = (*DATASETS, MANIFESTS, QUESTIONS)
"""Parts of a buffer set, in the order of their build."""


NO_CAMERAS = ("none",)
"""Setting of `cameras` for a dataset without images: simulators then render nothing."""


def chosen_cameras(setting: tuple[str, ...]) -> tuple[str, ...] | None:
    """Return the cameras that the setting `cameras` chooses, sorted; None for all."""
    if setting == NO_CAMERAS:
        return ()
    return tuple(sorted(setting)) or None


@dataclass(frozen=True, kw_only=True)
class FittingWorkersConfig(WorkersConfig):
    """Settings of workers, by default as many as this machine has cores and memory for."""

    workers: int | None = setting(  # type: ignore[assignment]  # None until `fitting`
        None,
        help="Worker processes.",
        metavar="N",
        shown="all CPUs, as far as memory suffices for that many simulators",
        group="Execution",
    )

    def fitting(self, worker_gb: float) -> Self:
        """Return the settings with the number of workers, each of which takes so many GB."""
        if self.workers is not None:
            return self
        return dataclasses.replace(self, workers=fitting_workers(worker_gb))


@dataclass(frozen=True)
class BuildConfig(FittingWorkersConfig):
    """Settings of a build: of a whole buffer set, or of one part of it."""

    buffer_set: Path = setting(
        name="-", metavar="BUFFER_SET", help="Folder of the buffer set to create or extend."
    )
    source: tuple[str, ...] = setting(
        (),
        whole=True,
        metavar="SOURCE",
        help="robomme-h5:FOLDER, lerobot:FOLDER, lerobot:NAMESPACE/NAME[/FOLDER][@REVISION], "
        "frames:FOLDER, tabletop, tabletop-day[:TASKS], robomme, MODULE:CLASS of your simulator "
        "or sample[:FAMILY,…]; repeat for several.",
    )
    parts: tuple[str, ...] = setting(
        (),
        name="--with",
        metavar="PART,…",
        help=f"Parts to build beside those that the conditions need: {', '.join(FURTHER_PARTS)}.",
        group="Parts",
    )
    only: str | None = setting(
        None,
        metavar="PART",
        help=f"Build one part alone: {', '.join(PARTS)}.",
        shown="demonstrations, distractors, what conditions need, manifests",
        group="Parts",
    )
    demonstrations: str | None = setting(
        None,
        metavar="NAME",
        help="Use published demonstrations, NAMESPACE/NAME[@REVISION], or a copy of those in a "
        "folder: builds units and manifests for them.",
        group="Parts",
    )
    families: tuple[str, ...] = setting(
        (), help="Families of the query episodes; default: all.", group="Episodes"
    )
    split: str | None = setting(
        None,
        help="Split of the query episodes: train, val, test or heldout.",
        shown="all",
        group="Episodes",
    )
    episodes: str | None = setting(
        None,
        help="Indices of the query episodes, such as 0-49 or 0,3,10-12; of tabletop-day the "
        "numbers of the days; default: all, of tabletop's 900 train episodes a family 0-99.",
        group="Episodes",
    )
    shard: str = setting(
        "1/1",
        help="Part of the episodes to record, such as 2/8, for merge to build from.",
        group="Episodes",
    )
    unit_episodes: str | None = setting(
        None,
        help="Indices of the train episodes that units are cut from, such as 0-3; default: all.",
        group="Episodes",
    )
    unit: str = setting(
        f"{UNIT_FRAMES}x{UNIT_STRIDE}",
        metavar="FRAMESxSTRIDE",
        help="Frames of a distractor unit, and raw frames from one of them to the next; another "
        "unit than the paper's is for episodes that are shorter.",
        group="Episodes",
    )
    units_per_episode: int = setting(
        1,
        metavar="N",
        help="Most units of a recorded episode, evenly spaced; fewer where they would overlap.",
        group="Episodes",
        rare=True,
    )
    cameras: tuple[str, ...] = setting(
        (),
        help="Cameras to store, such as front, or none for states alone; default: all.",
        group="Encoding",
    )
    resize: str | None = setting(
        None,
        metavar="WIDTHxHEIGHT[:crop|pad]",
        help="Store frames in this size, such as 256x256:pad; frames of another aspect ratio are "
        "cropped, or padded with black bars.",
        shown="as recorded",
        group="Encoding",
    )
    codec: str = setting(
        "av1-lossless",
        help="av1-lossless (bit-exact) or lerobot-default (smaller, lossy).",
        group="Encoding",
        rare=True,
    )
    version: str = setting("1.0.0", help="Version of the datasets.", group="Encoding", rare=True)
    time_limit_s: float | None = setting(
        None,
        help="Seconds for one episode; a slower one is given up.",
        shown="300 on tabletop and sample, else 1800",
        group="Execution",
        rare=True,
    )
    columns: tuple[str, ...] = setting(
        (),
        metavar="NAME=COLUMN,…",
        help="Source lerobot: columns without a usual name, such as front=top_image or "
        "state=arm+gripper; NAME=none leaves one out.",
        group="Sources",
    )
    families_from: str | None = setting(
        None,
        metavar="task|dataset|FILE",
        help="Source lerobot: make the families from the tasks, or one of each dataset; or a CSV "
        "file with the family of each task or episode and, if needed, exec_start_idx.",
        group="Sources",
    )
    several_tasks: str | None = setting(
        None,
        metavar="CHOICE",
        rare=True,
        help="Source lerobot: what the tasks of an episode with several are: `wordings` of one "
        "goal, steps that are `joined` to one goal, or of which the `first` or `last` is the goal.",
        group="Sources",
    )
    fps: float | None = setting(
        None,
        help="Frames per second of recordings that do not state them.",
        group="Sources",
        rare=True,
    )
    simulator_python: str | None = setting(
        None, metavar="PATH", help=PYTHON_HELP, shown=PYTHON_SHOWN, group="Sources"
    )
    simulator_options: tuple[str, ...] = setting(
        (),
        name="--simulator-option",
        whole=True,
        metavar="NAME=VALUE",
        help=SIMULATOR_OPTION_HELP,
        group="Sources",
    )


def _same(name: str, **changed: Any) -> Any:
    """Return the declaration of a setting of a build, for another command."""
    declared = BuildConfig.__dataclass_fields__[name]
    metadata = {SETTING: {**declared.metadata[SETTING], **changed}}
    return dataclasses.field(default=declared.default, metadata=metadata)


@dataclass(frozen=True)
class SourceConfig(FittingWorkersConfig):
    """Settings of a build that decide which recordings are read, and how."""

    source: tuple[str, ...] = _same("source", group="Sources")
    split: str | None = _same("split", help="Split to read.", group="Sources")
    episodes: str | None = _same(
        "episodes", help="Indices of the episodes to read, such as 0-49.", group="Sources"
    )
    cameras: tuple[str, ...] = _same(
        "cameras", help="Cameras to read, or none for states alone; default: all.", group="Sources"
    )
    columns: tuple[str, ...] = _same("columns")
    families_from: str | None = _same("families_from")
    several_tasks: str | None = _same("several_tasks")
    fps: float | None = _same("fps")
    simulator_python: str | None = _same("simulator_python")
    simulator_options: tuple[str, ...] = _same("simulator_options")


@dataclass(frozen=True)
class BuffersConfig:
    """Settings of the buffers that a buffer set plans; what is not given stays as planned."""

    conditions: tuple[str, ...] = setting(
        (),
        help="Conditions to plan in addition to those that are planned; `robomme-interference "
        "conditions` lists all kinds.",
        shown=f"planned ones, or {','.join(DEFAULT_CONDITIONS)}",
        group="Conditions",
    )
    drop: tuple[str, ...] = setting(
        (), help="Planned conditions to leave out from now on.", group="Conditions"
    )
    seed: int | None = setting(
        None,
        help="Seed of the draw of distractor units.",
        shown="planned one, or 0",
        group="Conditions",
    )
    position_limit: str | None = setting(
        None,
        help="Most positions that a policy has for history and rollout, or none.",
        shown=f"planned one, or {POSITION_LIMIT}",
        group="Conditions",
    )


def parse_position_limit(text: str) -> int | None:
    """Parse the position limit of a plan; None for none."""
    if text == "none":
        return None
    if not text.isdecimal() or int(text) == 0:
        raise InvalidOptionError.expected("position_limit", text, "a positive number or none")
    return int(text)


def parse_unit(text: str, per_episode: int = 1) -> Unit:
    """Parse the size of a unit, such as `32x8`; the number of them is checked."""
    match = re.fullmatch(r"([1-9][0-9]*)x([1-9][0-9]*)", text, re.ASCII)
    if match is None:
        raise InvalidOptionError.expected("unit", text, "FRAMESxSTRIDE, such as 32x8")
    if per_episode < 1:
        raise InvalidOptionError.expected("units_per_episode", per_episode, "a number from 1")
    return Unit(int(match[1]), int(match[2]), per_episode)
