"""Which families a test plays: a few always, all of them where slow tests run."""

from typing import Any

import pytest

from robomme_interference_data.constants import FAMILIES


def families(*fast: str) -> list[Any]:
    """All families, as parameters; those that are not named are slow."""
    assert {*fast} <= {*FAMILIES}
    return [one if one in fast else pytest.param(one, marks=pytest.mark.slow) for one in FAMILIES]
