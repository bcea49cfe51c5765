"""Sources of recorded episodes, opened by a specification such as `robomme-h5:recordings/`."""

from pathlib import Path

from robomme_interference_data.errors import InvalidOptionError, nearest
from robomme_interference_data.simulators.registry import SIMULATORS, simulator_class

from .base import (
    Frame,
    Recording,
    Source,
    SourceEpisode,
)

__all__ = ["KINDS", "Frame", "Recording", "Source", "SourceEpisode", "open_source"]

KINDS = {
    "robomme-h5": "robomme-h5:FOLDER",
    "lerobot": "lerobot:FOLDER or lerobot:NAMESPACE/NAME[@REVISION]",
    "frames": "frames:FOLDER",
    **{name: name for name in SIMULATORS},
    "sample": "sample[:FAMILY,…]",
}
"""Kind of source to how it is written."""


def open_source(
    specification: str,
    *,
    columns: dict[str, str] | None = None,
    families_file: Path | None = None,
    robomme_python: str | None = None,
    shifted: bool = False,
) -> Source:
    """Open a source.

    Args:
        specification: `KIND:LOCATION`, or `KIND` where nothing need stand behind it; see `KINDS`.
        columns: `lerobot`: logical name to the dataset's column, where they differ.
        families_file: `lerobot`: file that names the family of every episode.
        robomme_python: `robomme`: the interpreter that has RoboMME.
        shifted: Whether the first live views under shifts are wanted, not the episodes.
    """
    kind, colon, location = specification.partition(":")
    usage = KINDS.get(kind, "")
    incomplete = usage.startswith(f"{kind}:") and not location
    if not usage or incomplete or (colon and ":" not in usage):
        raise InvalidOptionError(
            f"source {specification!r} is not one of {', '.join(KINDS.values())}",
            nearest(kind, KINDS, more=""),
        )
    if shifted and not (kind in SIMULATORS and simulator_class(kind).shifts):
        able = [one for one in SIMULATORS if simulator_class(one).shifts]
        raise InvalidOptionError(
            f"the source {specification} cannot show its episodes under shifts",
            f"Take {' or '.join(able)}, for demonstrations that were built from it.",
        )
    # Each in a module of its own, which brings libraries that the others do not need.
    if kind == "robomme-h5":
        from .h5 import H5Source

        return H5Source(_folder(location))
    if kind == "lerobot":
        from .lerobot import LeRobotSource

        return LeRobotSource(location, columns=columns, families_file=families_file)
    if kind == "frames":
        from .frames import FramesSource

        return FramesSource(_folder(location))
    if kind == "sample":
        from .sample import SampleSource

        return SampleSource(tuple(location.split(","))) if location else SampleSource()
    from . import simulator

    source = simulator.ShiftedSource if shifted else simulator.SimulatorSource
    return source(kind, robomme_python)


def _folder(location: str) -> Path:
    folder = Path(location).expanduser()
    if not folder.exists():
        raise InvalidOptionError(
            f"{folder} does not exist", "Give the folder after the colon of the source."
        )
    return folder
