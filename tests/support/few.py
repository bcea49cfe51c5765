"""Which of a test's many values `make test` runs, and which only `.ci/run` does."""

from collections.abc import Iterable
from typing import Any

import pytest


def few(values: Iterable[Any], count: int = 2) -> list[Any]:
    """Return values for `parametrize`, those after the first `count` marked slow."""
    return [
        value if index < count else pytest.param(value, marks=pytest.mark.slow)
        for index, value in enumerate(values)
    ]
