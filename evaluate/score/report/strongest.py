"""Differences in words, and the strongest paired effect of a simulator's rows."""

import math
from collections.abc import Sequence

from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.score.tables.contrast import Contrast, Effect, Measure
from robomme_interference_data.evaluate.systems import display_name
from robomme_interference_data.schema.conditions import NO_HISTORY
from robomme_interference_data.stats.significance import ALPHA, holm
from robomme_interference_data.stats.signs import simultaneous
from robomme_interference_data.viz.tables import error_change, points

_EFFECTS = {
    # Not that against no history: that memory helps is expected.
    Measure.SUCCESS: (Effect.SESSIONS, Effect.RETRIEVAL, Effect.INTERFERENCE),
    Measure.ACTION_ERROR: (Effect.HISTORY, Effect.SESSIONS, Effect.INTERFERENCE),
}
"""The paired effects on a system among which the strongest is chosen."""


def strongest(score: Score, simulator: str) -> str:
    """Return a sentence about the strongest paired effect; empty without a complete pair of cells.

    That is the largest significant difference, or else the largest one; p and interval are
    corrected for all effects among which it was chosen.
    """
    effects = [
        contrast
        for contrast in score.contrasts
        if contrast.simulator == simulator
        and contrast.effect in _EFFECTS[contrast.measure]
        and contrast.complete
        and contrast.pairs.n
    ]
    ranked = [effect for effect in effects if not score.is_reference(simulator, effect.system)]
    effects = ranked or effects  # references have effects of their own
    if not effects:
        return ""
    ps = holm([effect.pairs.p for effect in effects])
    best, p = min(
        zip(effects, ps, strict=True),
        key=lambda pair: (pair[1] >= ALPHA, -abs(pair[0].pairs.change.value)),
    )
    name = display_name(best.system)
    against = named(best.against[1])
    if best.against[0] != best.system:
        against = f"{display_name(best.against[0])} under {against}"
    change = difference_text(best, effects, "{} effects")
    if p >= ALPHA:
        start = "no paired effect is significant; the largest is"
    else:
        start = "the strongest paired effect is"
    return f"In {simulator}, {start} on {name}: {named(best.condition)} minus {against}, {change}."


def difference_text(
    contrast: Contrast, chosen_from: Sequence[Contrast], correction: str, counts: str = ""
) -> str:
    """State a difference, with interval and p corrected for all that it was chosen from."""
    change = contrast.pairs.at(simultaneous(len(chosen_from)))
    p = holm([candidate.pairs.p for candidate in chosen_from])[chosen_from.index(contrast)]
    test = "McNemar" if contrast.pairs.method == "newcombe" else "sign-flip"
    if contrast.measure is Measure.ACTION_ERROR:
        number, unit = error_change, "in action error"
    else:
        number, unit = points, "points"
    details = []
    if not math.isnan(change.low):
        details.append(f"{number(change.low)} to {number(change.high)};")
    if counts:
        details.append(f"{counts},")
    details.append(f"{test} p = {_p(p)}")
    text = f"{number(change.value)} {unit} ({' '.join(details)}"
    if p >= ALPHA and (change.low > 0 or change.high < 0):
        text += ", not significant although the interval excludes 0"
    if len(chosen_from) > 1:
        text += f", corrected for {correction.format(len(chosen_from))}"
    return f"{text})" if contrast.complete else f"{text}, provisional)"


def named(condition: str) -> str:
    """Return a condition in words."""
    return "no history" if condition == NO_HISTORY else condition


def _p(value: float) -> str:
    return "1" if value == 1 else f"{value:.2g}" if value >= 0.001 else f"{value:.1e}"
