"""Fit the cosine below which a history is cut, and grade other thresholds; without IO.

The released rule takes the middle between the 99th percentile of the cosines across true cuts and
the 1st percentile of the lowest cosine inside each session. Buffers share sessions: each stored
span counts once, and each cut between the same two spans (a choice of this project). The rule uses
the true sessions, so its threshold is not a fair one for the data that it was fitted on; `held_out`
grades each family with a threshold that none of its frames contributed to.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.schema.conditions import in_order
from robomme_interference_data.viz.tables import Columns, Table

from .grade import ALL, grade
from .measure import Similarities
from .select import Rule

_DIGITS = 6


@dataclass(frozen=True)
class Trial:
    """Mean grades under a threshold.

    Attributes:
        threshold: The threshold.
        family: Family of the graded queries, or `ALL`.
        condition: Condition of the graded buffers, or `ALL`.
        purity, coverage: Means over these buffers.
    """

    threshold: float
    family: str
    condition: str
    purity: float
    coverage: float


@dataclass(frozen=True)
class Calibration:
    """The threshold that the released rule fits to a buffer set.

    Attributes:
        rule: The encoder's default rule.
        in_use: The threshold of that rule.
        threshold: The fitted threshold.
        cuts: Cosines across true cuts, each once, ascending.
        lowest: Lowest cosine inside each session, each once, ascending.
        cut_percentile: The 99th percentile of `cuts`.
        lowest_percentile: The 1st percentile of `lowest`; below `cut_percentile`, no threshold
            separates cuts from sessions.
        held_out: Each family under a threshold fitted without its queries, and without its
            sessions in other buffers; empty for a single family.
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

    def text(self, title: str) -> str:
        """Return a report for a terminal."""
        apart = self.lowest_percentile - self.cut_percentile
        gap = f"the gap is {apart:.3f}"
        if apart < 0:
            gap = f"they overlap by {-apart:.3f}: no threshold separates them"
        summary = (
            f"Fitted by the released rule: {self.threshold:.3f}; in use ({self.rule}): "
            f"{self.in_use:.3f}\n"
            f"99th percentile of {len(self.cuts)} true cuts: {self.cut_percentile:.3f}; 1st "
            f"percentile of the lowest cosine inside {len(self.lowest)} sessions: "
            f"{self.lowest_percentile:.3f}; {gap}\n"
            "Each stored span, and each cut between two spans, counts once. The threshold is "
            "fitted and graded on the same buffer set, except in the table of left-out families."
        )
        parts = [title, summary]
        if self.held_out:
            fitted = [trial.threshold for trial in self.held_out]
            head = (
                "Fitted without one family, graded on it: thresholds from "
                f"{min(fitted):.3f} to {max(fitted):.3f}"
            )
            left_out: Columns = {
                "left_out": "text",
                "threshold": "ratio",
                "purity": "rate",
                "coverage": "rate",
            }
            rows = [(t.family, t.threshold, t.purity, t.coverage) for t in self.held_out]
            parts.append(Table("held_out", head, left_out, rows).text())
        conditions = dict.fromkeys(trial.condition for trial in self.sweep)
        columns: Columns = {"threshold": "text"}
        for part in ("purity", "coverage"):
            columns |= {f"{part}_{name}": "rate" for name in conditions}
        swept = []
        for threshold, group in groupby(self.sweep, key=lambda trial: trial.threshold):
            trials = list(group)
            shares = (*(t.purity for t in trials), *(t.coverage for t in trials))
            swept.append((f"{threshold:.2f}", *shares))
        head = "Other thresholds, all families"
        parts.append(Table("sweep", head, columns, swept).text())
        return "\n\n".join(parts)


def calibrate(
    measured: Sequence[Similarities], rule: Rule, thresholds: Sequence[float]
) -> Calibration:
    """Fit a threshold, refit it without each family, and grade other thresholds.

    Args:
        measured: All buffers of a buffer set that hold frames of the lesson; at least one.
        rule: The encoder's default rule.
        thresholds: Other thresholds, ascending.
    """
    threshold, high, low = _fit(measured)
    families = dict.fromkeys(buffer.episode_id.family for buffer in measured)
    conditions = [buffer.name for buffer in in_order({buffer.condition for buffer in measured})]
    cuts, lowest = _true_cosines(measured)
    return Calibration(
        rule=str(rule),
        in_use=rule.cosine(measured[0].typical),
        threshold=threshold,
        cuts=tuple(cuts),
        lowest=tuple(lowest),
        cut_percentile=high,
        lowest_percentile=low,
        held_out=tuple(
            _trial(measured, _fit(measured, family)[0], family=family)
            for family in families
            if len(families) > 1
        ),
        sweep=tuple(
            _trial(measured, swept, condition=name) for swept in thresholds for name in conditions
        ),
    )


def _trial(
    measured: Sequence[Similarities], threshold: float, *, family: str = ALL, condition: str = ALL
) -> Trial:
    grades = [
        grade(buffer, Rule(number=threshold))
        for buffer in measured
        if family in (ALL, buffer.episode_id.family) and condition in (ALL, buffer.condition)
    ]
    purity, coverage = np.array([(g.purity, g.coverage) for g in grades], float).mean(axis=0)
    return Trial(threshold, family, condition, float(purity), float(coverage))


def _fit(
    measured: Sequence[Similarities], without: str | None = None
) -> tuple[float, float, float]:
    """Return the threshold of the released rule, and its two percentiles.

    `without` is a family to leave out: its queries, and its sessions and cuts in other buffers.
    """
    kept = [buffer for buffer in measured if buffer.episode_id.family != without]
    cuts, lowest = _true_cosines(kept, without)
    if not cuts or not lowest:
        missing = "cut between sessions" if not cuts else "session of two frames or more"
        raise InvalidOptionError(
            f"{len(kept)} buffers without any {missing}: no threshold can be fitted",
            "Use a buffer set with conditions such as k3 and at least four families.",
        )
    high, low = float(np.percentile(cuts, 99)), float(np.percentile(lowest, 1))
    return round((high + low) / 2, _DIGITS), round(high, _DIGITS), round(low, _DIGITS)


def _true_cosines(
    measured: Iterable[Similarities], without: str | None = None
) -> tuple[list[float], list[float]]:
    """Return the cosines across true cuts, and the lowest inside each session, both ascending."""
    cuts: dict[Any, float] = {}
    lowest: dict[Any, float] = {}
    for buffer in measured:
        before: tuple[Any, ...] | None = None
        for session in buffer.sessions:
            entry = session.entry
            stored = entry.dataset, entry.episode_index, entry.start, entry.stop, entry.repeat
            # The cuts before and after a session that is left out are left out with it.
            current = None if session.family == without else stored
            if before and current:
                cuts[before, current] = float(buffer.adjacent[session.start - 1])
            # A single frame has no adjacent cosine.
            if current and len(session) > 1:
                lowest[current] = float(buffer.adjacent[session.start : session.stop - 1].min())
            before = current
    return sorted(cuts.values()), sorted(lowest.values())


def sweep_steps(first: float, last: float) -> list[float]:
    """Return the thresholds from `first` to `last` (included) in steps of 0.01."""
    if not -1 <= first <= last <= 1:
        expected = "two cosines in ascending order, such as 0.80 0.99"
        raise InvalidOptionError.expected("sweep", (first, last), expected)
    # A little beyond the last, which rounding would otherwise leave out.
    return np.arange(first, last + 1e-6, 0.01).round(_DIGITS).tolist()
