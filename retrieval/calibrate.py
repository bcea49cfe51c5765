"""Fit the cosine below which a history is cut, and tell how much hangs on it: pure.

The released rule: midway between the 99th percentile of the cosines across true cuts and the 1st
percentile of the lowest cosine inside each session. Buffers share their sessions; each stored span
counts once, and each cut between the same two (ours). The rule looks at true sessions, so a
threshold that is fitted on a split must not be graded on the same split without saying so;
`held_out` grades each family with a threshold to which no frame of it contributed.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from robomme_interference_data.conditions import in_order
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.records import Session
from robomme_interference_data.retrieval.grade import ALL, grade
from robomme_interference_data.retrieval.select import Measured, Rule
from robomme_interference_data.tables import Column, Table

__all__ = ["Calibration", "Trial", "calibrate", "sweep_steps"]

_DIGITS = 6


@dataclass(frozen=True)
class Trial:
    """What a threshold gives.

    Attributes:
        threshold: The threshold.
        family: Whose queries it was tried on, or `ALL`.
        condition: Under which condition, or `ALL`.
        purity: Mean over these buffers.
        coverage: The same.
    """

    threshold: float
    family: str
    condition: str
    purity: float
    coverage: float


@dataclass(frozen=True)
class Calibration:
    """What the released rule finds in a split.

    Attributes:
        rule: The rule that the encoder goes by itself.
        in_use: The threshold that this comes to.
        threshold: What the released rule fits.
        cuts: Cosines across true cuts, each once, ascending.
        lowest: Lowest cosine inside each session, each once, ascending.
        cut_percentile: The 99th percentile of `cuts`.
        lowest_percentile: The 1st percentile of `lowest`; where it is below the former, no
            threshold parts the two.
        held_out: Each family under the threshold that is fitted without its queries, and without
            its sessions in other buffers; empty if there is only one.
        sweep: Other thresholds, ascending, each by condition.
    """

    rule: str
    in_use: float
    threshold: float
    cuts: tuple[float, ...]
    lowest: tuple[float, ...]
    cut_percentile: float
    lowest_percentile: float
    held_out: tuple[Trial, ...]
    sweep: tuple[Trial, ...]

    @property
    def conditions(self) -> tuple[str, ...]:
        """Names of the conditions, in order."""
        return tuple(dict.fromkeys(trial.condition for trial in self.sweep))

    def text(self, title: str) -> str:
        """Say it for a terminal."""
        apart = self.lowest_percentile - self.cut_percentile
        gap = f"they overlap by {-apart:.3f}: no threshold parts them"
        if apart >= 0:
            gap = f"{apart:.3f} lie between them"
        lines = (
            f"{title}\n",
            f"Fitted by the released rule: {self.threshold:.3f}; in use ({self.rule}): "
            f"{self.in_use:.3f}",
            f"99th percentile of {len(self.cuts)} true cuts: {self.cut_percentile:.3f}; 1st "
            f"percentile of the lowest cosine inside {len(self.lowest)} sessions: "
            f"{self.lowest_percentile:.3f}; {gap}",
            "Each stored span counts once, and each cut between the same two. Fitted and tried on "
            "the same split; only the families left out below are unseen.",
        )
        parts = ["\n".join(lines)]
        if self.held_out:
            fitted = [one.threshold for one in self.held_out]
            head = (
                "Fitted without any frame of one family, tried on it: thresholds from "
                f"{min(fitted):.3f} to {max(fitted):.3f}"
            )
            columns = [Column("left_out"), Column("threshold", "ratio"), *_shares()]
            rows = [(o.family, o.threshold, o.purity, o.coverage) for o in self.held_out]
            parts.append(Table("held_out", head, tuple(columns), tuple(rows)).text())
        by_cut: dict[float, list[Trial]] = {}
        for trial in self.sweep:
            by_cut.setdefault(trial.threshold, []).append(trial)
        swept = [
            (f"{cut:.2f}", *(t.purity for t in trials), *(t.coverage for t in trials))
            for cut, trials in by_cut.items()
        ]
        columns = [Column("threshold"), *_shares(*(f"_{name}" for name in self.conditions))]
        head = "Other thresholds, all families"
        parts.append(Table("sweep", head, tuple(columns), tuple(swept)).text())
        return "\n\n".join(parts)


def _shares(*endings: str) -> list[Column]:
    return [
        Column(share + ending, "rate")
        for share in ("purity", "coverage")
        for ending in endings or ("",)
    ]


def calibrate(measured: Sequence[Measured], rule: Rule, thresholds: Sequence[float]) -> Calibration:
    """Fit a threshold, refit it without each family, and try others.

    Args:
        measured: All buffers of a split that hold frames of the lesson; one or more.
        rule: The rule that the encoder goes by itself.
        thresholds: What to try, ascending.

    Raises:
        InvalidOptionError: There is no true cut, or no session with two frames.
    """
    threshold, cut_percentile, lowest_percentile = _fit(measured)
    families = dict.fromkeys(one.episode_id.family for one in measured)
    by_family = {f: [m for m in measured if m.episode_id.family == f] for f in families}
    held_out = [
        _trial(_fit(measured, family)[0], family, ALL, within)
        for family, within in by_family.items()
        if len(families) > 1
    ]
    names = [one.name for one in in_order({one.condition for one in measured})]
    by_condition = {name: [m for m in measured if m.condition == name] for name in names}
    sweep = [
        _trial(cut, ALL, name, within)
        for cut in thresholds
        for name, within in by_condition.items()
    ]
    return Calibration(
        str(rule),
        rule.threshold(measured[0].typical),
        threshold,
        tuple(_true_cuts(measured)),
        tuple(_lowest_inside(measured)),
        cut_percentile,
        lowest_percentile,
        tuple(held_out),
        tuple(sweep),
    )


def _trial(cut: float, family: str, condition: str, measured: Iterable[Measured]) -> Trial:
    grades = [grade(one, Rule(cut=cut)) for one in measured]
    purity, coverage = np.array([(g.purity, g.coverage) for g in grades], float).mean(axis=0)
    return Trial(cut, family, condition, float(purity), float(coverage))


def _fit(measured: Sequence[Measured], without: str | None = None) -> tuple[float, float, float]:
    """Return the threshold of the released rule, and the two percentiles it lies between.

    `without` is a family to leave out: its queries, and every session and cut of it elsewhere.
    """
    kept = [one for one in measured if one.episode_id.family != without]
    cuts, lowest = _true_cuts(kept, without), _lowest_inside(kept, without)
    if not cuts or not lowest:
        missing = "cut between sessions" if not cuts else "session of two frames or more"
        raise InvalidOptionError(
            f"{len(kept)} buffers without any {missing}: nothing to fit a threshold to",
            "Take a split with conditions such as k3, and four families or more to leave one out.",
        )
    high, low = float(np.percentile(cuts, 99)), float(np.percentile(lowest, 1))
    return round((high + low) / 2, _DIGITS), round(high, _DIGITS), round(low, _DIGITS)


def _stored(session: Session) -> tuple[Any, ...]:
    """Return what names the stored frames of a session, the same in every buffer of a split."""
    entry = session.entry
    return entry.dataset, entry.episode_index, entry.start, entry.stop, entry.repeat


def _true_cuts(measured: Iterable[Measured], without: str | None = None) -> list[float]:
    """Return the cosines across true cuts, ascending; each pair of stored spans once."""
    found = {
        (_stored(before), _stored(after)): float(one.adjacent[after.start - 1])
        for one in measured
        for before, after in pairwise(one.sessions)
        if without not in (before.family, after.family)
    }
    return sorted(found.values())


def _lowest_inside(measured: Iterable[Measured], without: str | None = None) -> list[float]:
    """Return the lowest cosine of adjacent frames inside each session, each once, ascending."""
    found = {
        _stored(session): float(one.adjacent[session.start : session.stop - 1].min())
        for one in measured
        for session in one.sessions
        if len(session) > 1 and session.family != without
    }
    return sorted(found.values())


def sweep_steps(first: float, last: float) -> list[float]:
    """Return the thresholds from `first` to `last` (included) in steps of 0.01.

    Raises:
        InvalidOptionError: They are no cosines, or in the wrong order.
    """
    if not -1 <= first <= last <= 1:
        expected = "two cosines, the lower one first, such as 0.80 0.99"
        raise InvalidOptionError.expected("sweep", (first, last), expected)
    count = int((last - first) / 0.01 + 1e-6) + 1
    return [round(first + step / 100, _DIGITS) for step in range(count)]
