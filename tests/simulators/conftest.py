"""The simulator that the tests of RoboMME share."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from robomme_interference_data.simulators.robomme.simulator import RoboMMESimulator


@pytest.fixture
def simulator(robomme_python: Path) -> Iterator[RoboMMESimulator]:
    """RoboMME's simulator, with the stand-in."""
    with RoboMMESimulator(robomme_python) as made:
        yield made
