"""Fit the cosine below which a history is cut, and tell how much hangs on it: pure.

The released rule: midway between the 99th percentile of the cosines across true cuts and the 1st
percentile of the lowest cosine inside each session. Buffers share their sessions; each stored span
counts once, and each cut between the same two (ours). The rule looks at true sessions, so a
threshold that is fitted on a split must not be graded on the same split without saying so;
`held_out` grades each family with a threshold to which no frame of it contributed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.retrieval.grade import Measured, grade, mean_of
from robomme_interference_data.retrieval.select import Rule

__all__ = ["Calibration", "HeldOut", "SweepPoint", "calibrate", "fit", "steps"]

_DIGITS = 6


@dataclass(frozen=True)
class HeldOut:
    """A family graded with the threshold that the other families give.

    Attributes:
        family: The family.
        threshold: Fitted without its queries, and without its sessions in other buffers.
        purity: Mean over its queries under all k.
        coverage: The same.
    """

    family: str
    threshold: float
    purity: float
    coverage: float


@dataclass(frozen=True)
class SweepPoint:
    """What one threshold gives under one k.

    Attributes:
        threshold: The threshold.
        k: Number of distractor sessions.
        purity: Mean over all queries.
        coverage: The same.
    """

    threshold: float
    k: int
    purity: float
    coverage: float


@dataclass(frozen=True)
class Calibration:
    """What the released rule finds in a split.

    Attributes:
        threshold: What it fits.
        cuts: Cosines across true cuts, each once, ascending.
        lowest: Lowest cosine inside each session, each once, ascending.
        cut_percentile: The 99th percentile of `cuts`.
        lowest_percentile: The 1st percentile of `lowest`; where it is below the former, no
            threshold parts the two.
        held_out: Family by family; empty if there is only one.
        sweep: By threshold, then by k.
    """

    threshold: float
    cuts: tuple[float, ...]
    lowest: tuple[float, ...]
    cut_percentile: float
    lowest_percentile: float
    held_out: tuple[HeldOut, ...]
    sweep: tuple[SweepPoint, ...]


def calibrate(measured: Sequence[Measured], thresholds: Sequence[float]) -> Calibration:
    """Fit a threshold, refit it without each family, and try others.

    Args:
        measured: All buffers of a split.
        thresholds: What to try, ascending.

    Raises:
        InvalidOptionError: There is no true cut, or no session with two frames.
    """
    threshold, cut_percentile, lowest_percentile = fit(measured)
    families = list(dict.fromkeys(one.episode_id.family for one in measured))
    held_out = []
    for family in families if len(families) > 1 else ():
        within = [one for one in measured if one.episode_id.family == family]
        without, _, _ = fit(measured, without=family)
        grades = (grade(one, Rule(cut=without)) for one in within)
        held_out.append(HeldOut(family, without, *mean_of(grades)))
    ks = sorted({one.k for one in measured})
    sweep = [
        SweepPoint(cut, k, *mean_of(grade(one, Rule(cut=cut)) for one in measured if one.k == k))
        for cut in thresholds
        for k in ks
    ]
    return Calibration(
        threshold,
        tuple(true_cuts(measured)),
        tuple(lowest_inside(measured)),
        cut_percentile,
        lowest_percentile,
        tuple(held_out),
        tuple(sweep),
    )


def fit(measured: Sequence[Measured], *, without: str | None = None) -> tuple[float, float, float]:
    """Return the threshold of the released rule, and the two percentiles it lies between.

    Args:
        measured: Buffers.
        without: Family to leave out: its queries, and every session and cut of it elsewhere.

    Raises:
        InvalidOptionError: There is no true cut, or no session with two frames.
    """
    kept = [one for one in measured if one.episode_id.family != without]
    cuts, lowest = true_cuts(kept, without=without), lowest_inside(kept, without=without)
    if not cuts or not lowest:
        missing = "cut between sessions" if not cuts else "session of two frames or more"
        raise InvalidOptionError(
            f"{len(kept)} buffers without any {missing}: nothing to fit a threshold to",
            "Take a split with buffers of k ≥ 2, and of four families or more to leave one out.",
        )
    high, low = float(np.percentile(cuts, 99)), float(np.percentile(lowest, 1))
    return tuple(round(value, _DIGITS) for value in ((high + low) / 2, high, low))  # type: ignore[return-value]


def true_cuts(measured: Sequence[Measured], *, without: str | None = None) -> list[float]:
    """Return the cosines across true cuts, ascending; each pair of stored spans once (ours).

    Args:
        measured: Buffers.
        without: Family whose sessions are left out, on either side of a cut.
    """
    found = {
        (before.stored, after.stored): float(one.adjacent[after.span[0] - 1])
        for one in measured
        for before, after in pairwise(one.sessions)
        if without not in (before.family, after.family)
    }
    return sorted(found.values())


def lowest_inside(measured: Sequence[Measured], *, without: str | None = None) -> list[float]:
    """Return the lowest cosine of adjacent frames inside each session, ascending.

    Each stored span counts once (ours): units return in many buffers, a lesson under each k.

    Args:
        measured: Buffers.
        without: Family whose sessions are left out.
    """
    found = {}
    for one in measured:
        for session in one.sessions:
            start, stop = session.span
            if stop - start > 1 and session.family != without:
                found[session.stored] = float(one.adjacent[start : stop - 1].min())
    return sorted(found.values())


def steps(first: float, last: float) -> list[float]:
    """Return the thresholds from `first` to `last` (included) in steps of 0.01.

    Raises:
        InvalidOptionError: They are no cosines, or in the wrong order.
    """
    if not -1 <= first <= last <= 1:
        raise InvalidOptionError(
            f"a sweep from {first} to {last}; expected two cosines, the lower one first",
            "For example: --sweep 0.80 0.99",
        )
    count = int((last - first) / 0.01 + 1e-6) + 1
    return [round(first + step / 100, _DIGITS) for step in range(count)]
