"""Simulators by name; the libraries behind them are imported when one is made."""

import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from robomme_interference_data.errors import InvalidOptionError, UnknownNameError
from robomme_interference_data.runtime.specs import import_factory
from robomme_interference_data.schema.shifts import parse_shift

from .base import Simulator

if TYPE_CHECKING:
    from robomme_interference_data.data.query import Query

OFFICIAL = "robomme"
"""The benchmark's own simulator, from which published recordings and results are."""

SIMULATORS: dict[str, str | Callable[..., Simulator]] = {
    "tabletop": f"{__package__}.tabletop.simulator:TabletopSimulator",
    "robomme": f"{__package__}.robomme.simulator:RoboMMESimulator",
}
"""Name to what makes the simulator, or where that is, `module:name`; others add themselves here."""

_SEEDS = 1 << 32


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
    made: Simulator = find_simulator(name)(**options)
    return made


def find_simulator(name: str) -> Callable[..., Simulator]:
    """Return what makes a simulator, without calling it."""
    if name not in SIMULATORS and ":" not in name:
        raise UnknownNameError.none("simulator", name, SIMULATORS)
    found = SIMULATORS.get(name, name)
    return import_factory("simulator", found) if isinstance(found, str) else found


def simulator_class(name: str) -> type[Simulator]:
    """Return the class of a simulator, for what it supports; `Simulator` for a bare function."""
    found = find_simulator(name)
    known = inspect.isclass(found) and issubclass(found, Simulator)
    return found if known else Simulator  # type: ignore[return-value]


def check_shift(name: str, shift: str) -> None:
    """Check that a simulator can show its live scene as a shift says."""
    if parse_shift(shift) is not None and not simulator_class(name).shifts:
        able = [one for one in SIMULATORS if simulator_class(one).shifts]
        raise InvalidOptionError(
            f"the shift {shift} on {name}: it cannot light and furnish its scenes otherwise after "
            "the demonstration",
            f"Take the simulator {' or '.join(able)}, or leave the shift out.",
        )


def recorded_scene(query: "Query") -> Any:
    """Return the scene of a recorded query, see `Simulator.scene`; None where it is not known."""
    name, seed, difficulty = query.simulator, query.seed, query.difficulty
    if name not in SIMULATORS or seed is None or difficulty is None or not 0 <= seed < _SEEDS:
        return None
    return simulator_class(name).scene(query.episode_id.family, seed, difficulty)


def simulator_versions(name: str, python: str | None = None) -> dict[str, str]:
    """Return the versions on which a simulator's results depend; see `Simulator.versions`."""
    return simulator_class(name).versions(python)
