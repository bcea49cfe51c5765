"""Simulators by name. Their libraries are imported when one is made."""

import traceback
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, get_type_hints

from robomme_interference_data.constants import RECORDINGS
from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    SimulatorError,
    UnknownNameError,
    named,
)
from robomme_interference_data.runtime.specs import bind_options, import_factory, signature_of
from robomme_interference_data.schema.shifts import parse_shift

from .base import Simulator
from .remote.simulator import RemoteSimulator
from .scene import Scene

if TYPE_CHECKING:
    from robomme_interference_data.data.query import Query

SIMULATORS: dict[str, str | Callable[..., Simulator]] = {
    "tabletop": f"{__package__}.tabletop.simulator:TabletopSimulator",
    "tabletop-day": f"{__package__}.tabletop.day_simulator:TabletopDaySimulator",
    "robomme": f"{__package__}.robomme.simulator:RoboMMESimulator",
}
"""Name to a factory, or to its location `module:name`; add your own simulators here."""

_SEEDS = 1 << 32
_METHODS = ("reset", "step", "act", "close")


def make_simulator(name: str, **options: Any) -> Simulator:
    """Make a simulator in this process; make only one per process.

    Args:
        name: `tabletop`, `tabletop-day`, `robomme`, or `module:name` of a class or function of your
            own.
        **options: Passed to the simulator; see `TabletopSimulator` and `RoboMMESimulator`.

    Raises:
        UnknownNameError: There is no such simulator.
        MissingExtraError: Its libraries are not installed.
        InvalidOptionError: An option has an invalid value.
        NoRendererError: This machine cannot render its camera images.
        SimulatorError: One of your own cannot be made, or lacks a method.
    """
    factory = find_simulator(name)
    if ":" not in name:
        return factory(**options)
    try:
        simulator = factory(**options)
    except InterferenceError:
        raise
    except Exception as error:
        trace = error.__traceback__ and error.__traceback__.tb_next
        raise SimulatorError(
            f"simulator {name!r}: making it raised {type(error).__name__}: {error}",
            "".join(traceback.format_exception(type(error), error, trace)).rstrip(),
        ) from error
    missing = [
        f"{method}()" for method in _METHODS if not callable(getattr(simulator, method, None))
    ]
    if missing:
        raise SimulatorError(
            f"simulator {name!r}: {type(simulator).__name__} has no {', '.join(missing)}",
            "Subclass robomme_interference_data.simulators.Simulator: "
            "docs/how-to/another-benchmark.md.",
        )
    return simulator


def find_simulator(name: str) -> Callable[..., Simulator]:
    """Return the class or function that makes a simulator."""
    known = SIMULATORS | {RECORDINGS: f"{__package__}.recordings:Recordings"}
    if name not in known and ":" not in name:
        raise UnknownNameError.none("simulator", name, SIMULATORS)
    factory = known.get(name, name)
    return (
        import_factory(f"simulator {factory!r}", factory) if isinstance(factory, str) else factory
    )


def simulator_class(name: str) -> type[Simulator]:
    """Return the class that declares what a simulator supports.

    For a function it is the one in its return annotation; `Simulator` if nothing is declared.
    """
    declared: Any = find_simulator(name)
    if not isinstance(declared, type):
        try:
            declared = get_type_hints(declared).get("return")
        except (NameError, TypeError):  # no readable annotations
            declared = None
    return declared if isinstance(declared, type) and issubclass(declared, Simulator) else Simulator


def accepted_settings(name: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return those settings of a run that a simulator accepts; see `Simulator.settings`."""
    factory = find_simulator(name)
    if isinstance(factory, type) and issubclass(factory, Simulator):
        accepted: Any = factory.settings
    else:
        accepted = signature_of(factory).parameters
    return {setting: value for setting, value in settings.items() if setting in accepted}


def simulator_arguments(
    name: str, settings: Mapping[str, Any], options: Iterable[str] = ()
) -> dict[str, Any]:
    """Return the arguments of a simulator.

    Args:
        name: Its name.
        settings: Settings of a run; it gets those that it accepts.
        options: Its own arguments, `NAME=VALUE`; see `bind_options`.
    """
    accepted = accepted_settings(name, settings)
    options = tuple(options)
    if not options:  # of a factory without a signature nothing is known
        return accepted
    return accepted | bind_options(f"simulator {name!r}", find_simulator(name), accepted, options)


def find_simulator_python(name: str, python: str | None) -> str | None:
    """Return the path of a simulator's own interpreter, None if it runs in this one.

    Args:
        name: Name of the simulator.
        python: The interpreter that is set; None for the default.
    """
    declared = simulator_class(name)
    if issubclass(declared, RemoteSimulator):
        return declared.interpreter(python).path
    if python is not None:
        raise InvalidOptionError(
            f"{named('simulator_python')} has no effect on the simulator {name}, which runs in "
            "this process",
            "Leave it out.",
            option="simulator_python",
        )
    return None


def check_shift(name: str, shift: str) -> None:
    """Check that a simulator supports a shift."""
    if parse_shift(shift) is not None and not simulator_class(name).shifts:
        able = [key for key in SIMULATORS if simulator_class(key).shifts]
        raise InvalidOptionError(
            f"the simulator {name} does not support shifts; got {shift}",
            f"Use the simulator {' or '.join(able)}, or no shift.",
        )


def recorded_scene(query: "Query") -> Scene | None:
    """Return the scene of a recorded query (see `Simulator.scene`), or None if unknown."""
    name, seed, difficulty = query.simulator, query.seed, query.difficulty
    if name not in SIMULATORS or seed is None or difficulty is None or not 0 <= seed < _SEEDS:
        return None
    scene = query.record.scene
    return simulator_class(name).scene(query.episode_id.family, seed, difficulty, scene)


def simulator_versions(name: str, python: str | None = None) -> dict[str, str]:
    """Return the versions that a simulator's results depend on; see `Simulator.versions`.

    `python` is the path of its own interpreter; None for the default.
    """
    declared = simulator_class(name)
    if issubclass(declared, RemoteSimulator):
        return declared.versions(python)
    return declared.versions()


def simulator_renderer(name: str, python: str | None = None) -> str | None:
    """Return what draws a simulator's images on this machine; see `Simulator.renderer`.

    `python` is the path of its own interpreter; None for the default.
    """
    declared = simulator_class(name)
    if issubclass(declared, RemoteSimulator):
        return declared.renderer(python)
    return declared.renderer()
