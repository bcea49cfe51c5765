"""What to run next, as the last sentence of a headline."""

from collections.abc import Sequence

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.evaluate.score.config import Expected
from robomme_interference_data.evaluate.score.outcomes import TEST_EPISODES
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.score.tables.contrast import LESSON_ONLY, Scope

from .falls import Fall, Finding
from .quotes import Sentence, TableRow, rows_of

AGAIN = "run the same evaluate command again, which repeats what broke and runs what is missing"
"""How a run becomes complete."""


def next_step(score: Score, simulator: str, falls: Sequence[Fall]) -> Sentence:
    """Return the first step that changes what can be concluded."""
    cells = rows_of(score.tables["main"], simulator=simulator)
    ran = [row for row in cells if row["n"] or row["errors"]]
    expected = score.settings.expected
    if any(row["errors"] or row["missing"] for row in ran) or not falls:
        ranked = [row for row in ran if not score.is_reference(simulator, row["system"])]
        step = _to_compare(ran, ranked, expected)
    else:
        step = _to_conclude(falls)
    return Sentence(f"Next: {step}.")


def _to_compare(ran: Sequence[TableRow], ranked: Sequence[TableRow], expected: Expected) -> str:
    """Return the step that completes cells, or adds one that falls are measured with.

    `ranked` are those of `ran` without references, which have no part in the primary analysis.
    """
    if expected is Expected.BENCHMARK and not any(row["complete"] for row in ran):
        # Whoever planned fewer episodes than the benchmark has needs no others.
        return f"{AGAIN}; or, if no more episodes are planned, score with --expected observed"
    if any(row["errors"] or row["missing"] for row in ran):
        return AGAIN
    if not ranked:
        return "run a system that is no reference"
    if LESSON_ONLY not in {row["condition"] for row in ranked}:
        return f"run {LESSON_ONLY}, from which falls are measured"
    return f"run k7, to compare it with {LESSON_ONLY}"


def _to_conclude(falls: Sequence[Fall]) -> str:
    """Return the step that makes a conclusion about falls firmer."""
    # The benchmark has no more test episodes than these.
    most = len(FAMILIES) * TEST_EPISODES
    open_falls = [fall for fall in falls if fall.finding is Finding.OPEN]
    if any(fall.row["n"] < most for fall in open_falls):
        return "plan more episodes with the command power, and run them"
    if len(falls) == 1:
        return "run a second system on the same episodes, to compare their falls"
    if open_falls or all(fall.row["scope"] == Scope.CHECKPOINT for fall in falls):
        return "train each system again with other seeds, to see how much its rates differ"
    return "run other conditions, such as held-k7, to see what a fall is due to"
