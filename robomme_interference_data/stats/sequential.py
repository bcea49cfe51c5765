"""Levels for planned looks at incomplete data, by alpha spending."""

import math
from functools import lru_cache

import numpy as np

from .bootstrap import Floats
from .intervals import z_of
from .significance import ALPHA

MAX_LOOKS = 20
"""The most planned looks."""

_POINTS = 801  # of the grid that the probability of reaching a look is summed on

_above = np.vectorize(lambda z: math.erfc(z / math.sqrt(2)) / 2, otypes=[float])


@lru_cache(maxsize=MAX_LOOKS)
def look_levels(looks: int) -> tuple[float, ...]:
    """Return the two-sided level of each of equally spaced looks; together they find 5% by luck.

    The spending function is that of Lan and DeMets like O'Brien and Fleming's boundaries: after the
    share t of the data, each side has spent 2 (1 − Φ(z / √t)), with z = 2.24 so that t = 1 spends
    2.5%. Each boundary is solved from the density of the sum that has crossed none before.

    Source: Lan and DeMets (1983), Biometrika 70, 659–663; the recursion: Armitage, McPherson and
    Rowe (1969), J. Royal Statistical Society A 132, 235–244.
    """
    z = z_of(1 - ALPHA / 2)
    spent = [2 * float(_above(z / math.sqrt(look / looks))) for look in range(1, looks + 1)]
    points: Floats = np.zeros(1)
    density: Floats = np.ones(1)
    levels = list[float]()
    for look, spends in enumerate(np.diff([0.0, *spent]), start=1):
        low, high = 0.0, 10 * math.sqrt(look)
        while high - low > 1e-6:
            middle = (low + high) / 2
            crossed = float(density @ _above(middle - points))
            low, high = (middle, high) if crossed > spends else (low, middle)
        levels.append(2 * float(_above(high / math.sqrt(look))))
        grid = high * np.linspace(-1, 1, _POINTS).astype(np.float64)
        weight: Floats = np.full(_POINTS, grid[1] - grid[0])
        weight[[0, -1]] /= 2
        steps = np.exp(-((grid[:, None] - points) ** 2) / 2) / math.sqrt(2 * math.pi)
        points, density = grid, np.asarray(weight * (steps @ density), float)
    return tuple(levels)
