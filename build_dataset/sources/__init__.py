"""Sources of recorded episodes, opened by a specification such as `robomme-h5:recordings/`."""

from contextlib import suppress
from pathlib import Path
from typing import Any

from robomme_interference_data.constants import DEMONSTRATIONS, INFO_PATH
from robomme_interference_data.errors import InvalidOptionError, MissingFileError, nearest
from robomme_interference_data.runtime.specs import (
    OWN,
    Registry,
    Spec,
    SpecKind,
    import_factory,
    signature_of,
)
from robomme_interference_data.schema.days import DEFAULT_TASKS
from robomme_interference_data.simulators.registry import SIMULATORS, simulator_class

from .base import Frame, Recording, Robot, Source, SourceEpisode
from .frames_table import TABLE

__all__ = [
    "SOURCES",
    "Frame",
    "Recording",
    "Robot",
    "Source",
    "SourceEpisode",
    "open_source",
    "takes",
]

_LOCATION = "(?P<location>.+)"

SOURCES = Registry(
    "source",
    {
        "robomme-h5": SpecKind(
            "robomme-h5:FOLDER", f"{__name__}.h5:H5Source", _LOCATION, extra="build"
        ),
        "lerobot": SpecKind(
            "lerobot:FOLDER or lerobot:NAMESPACE/NAME[/FOLDER][@REVISION]",
            f"{__name__}.lerobot.source:LeRobotSource",
            _LOCATION,
        ),
        "frames": SpecKind("frames:FOLDER", f"{__name__}.frames:FramesSource", _LOCATION),
        **{
            name: SpecKind(name, f"{__name__}.simulator:SimulatorSource", arguments={"name": name})
            for name in SIMULATORS
        },
        "tabletop-day": SpecKind(
            "tabletop-day[:TASKS]",
            f"{__name__}.day:DaySource",
            "(?P<tasks>[1-9][0-9]{0,8})",
            default=str(DEFAULT_TASKS),
            arguments={"name": "tabletop-day"},
        ),
        "sample": SpecKind(
            "sample[:FAMILY,…]", f"{__name__}.sample:SampleSource", "(?P<families>.*)"
        ),
    },
    also="MODULE:NAME of a simulator of your own",
)


def open_source(
    specification: str, *, kind: str = DEMONSTRATIONS, shifted: bool = False, **options: Any
) -> Source:
    """Open a source.

    Args:
        specification: `KIND:LOCATION` or `KIND`; see `SOURCES`. Or `MODULE:NAME` of a simulator of
            the user, as in `make_simulator`.
        kind: Name of the dataset that is built of it: a day is recorded, or asked about.
        shifted: Whether to open the first live observations under shifts instead of the episodes.
        **options: `columns`, `families_from` and `several_tasks` for `lerobot`, `every`,
            `simulator_python` and `simulator_options` for simulators; other kinds ignore them.
    """
    spec = _parse(specification)
    simulator = spec.arguments.get("name")
    if shifted and not (simulator and simulator_class(simulator).shifts):
        able = [name for name in SIMULATORS if simulator_class(name).shifts]
        raise InvalidOptionError(
            f"the source {specification} cannot show its episodes under shifts",
            f"Use {' or '.join(able)}, with demonstrations built from it.",
        )
    factory = SOURCES.factory(spec)
    accepted = signature_of(factory).parameters
    options |= {"shifted": shifted, "kind": kind}
    known = {name: value for name, value in options.items() if name in accepted}
    source: Source = factory(**spec.arguments, **known)
    return source


def takes(specification: str, option: str) -> bool:
    """Return whether a source takes one of the options of `open_source`."""
    return option in signature_of(SOURCES.factory(_parse(specification))).parameters


def _kinds_of_folder(path: str) -> list[str] | None:
    """Return the kinds of sources that read a folder, by the files in it; None if it is none."""
    signs = {"lerobot": INFO_PATH, "frames": TABLE, "robomme-h5": "record_dataset_*.h5"}
    with suppress(OSError, ValueError, RuntimeError):  # it is no path
        folder = Path(path).expanduser()
        if folder.is_dir():
            return [kind for kind, sign in signs.items() if any(folder.glob(sign))]
    return None


def _check_folder(kind: str, path: str) -> None:
    """Check that a source's folder exists, and is not one of another kind of source."""
    found = _kinds_of_folder(path)
    if found and kind not in found:
        raise InvalidOptionError(
            f"{path} is a folder for the source {found[0]}, not for {kind}",
            f"Write {found[0]}:{path}",
        )
    # A dataset may be on the Hub, and recordings may be one file.
    if found is None and kind == "frames":
        raise MissingFileError(f"there is no folder {path}", "Check the path of the source.")


def _unnamed_kind(path: str, kinds: list[str]) -> InvalidOptionError:
    """Return the error about a folder that is given without the kind of source."""
    hint = (
        "None of its files is of a known kind. For recordings of any robot, see "
        "docs/how-to/your-own-recordings.md."
    )
    if kinds:
        hint = f"Write {kinds[0]}:{path}"
    return InvalidOptionError(f"the source {path!r} names a folder, but not what it holds", hint)


def _parse(specification: str) -> Spec:
    """Parse the text of a source; a simulator of the user is one like the embedded one."""
    module = specification.partition(":")[0]
    kinds = _kinds_of_folder(specification)
    if module not in SOURCES.kinds and kinds is not None:
        raise _unnamed_kind(specification, kinds)
    if module in SOURCES.kinds or not OWN.fullmatch(specification):
        spec = SOURCES.parse(specification)
        if "location" in spec.arguments:
            _check_folder(spec.kind, spec.arguments["location"])
        return spec
    try:
        import_factory(f"source {specification!r}", specification)
    except InvalidOptionError as error:  # the module, or the name of a kind, is misspelled
        meant = nearest(module, SOURCES.kinds, more="")
        hint = f"{meant} {error.hint} Other sources: {SOURCES.forms}.".lstrip()
        raise InvalidOptionError(error.message, hint) from error
    return Spec("tabletop", arguments={"name": specification})
