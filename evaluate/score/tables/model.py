"""A logistic model of success within episodes. This is the only module that imports statsmodels."""

import math
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import DIFFICULTIES
from robomme_interference_data.errors import MissingExtraError
from robomme_interference_data.evaluate.score.comparisons.tables import tested
from robomme_interference_data.evaluate.score.outcomes import Outcomes, counting
from robomme_interference_data.evaluate.systems import is_reference
from robomme_interference_data.schema.conditions import NO_HISTORY, parse_condition
from robomme_interference_data.stats.bootstrap import MIN_EPISODES, Floats
from robomme_interference_data.stats.intervals import LEVEL, z_of
from robomme_interference_data.viz.tables import Table

HISTORY, SESSIONS = "history", "sessions"
"""Terms: k0 against no history, and each doubling of the sessions."""

_STEP = 1e-4  # of numeric derivatives
_SEPARATED = 5.0  # a standard error of log odds above it: no finite estimate


@dataclass(frozen=True)
class Fit:
    """The effects of some columns on the log odds of success, within episodes.

    Attributes:
        episodes: The number of episodes with successes and failures, which alone contribute.
        families: Their families.
        effects: The estimates, `(P,) float64`; NaN where all outcomes agree with an effect, so that
            the estimate has no limit.
        errors: Their standard errors, for other episodes of these families.
        sample_errors: The same for a sample of such families; NaN with fewer than three.
    """

    episodes: int
    families: int
    effects: Floats
    errors: Floats
    sample_errors: Floats

    @property
    def spread(self) -> Floats:
        """The standard deviation of the families' true effects, NaN if unknown."""
        return np.sqrt(np.maximum(0, self.families * (self.sample_errors**2 - self.errors**2)))


def load_conditional_logit() -> Any:
    """Import the model's class."""
    try:
        from statsmodels.discrete.conditional_models import ConditionalLogit
    except ImportError as error:
        raise MissingExtraError.needs("the model", "statsmodels", "model") from error
    return ConditionalLogit


def fit_within(
    won: NDArray[np.bool_],
    columns: Floats,
    episodes: NDArray[np.int64],
    families: NDArray[np.int64],
) -> Fit:
    """Fit a logistic model with an effect for each episode, which is conditioned out.

    The model is logit P(success) = (effect of the episode) + columns · effects, for rollouts `(N,)`
    with their `columns`, `(N, P)`. Given the number of successes in each episode, the likelihood
    does not contain the episodes' effects, nor those of their families and difficulties: nothing is
    assumed of their distribution, and episodes with equal outcomes carry no information.

    With the scores sₑ of the episodes and the information I: standard errors are those of I⁻¹ (Σ sₑ
    sₑᵀ) I⁻¹, with episodes as clusters. For a sample of families they are those of the jackknife
    over F families, (F − 1) / F Σ δδᵀ, with the change δ = (I − Iᶠ)⁻¹ sᶠ of the effects without
    family f.

    Source: Chamberlain (1980), Review of Economic Studies 47, 225–238; MacKinnon, Nielsen and Webb
    (2023), J. Applied Econometrics 38, 671–694 (the jackknife over few clusters).
    """
    totals, n = np.bincount(episodes, won), np.bincount(episodes)
    mixed = ((totals > 0) & (totals < n))[episodes]
    won, columns = won[mixed], columns[mixed]
    episodes, families = episodes[mixed], families[mixed]
    order, first = np.unique(episodes, return_index=True)
    of, size = families[np.sort(first)], columns.shape[1]
    labels = np.unique(of)
    nothing = np.full(size, np.nan)
    if len(order) < MIN_EPISODES:
        return Fit(len(order), len(labels), nothing, nothing, nothing)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # without a finite estimate; see _SEPARATED
        model = load_conditional_logit()(won.astype(float), columns, groups=episodes)
        effects = model.fit(method="bfgs", disp=False, skip_hessian=True).params

    def scores(at: Floats) -> Floats:
        return np.stack([model.score_grp(place, at) for place in range(len(of))])

    steps = [
        (scores(effects - _STEP * one) - scores(effects + _STEP * one)) / (2 * _STEP)
        for one in np.eye(size)
    ]
    information, own = np.stack(steps, axis=2), scores(effects)
    try:
        spread = np.linalg.inv(information.sum(axis=0))
    except np.linalg.LinAlgError:
        return Fit(len(order), len(labels), nothing, nothing, nothing)
    effects = effects + spread @ own.sum(axis=0)  # the last step of Newton's method
    meat = own.T @ own * len(of) / (len(of) - 1)
    errors = np.sqrt(np.diagonal(spread @ meat @ spread))
    finite = np.sqrt(np.maximum(0, np.diagonal(spread))) < _SEPARATED
    sample = np.where(finite, _jackknife(information, own, of, labels), np.nan)
    effects, errors = (np.where(finite, one, np.nan) for one in (effects, errors))
    return Fit(len(order), len(labels), effects, errors, sample)


