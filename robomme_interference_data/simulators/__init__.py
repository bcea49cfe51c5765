"""Simulators of the benchmark's task families.

from robomme_interference_data.simulators import make_simulator

simulator = make_simulator("tabletop")
lesson, first, info = simulator.reset("MoveCube/test/3")
observation, status = simulator.step(action)
simulator.close()
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from robomme_interference_data.records import Status
    from robomme_interference_data.simulators.base import (
        Demonstration,
        EpisodeInfo,
        Observation,
        Simulator,
    )
    from robomme_interference_data.simulators.registry import SIMULATORS, make_simulator

__all__ = [
    # make one
    "make_simulator",
    "SIMULATORS",
    # what it serves
    "Simulator",
    "Demonstration",
    "EpisodeInfo",
    "Observation",
    "Status",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is used: the command line imports this package first."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    homes = {"make_simulator": "simulators.registry", "SIMULATORS": "simulators.registry"}
    homes["Status"] = "records"
    module = f"robomme_interference_data.{homes.get(name, 'simulators.base')}"
    return getattr(import_module(module), name)
