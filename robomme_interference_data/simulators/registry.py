"""Simulators by name; the libraries behind them are imported when one is made."""

from collections.abc import Callable
from importlib import import_module
from typing import Any

from robomme_interference_data.errors import (
    InvalidOptionError,
    MissingExtraError,
    UnknownNameError,
)
from robomme_interference_data.schema.shifts import parse_shift

from .base import Simulator


def _tabletop(**options: Any) -> Simulator:
    try:
        from .tabletop.simulator import TabletopSimulator
    except ImportError as error:
        library = error.name or "a library"
        raise MissingExtraError.needs("the tabletop simulator", library, "sim") from error
    return TabletopSimulator(**options)


def _robomme(**options: Any) -> Simulator:
    from .robomme.simulator import RoboMMESimulator

    return RoboMMESimulator(**options)


SIMULATORS: dict[str, Callable[..., Simulator]] = {"tabletop": _tabletop, "robomme": _robomme}
"""Name to a function that makes the simulator; another backend adds itself here."""


def make_simulator(name: str, **options: Any) -> Simulator:
    """Make a simulator in this process; keep to one.

    Args:
        name: `tabletop`, `robomme`, or `module:function` for a simulator of your own.
        **options: For the simulator: see `TabletopSimulator` and `RoboMMESimulator`.

    Raises:
        UnknownNameError: There is no such simulator.
        MissingExtraError: Its libraries are not installed.
        InvalidOptionError: An option is not what it may be.
        NoRendererError: This machine cannot draw its cameras' pictures.
    """
    return find_simulator(name)(**options)


def find_simulator(name: str) -> Callable[..., Simulator]:
    """Return the function that makes a simulator, without calling it.

    Raises:
        UnknownNameError: There is no such simulator.
    """
    if name in SIMULATORS:
        return SIMULATORS[name]
    module, _, function = name.partition(":")
    if not function:
        raise UnknownNameError.none("simulator", name, SIMULATORS)
    try:
        found: Callable[..., Simulator] = getattr(import_module(module), function)
    except (ModuleNotFoundError, AttributeError) as error:
        raise UnknownNameError(
            f"there is no simulator {name!r}: {error}",
            "Expected <module>:<function>, which can be imported and returns a simulator.",
        ) from error
    return found


def check_shift(simulator: str, shift: str) -> None:
    """Check that a simulator can change its live scene as a shift says.

    Raises:
        InvalidOptionError: It is no shift, or the simulator has none.
    """
    if parse_shift(shift) is not None and simulator != "tabletop":
        raise InvalidOptionError(
            f"--shift {shift} on {simulator}: only tabletop can light and furnish its scenes "
            "otherwise after the demonstration",
            "Run it on --simulator tabletop, or leave --shift out.",
        )


def simulator_versions(name: str, python: str | None = None) -> dict[str, str]:
    """Return what is known of a simulator's versions.

    Under its own name that of its episodes, if known: `SUITE_VERSION` of `tabletop`, that of the
    installed package of `robomme`, whose interpreter is `python`; see `RoboMMESimulator.versions`.

    Raises:
        InvalidOptionError, MissingExtraError, SimulatorCrashError: As `RoboMMESimulator`.
    """
    if name == "tabletop":
        from .tabletop import SUITE_VERSION

        return {"tabletop": str(SUITE_VERSION)}
    if name != "robomme":
        return {}
    from .robomme.simulator import RoboMMESimulator

    with RoboMMESimulator(python) as simulator:
        return simulator.versions