def _jackknife(
    information: Floats, scores: Floats, of: NDArray[np.int64], labels: NDArray[np.int64]
) -> Floats:
    """Return the standard errors if families are left out one by one; NaN if undefined."""
    count = len(labels)
    try:
        changes = [
            np.linalg.solve(information[of != one].sum(axis=0), scores[of == one].sum(axis=0))
            for one in labels
        ]
    except np.linalg.LinAlgError:
        count = 0
    if count < 3:
        return np.full(scores.shape[1], np.nan)
    return np.asarray(np.sqrt((count - 1) / count * np.square(changes).sum(axis=0)))


def model_table(every: Iterable[Outcomes]) -> Table:
    """Return the effects of history, sessions and difficulty on each system's odds of success."""
    load_conditional_logit()
    rows = [row for outcomes in every for row in _rows(outcomes)]
    return tested(
        "model",
        "Odds of success within episodes",
        "simulator system term episodes:count families:count odds_ratio:ratio low:ratio high:ratio "
        "p:p p_holm:p spread:ratio sample_low:ratio sample_high:ratio complete:flag",
        rows,
        "Conditional logistic regression of each system over no-history and all k<n>, with an "
        "effect of each episode that is conditioned out, and with it those of family and "
        "difficulty. Odds ratios of the same episode: history, k0 against no history; sessions, "
        "each doubling of the sessions, at the mean difficulty; sessions x medium and x hard: the "
        "ratio of that to the one in easy episodes. episodes: those with successes and failures, "
        "which alone contribute. low to high: 95%, for other episodes of these families "
        "(clustered by episode), with p; p holm: after Holm's correction among the tests of this "
        "table in one simulator. sample low to sample high: 95%, for tasks of which these families "
        "are a sample (jackknife over families, Student's t). spread: standard deviation of the "
        "families' log odds ratios. Empty: no finite estimate, because no outcome contradicts the "
        "effect.",
    )


def _rows(outcomes: Outcomes) -> Iterator[tuple[object, ...]]:
    found = list[tuple[str, str, Fit, int, bool]]()
    for system in outcomes.systems:
        conditions = [
            name
            for name in outcomes.ran(system)
            if name == NO_HISTORY or parse_condition(name).kind.name == "k"
        ]
        if is_reference(system) or not conditions:
            continue
        terms, fit = _fit(outcomes, system, conditions)
        whole = all(bool(outcomes.complete[outcomes.cell(system, c)]) for c in conditions)
        found += [(system, term, fit, place, whole) for place, term in enumerate(terms)]
    for system, term, fit, at, whole in found:
        p = math.erfc(abs(fit.effects[at] / fit.errors[at]) / 2**0.5)
        low, high = _bounds(fit.effects[at], fit.errors[at], z_of(LEVEL))
        sample = _bounds(fit.effects[at], fit.sample_errors[at], _student(fit.families - 1))
        names = (outcomes.simulator, system, term, fit.episodes, fit.families)
        ratio, spread = math.exp(fit.effects[at]), fit.spread[at]
        yield (*names, ratio, low, high, p, spread, *sample, whole)


def _student(degrees: int) -> float:
    from scipy.stats import t  # statsmodels needs it

    return float(t.ppf((1 + LEVEL) / 2, degrees)) if degrees > 0 else math.nan


def _bounds(effect: float, error: float, quantile: float) -> tuple[float, float]:
    return math.exp(effect - quantile * error), math.exp(effect + quantile * error)


def _fit(outcomes: Outcomes, system: str, conditions: Sequence[str]) -> tuple[list[str], Fit]:
    """Return the terms that a system's rollouts determine, and their effects."""
    cells = np.stack([outcomes.status[outcomes.cell(system, c)] for c in conditions])
    condition, episode, seed = np.nonzero(counting(cells))
    won = cells[condition, episode, seed] == 0
    ks = np.log2([parse_condition(c).k + 1 for c in conditions])[condition]
    history = np.array([c != NO_HISTORY for c in conditions], float)[condition]
    levels = outcomes.difficulty[episode]
    columns = {HISTORY: history, SESSIONS: ks}
    if len(won) and (levels >= 0).all():
        for level, name in list(enumerate(DIFFICULTIES))[1:]:
            columns[f"{SESSIONS} x {name}"] = ks * ((levels == level) - np.mean(levels == level))
    # Only differences within an episode determine an effect.
    kept = list[str]()
    design: Floats = np.empty((len(won), 0))
    n = np.maximum(1, np.bincount(episode))
    for name, column in columns.items() if len(won) else ():
        more = np.column_stack([design, column])
        means = [(np.bincount(episode, one) / n)[episode] for one in more.T]
        if np.linalg.matrix_rank(more - np.stack(means, axis=1)) > len(kept):
            kept, design = [*kept, name], np.asarray(more, float)
    if not kept:
        return [], Fit(0, 0, *[np.empty(0)] * 3)
    return kept, fit_within(won, design, episode, outcomes.family[episode])
