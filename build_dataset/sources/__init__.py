"""Sources of recorded episodes, opened by a specification such as `robomme-h5:recordings/`."""

from collections.abc import Callable
from pathlib import Path

from robomme_interference_data.build_dataset.sources.base import Frame, Source, SourceEpisode
from robomme_interference_data.errors import InvalidOptionError, nearest

__all__ = ["KINDS", "Frame", "Source", "SourceEpisode", "open_source"]


def _robomme_h5(
    location: str, columns: dict[str, str] | None, families_file: Path | None
) -> Source:
    from robomme_interference_data.build_dataset.sources.robomme_h5 import RoboMMEH5Source

    return RoboMMEH5Source(_folder(location))


def _lerobot(location: str, columns: dict[str, str] | None, families_file: Path | None) -> Source:
    from robomme_interference_data.build_dataset.sources.lerobot import LeRobotSource

    name, _, revision = location.partition("@")
    if Path(location).expanduser().is_dir():  # a folder's name may hold an @
        name, revision = location, ""
    return LeRobotSource(
        name, columns=columns, families_file=families_file, revision=revision or None
    )


def _frames(location: str, columns: dict[str, str] | None, families_file: Path | None) -> Source:
    from robomme_interference_data.build_dataset.sources.frames import FramesSource

    return FramesSource(_folder(location))


KINDS: dict[str, Callable[[str, dict[str, str] | None, Path | None], Source]] = {
    "robomme-h5": _robomme_h5,
    "lerobot": _lerobot,
    "frames": _frames,
}
"""Kind of source to the function that opens one: location, column map, families file."""


def open_source(
    specification: str,
    *,
    columns: dict[str, str] | None = None,
    families_file: Path | None = None,
) -> Source:
    """Open a source.

    Args:
        specification: `KIND:LOCATION`: `robomme-h5:DIR`, `lerobot:DIR`, `lerobot:NAMESPACE/NAME`
            (with `@REVISION` if wanted) or `frames:DIR`.
        columns: For `lerobot`: logical name to the dataset's column, where they differ.
        families_file: For `lerobot`: file that names the family of every episode.

    Raises:
        InvalidOptionError: The specification or kind is unknown, or there is no such folder.
        SourceError: The place does not hold what the kind expects.
        MissingExtraError: The kind needs an extra that is not installed.
    """
    kind, colon, location = specification.partition(":")
    if not colon or not location or kind not in KINDS:
        raise InvalidOptionError(
            f"--source {specification!r} is not KIND:LOCATION with a kind of {', '.join(KINDS)}",
            nearest(kind, KINDS) if colon else "For example: --source robomme-h5:recordings/",
        )
    if kind != "lerobot" and (columns or families_file):
        raise InvalidOptionError(
            f"--columns and --families-file are for lerobot sources, not for {kind}"
        )
    return KINDS[kind](location, columns, families_file)


def _folder(location: str) -> Path:
    folder = Path(location).expanduser()
    if not folder.exists():
        raise InvalidOptionError(
            f"{folder} does not exist", "Give the folder after the colon of --source."
        )
    return folder
