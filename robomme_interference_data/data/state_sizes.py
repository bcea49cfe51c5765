"""Numbers of values of the states in the datasets of a buffer set."""

from collections.abc import Mapping

from robomme_interference_data.constants import DEMONSTRATIONS, STATE, UNITS

from .dataset import Dataset


def query_state_size(datasets: Mapping[str, Dataset]) -> int:
    """Return the number of values of the states of lessons and live observations."""
    (size,) = datasets[DEMONSTRATIONS].features[STATE]
    return size


def other_state_sizes(datasets: Mapping[str, Dataset]) -> dict[str, int]:
    """Return the datasets of units of another robot, by name, to the number of their values."""
    size = query_state_size(datasets)
    units = {name: datasets[name].features[STATE][0] for name in UNITS if name in datasets}
    return {name: other for name, other in units.items() if other != size}
