"""Power of paired comparisons: the differences that a number of episodes can detect.

The model: a share f of the episodes flips by chance between two equal systems, half of it each way,
and a true difference δ adds flips one way. So the share f / 2 is gained and f / 2 + δ lost, or the
other way round.
"""

import math
from collections.abc import Iterable
from functools import lru_cache
from statistics import median

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import counted
from robomme_interference_data.stats.intervals import z_of
from robomme_interference_data.stats.significance import ALPHA
from robomme_interference_data.viz.tables import percent

POWER = 0.8
"""The power that is planned for."""

MAX_EPISODES = 5_000
"""The most episodes of a plan: the time to sum over all outcomes grows with them."""


def power(margin: float, episodes: int, flips: float, alpha: float = ALPHA) -> float:
    """Return the probability that McNemar's exact test finds a true difference.

    Flips are d of n with Binomial(n, f + δ), and of these Binomial(d, (f / 2) / (f + δ)) go
    against the difference; the test finds it where p is at most alpha. Summed over all d that
    occur.
    """
    both = flips + margin
    reach = 8 * math.sqrt(episodes * both) + 8
    low = max(0, int(episodes * both - reach))
    d = np.arange(low, min(episodes, int(episodes * both + reach)) + 1)
    logs = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1, episodes + 1)))])
    x = np.arange(d[-1] // 2 + 1)  # of the smaller tail
    rest = d[:, None] - x
    ways = np.where(rest >= 0, logs[d][:, None] - logs[x] - logs[np.maximum(rest, 0)], -np.inf)
    fair = np.exp(ways - d[:, None] * math.log(2))
    # Both tails are alike: x against the difference, and as many for it.
    rare = 2 * fair.cumsum(axis=1) <= alpha
    against = _powers(flips / 2 / both, x) + _powers(1 - flips / 2 / both, rest)
    in_favour = _powers(flips / 2 / both, rest) + _powers(1 - flips / 2 / both, x)
    rejecting = (np.exp(ways + against) + np.exp(ways + in_favour)) * (rare & (2 * x < d[:, None]))
    flipping = logs[episodes] - logs[d] - logs[episodes - d]
    flipping = flipping + _powers(both, d) + _powers(1 - both, episodes - d)
    return float(np.exp(flipping) @ rejecting.sum(axis=1))


def needed(margin: float, flips: float, alpha: float = ALPHA) -> int:
    """Return how many episodes find a difference with 80% power; one fewer would not.

    Where they are more than `MAX_EPISODES` it is the normal approximation with a continuity
    correction, the n of n δ − 1 = (z √(f + δ) + z' √(f + δ − δ²)) √n, whose power is 80% or
    somewhat more.

    Source: Connor (1987), Sample size for testing differences in proportions for the paired-sample
    design, Biometrics 43, 207–211; the correction: Edwards (1948), Psychometrika 13, 185–187.
    """
    both = flips + margin
    wide = z_of(1 - alpha) * math.sqrt(both) + z_of(2 * POWER - 1) * math.sqrt(both - margin**2)
    low, high = 0, math.ceil(((wide + math.sqrt(wide**2 + 4 * margin)) / 2 / margin) ** 2)
    while high <= MAX_EPISODES and high - low > 1:
        middle = (low + high) // 2
        low, high = (
            (low, middle) if power(margin, middle, flips, alpha) >= POWER else (middle, high)
        )
    return high


def _powers(base: float, exponents: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the logarithm of a power; that of 0 to the 0 is 0."""
    if base > 0:
        return np.asarray(exponents * math.log(base))
    return np.where(exponents == 0, 0.0, -np.inf)


@lru_cache(maxsize=64)
def smallest(
    episodes: int, flips: float, alpha: float = ALPHA, *, includes_difference: bool = False
) -> float | None:
    """Return the smallest difference that is found with 80% power, to 0.01 points, or None.

    With `includes_difference`, `flips` is the share of the episodes that differ between two
    systems, by chance or by the difference.
    """

    def is_found(margin: float) -> bool:
        by_chance = max(0.0, flips - margin) if includes_difference else flips
        return power(margin, episodes, by_chance, alpha) >= POWER

    low, high = 0.0, flips if includes_difference else 1 - flips
    if high <= 0 or not is_found(high):
        return None
    while high - low > 1e-4:
        middle = (low + high) / 2
        low, high = (low, middle) if is_found(middle) else (middle, high)
    return high


def note(counts: Iterable[tuple[int, int, int]], tests: int, effect: str = "") -> str:
    """Return a sentence on what comparisons with these pairs, gained and lost can detect.

    It uses the most episodes, and the median of the shares that differ. The correction is that of
    the first of `tests` by Holm. `effect` names the comparisons. Empty without pairs.
    """
    known = [(pairs, gained, lost) for pairs, gained, lost in counts if pairs]
    if not known:
        return ""
    n = min(MAX_EPISODES, max(pairs for pairs, _, _ in known))
    differing = round(median((gained + lost) / pairs for pairs, gained, lost in known), 3)
    least = smallest(n, differing, ALPHA / tests, includes_difference=True)
    detected = "no difference" if least is None else f"a difference of {100 * least:.1f} points"
    if effect:
        detected += f" by {effect}"
    corrected = f" after correction for {tests} tests" if tests > 1 else ""
    return (
        f"With {counted(n, 'episode')}, of which {percent(differing)} differ (the median "
        f"here), {detected} can be detected with 80% power{corrected}."
    )
