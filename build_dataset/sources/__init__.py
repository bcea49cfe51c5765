"""Sources of recorded episodes, opened by a specification such as `robomme-h5:recordings/`."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from robomme_interference_data.build_dataset.sources.base import (
    Frame,
    Recording,
    Source,
    SourceEpisode,
)
from robomme_interference_data.errors import InvalidOptionError, nearest

__all__ = ["KINDS", "Frame", "OpenOptions", "Recording", "Source", "SourceEpisode", "open_source"]


@dataclass(frozen=True)
class OpenOptions:
    """What some kinds of source are opened with.

    Attributes:
        columns: `lerobot`: logical name to the dataset's column, where they differ.
        families_file: `lerobot`: file that names the family of every episode.
        robomme_python: `robomme`: the interpreter that has RoboMME.
    """

    columns: dict[str, str] | None = None
    families_file: Path | None = None
    robomme_python: str | None = None


def _robomme_h5(location: str, options: OpenOptions) -> Source:
    from robomme_interference_data.build_dataset.sources.h5 import H5Source

    return H5Source(_folder(location))


def _lerobot(location: str, options: OpenOptions) -> Source:
    from robomme_interference_data.build_dataset.sources.lerobot import LeRobotSource

    return LeRobotSource(location, columns=options.columns, families_file=options.families_file)


def _frames(location: str, options: OpenOptions) -> Source:
    from robomme_interference_data.build_dataset.sources.frames import FramesSource

    return FramesSource(_folder(location))


def _tabletop(location: str, options: OpenOptions) -> Source:
    from robomme_interference_data.build_dataset.sources.simulator import SimulatorSource

    return SimulatorSource("tabletop")


def _robomme(location: str, options: OpenOptions) -> Source:
    from robomme_interference_data.build_dataset.sources.simulator import SimulatorSource

    return SimulatorSource("robomme", options.robomme_python)


def _sample(location: str, options: OpenOptions) -> Source:
    from robomme_interference_data.build_dataset.sources.sample import SampleSource

    return SampleSource(tuple(location.split(","))) if location else SampleSource()


KINDS: dict[str, tuple[str, Callable[[str, OpenOptions], Source]]] = {
    "robomme-h5": ("robomme-h5:FOLDER", _robomme_h5),
    "lerobot": ("lerobot:FOLDER or lerobot:NAMESPACE/NAME[@REVISION]", _lerobot),
    "frames": ("frames:FOLDER", _frames),
    "tabletop": ("tabletop", _tabletop),
    "robomme": ("robomme", _robomme),
    "sample": ("sample[:FAMILY,…]", _sample),
}
"""Kind of source to how it is written, and what opens one by what follows the colon."""


def open_source(specification: str, options: OpenOptions | None = None) -> Source:
    """Open a source.

    Args:
        specification: `KIND:LOCATION`, or `KIND` where nothing need stand behind it; see `KINDS`.
        options: For kinds that take some.

    Raises:
        InvalidOptionError: The specification or kind is unknown, or there is no such folder.
        SourceError: The place does not hold what the kind expects.
        MissingExtraError: The kind needs an extra that is not installed.
    """
    kind, colon, location = specification.partition(":")
    usage, open_kind = KINDS.get(kind, ("", None))
    incomplete = usage.startswith(f"{kind}:") and not location
    if open_kind is None or incomplete or (colon and ":" not in usage):
        raise InvalidOptionError(
            f"--source {specification!r} is not one of "
            + ", ".join(usage for usage, _ in KINDS.values()),
            nearest(kind, KINDS, more=""),
        )
    return open_kind(location, options or OpenOptions())


def _folder(location: str) -> Path:
    folder = Path(location).expanduser()
    if not folder.exists():
        raise InvalidOptionError(
            f"{folder} does not exist", "Give the folder after the colon of --source."
        )
    return folder
