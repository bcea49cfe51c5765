"""Differences in words, and the strongest paired effect of a simulator's rows."""

import math
from collections.abc import Sequence

from robomme_interference_data.evaluate.score.comparisons import offline
from robomme_interference_data.evaluate.score.comparisons.contrast import Contrast
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.systems import display_name
from robomme_interference_data.schema.conditions import NO_HISTORY
from robomme_interference_data.stats.significance import ALPHA, holm
from robomme_interference_data.stats.signs import simultaneous
from robomme_interference_data.viz.tables import error_change, points

EFFECTS = ("effects", "interference", offline.CHANGES)
"""Tables of paired effects on a system. Lift is not among them: that memory helps is expected."""


def strongest(score: Score, simulator: str) -> str:
    """Return a sentence about the strongest paired effect; empty without a complete pair of cells.

    That is the largest significant difference, or else the largest one; p and interval are
    corrected for all effects among which it was chosen.
    """
    found = [
        one
        for one in score.contrasts
        if one.simulator == simulator and one.table in EFFECTS and one.complete and one.pairs.n
    ]
    found = [one for one in found if not score.is_reference(simulator, one.system)] or found
    if not found:
        return ""
    ps = dict(zip(map(id, found), holm([one.pairs.p for one in found]), strict=True))
    best = min(found, key=lambda one: (ps[id(one)] >= ALPHA, -abs(one.pairs.change.value)))
    name = display_name(best.system)
    against = named(best.against[1])
    if best.against[0] != best.system:
        against = f"{display_name(best.against[0])} under {against}"
    change = shown(best, found, "{} effects")
    if ps[id(best)] >= ALPHA:
        start = "no paired effect is significant; the largest is"
    else:
        start = "the strongest paired effect is"
    return f"In {simulator}, {start} on {name}: {named(best.condition)} minus {against}, {change}."


def shown(one: Contrast, among: Sequence[Contrast], correction: str, counts: str = "") -> str:
    """State a difference that was chosen among some, with interval and p corrected for all."""
    change = one.pairs.at(simultaneous(len(among)))
    p = holm([other.pairs.p for other in among])[among.index(one)]
    name = "McNemar" if one.pairs.interval == "newcombe" else "sign-flip"
    offline_row = one.table in (offline.CHANGES, offline.SYSTEMS)
    number = error_change if offline_row else points
    unit = "in action error" if offline_row else "points"
    text = f"{number(change.value)} {unit} ("
    if not math.isnan(change.low):
        text += f"{number(change.low)} to {number(change.high)}; "
    text += f"{counts}, " if counts else ""
    text += f"{name} p = {_p(p)}"
    if p >= ALPHA and (change.low > 0 or change.high < 0):
        text += f", not significant although the interval excludes 0: mid-p = {_p(one.pairs.p_mid)}"
    if len(among) > 1:
        text += f", corrected for {correction.format(len(among))}"
    return f"{text})" if one.complete else f"{text}, provisional)"


def named(condition: str) -> str:
    """Return a condition in words."""
    return "no history" if condition == NO_HISTORY else condition


def _p(value: float) -> str:
    return "1" if value == 1 else f"{value:.2g}" if value >= 0.001 else f"{value:.1e}"
