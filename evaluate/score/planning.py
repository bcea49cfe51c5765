"""Plans of paired comparisons, before anything runs: what `power` prints.

The model is that of `power`. With R training runs of each system, whose rates have the standard
deviation s, the difference has the variance f / n + 2 s² / R, of which the second term is known
with 2 (R − 1) degrees of freedom.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.stats.bootstrap import generator_of
from robomme_interference_data.stats.intervals import newcombe_paired, z_of
from robomme_interference_data.stats.runs import MIN_RUNS, student_quantile
from robomme_interference_data.stats.sequential import MAX_LOOKS, look_levels
from robomme_interference_data.stats.significance import ALPHA, mcnemar

from .power import MAX_EPISODES, POWER, needed, power, smallest

FLIPS = 0.25
"""Share of the episodes that flips between two learned systems of equal rates.

Three pairs of trained systems in docs/results/training differ in 22 to 28% of the episodes at k0.
"""

MAX_RUNS = 100
"""The most training runs of a plan."""


@dataclass(frozen=True)
class PowerPlan:
    """What paired rollouts can detect; all but `episodes` and `needed` are fractions.

    Attributes:
        episodes: Episodes that run on both sides.
        flips: Share of them that flips by chance.
        margin: A difference of interest.
        noise: 95% range of the difference between two equal systems: z √(f / n), at most 1.
        power: Probability that McNemar's exact test at 5% / `tests` finds a difference of `margin`.
        smallest: Smallest difference found with 80% power; None if none is.
        needed: Episodes that find a difference of `margin` with 80% power.
        rate: Success rate of two equal systems, for `equal`.
        equal: Smallest margin of an equivalence test at 5% with 80% power for two equal systems
            of this rate.
        tests: Number of tests that Holm's correction is over; the levels are for the first.
        looks: Level of each planned look, see `look_levels`; with several, `power` is that of
            finding the difference at any look, and the other values are those of one look.
        runs: What training runs of each system detect; None if they are not planned.
    """

    episodes: int
    flips: float
    margin: float
    noise: float
    power: float
    smallest: float | None
    needed: int
    rate: float
    equal: float
    tests: int = 1
    looks: tuple[float, ...] = ()
    runs: "TrainingRunPlan | None" = None


@dataclass(frozen=True)
class TrainingRunPlan:
    """What several training runs of each of two systems can detect, in fractions.

    Attributes:
        runs: Training runs of each system, all over the same episodes.
        spread: Standard deviation of the success rates of a system's runs.
        power: Probability of finding the planned difference.
        smallest: Smallest difference found with 80% power.
        needed: Runs of each system that find the planned difference with 80% power; None if
            `MAX_RUNS` do not.
    """

    runs: int
    spread: float
    power: float
    smallest: float
    needed: int | None


def plan(
    margin: float,
    episodes: int,
    flips: float = FLIPS,
    tests: int = 1,
    looks: int = 1,
    rate: float = 0.5,
    runs: tuple[int, float] | None = None,
) -> PowerPlan:
    """Return what episodes can detect; all shares and differences are fractions.

    `runs` are the number of training runs of each system, and the standard deviation of their
    rates.
    """
    _check(margin, episodes, flips, tests, looks, rate)
    alpha = ALPHA / tests
    levels = look_levels(looks) if looks > 1 else ()
    chance = power(margin, episodes, flips, alpha)
    if levels:
        chance = _sequential(margin, episodes, flips, [level / tests for level in levels])
    noise = min(1.0, z_of(0.95) * math.sqrt(flips / episodes))
    return PowerPlan(
        episodes=episodes,
        flips=flips,
        margin=margin,
        noise=noise,
        power=chance,
        smallest=smallest(episodes, flips, alpha),
        needed=needed(margin, flips, alpha),
        rate=rate,
        equal=_equal(episodes, flips, rate),
        tests=tests,
        looks=levels,
        runs=None if runs is None else _plan_runs(margin, episodes, flips, alpha, *runs),
    )


def _check(margin: float, episodes: int, flips: float, tests: int, looks: int, rate: float) -> None:
    for name, value, most in (("tests", tests, 10_000), ("looks", looks, MAX_LOOKS)):
        if not 1 <= value <= most:
            raise InvalidOptionError.expected(name, value, f"a number from 1 to {most:,}")
    if not 0 < margin <= 1:
        expected = "points, more than 0 up to 100"
        raise InvalidOptionError.expected("margin", float(f"{100 * margin:g}"), expected)
    if not 0 <= flips <= 1:
        raise InvalidOptionError.expected("flips", flips, "a share from 0 to 1, such as 0.06")
    if not 1 <= episodes <= MAX_EPISODES:
        raise InvalidOptionError.expected(
            "episodes", episodes, f"a number from 1 to {MAX_EPISODES:,}"
        )
    if margin + flips > 1:
        raise InvalidOptionError(
            f"{100 * margin:g} points and flips {flips} are more than all episodes",
            "A difference adds flips: margin and flips must sum to at most 100%.",
        )
    if not flips / 2 <= rate <= 1 - flips / 2:
        raise InvalidOptionError.expected(
            "rate", rate, f"a share from {flips / 2:g} to {1 - flips / 2:g}, for flips of {flips:g}"
        )


def _plan_runs(
    margin: float, episodes: int, flips: float, alpha: float, runs: int, spread: float
) -> TrainingRunPlan:
    if not MIN_RUNS <= runs <= MAX_RUNS:
        raise InvalidOptionError.expected(
            "runs", runs, f"a number of training runs from {MIN_RUNS} to {MAX_RUNS}"
        )
    if not 0 < spread <= 1:
        expected = "points, more than 0 up to 100"
        raise InvalidOptionError.expected("run_spread", float(f"{100 * spread:g}"), expected)

    def deviations(count: int) -> tuple[float, float]:
        """Return the standard error of a difference, and the half of its interval."""
        over_episodes, over_runs = flips / episodes, 2 * spread**2 / count
        t = student_quantile(1 - alpha, 2 * (count - 1))
        half = math.sqrt(z_of(1 - alpha) ** 2 * over_episodes + t**2 * over_runs)
        return math.sqrt(over_episodes + over_runs), half

    def power_of(count: int) -> float:
        error, half = deviations(count)
        return NormalDist().cdf((margin - half) / error)

    error, half = deviations(runs)
    counts = range(MIN_RUNS, MAX_RUNS + 1)
    return TrainingRunPlan(
        runs,
        spread,
        power_of(runs),
        half + z_of(2 * POWER - 1) * error,
        next((count for count in counts if power_of(count) >= POWER), None),
    )


def _equal(episodes: int, flips: float, rate: float) -> float:
    """Return the margin that 80% of the 90% intervals of two equal systems are within."""
    numbers = generator_of("equivalence").multinomial(episodes, [flips / 2] * 2 + [1 - flips], 500)
    share = (rate - flips / 2) / (1 - flips) if flips < 1 else 0.0  # of the others that succeed
    margins = []
    for gained, lost, rest in numbers.tolist():
        won = int(rest * share)
        low, high = newcombe_paired(won, gained, lost, rest - won, 1 - 2 * ALPHA)
        margins.append(max(abs(low), abs(high)))
    return float(np.quantile(margins, POWER))


def _sequential(margin: float, episodes: int, flips: float, levels: Sequence[float]) -> float:
    """Return the share of 5,000 made-up studies that find a difference at any of the looks."""
    ends = [round(episodes * look / len(levels)) for look in range(len(levels) + 1)]
    chances = [flips / 2 + margin, flips / 2, max(0.0, 1 - flips - margin)]
    sizes = np.diff(ends)[None].repeat(5000, axis=0)
    steps = generator_of("looks").multinomial(sizes, np.array(chances) / sum(chances))
    counts = steps[..., :2].cumsum(axis=1)
    pairs, place = np.unique(counts.reshape(-1, 2), axis=0, return_inverse=True)
    ps = np.array([mcnemar(*both) for both in pairs.tolist()])[place].reshape(counts.shape[:2])
    return float((ps <= levels).any(axis=1).mean())
