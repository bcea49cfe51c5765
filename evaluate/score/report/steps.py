"""What to run next, as the last sentence of a headline."""

from collections.abc import Sequence

from robomme_interference_data.evaluate.score.config import Expected
from robomme_interference_data.evaluate.score.quotes import Sentence, TableRow, rows_of
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.score.tables.contrast import START

from .falls import Fall, Verdict

AGAIN = "run the same evaluate command again, which repeats what broke and runs what is missing"
"""How a run becomes complete."""


def next_step(score: Score, simulator: str, falls: Sequence[Fall]) -> Sentence:
    """Return the first step that changes what can be concluded."""
    cells = rows_of(score.tables["main"], simulator=simulator)
    ran = [row for row in cells if row["n"] or row["errors"]]
    return Sentence(f"Next: {_step(score, ran, falls)}.")


def _step(score: Score, ran: Sequence[TableRow], falls: Sequence[Fall]) -> str:
    complete = [row for row in ran if row["complete"]]
    if not complete and score.settings.expected is Expected.BENCHMARK:
        # Whoever planned fewer episodes than the benchmark has needs no others.
        return f"{AGAIN}; or, if no more episodes are planned, score with --expected observed"
    if any(row["errors"] or row["missing"] for row in ran):
        return AGAIN
    if START not in {row["condition"] for row in ran}:
        return f"run {START}, from which falls are measured"
    if not falls:
        return f"run k7, to compare it with {START}"
    # The benchmark has no more episodes than its grid.
    more = score.settings.expected is Expected.OBSERVED
    if more and any(fall.verdict is Verdict.OPEN for fall in falls):
        return "plan more episodes with the command power, and run them"
    if len(falls) == 1:
        return "run a second system on the same episodes, to compare their falls"
    return "train each system again with another seed, to see how much its rates differ"
