"""Success by whether the memory kept the evidence: failures of access and failures of use."""

from collections.abc import Iterable

import numpy as np

from robomme_interference_data.evaluate.score.outcomes import Outcomes, rate_of
from robomme_interference_data.evaluate.systems import known_system
from robomme_interference_data.viz.tables import Table


def ceiling_of(system: str) -> str | None:
    """Return the ideal observer with a system's memory and retrieval step, if one is known."""
    known = known_system(system)
    if known is None or known.sampling is None or known.reference:
        return None
    step = known.step.removeprefix("extrapolate").removeprefix("-")  # not of the memory
    return f"{'retrieval-' * known.retrieval}recall-{known.sampling}{'-' * bool(step)}{step}"


def evidence_table(every: Iterable[Outcomes]) -> Table:
    """Return the rates where all, some and none of the evidence was kept, where that is known."""
    rows = []
    for outcomes in every:
        kept = outcomes.evidence
        levels = {"all": kept == 1, "some": (kept > 0) & (kept < 1), "none": kept == 0}
        for s, c in np.argwhere(outcomes.has_rows).tolist():
            for name, chosen in levels.items():
                status = np.where(chosen[s, c], outcomes.status[s, c], np.int8(-1))
                rate = rate_of(status)
                if rate.n:
                    cell = (outcomes.simulator, outcomes.systems[s], outcomes.conditions[c], name)
                    rows.append((*cell, rate.n, rate.value, *rate.interval))
    return Table.make(
        "by_evidence_kept",
        "Success by the evidence that the memory kept",
        "simulator system condition kept n:count rate:rate low:rate high:rate",
        rows,
        "kept: whether all, some or none of the lesson's evidence spans have a frame in the memory "
        "at the first step. Rates over the n episodes for which that is known, with 95% Wilson "
        "intervals. The levels have different episodes. If all evidence was kept, a failure is one "
        "of use; if none was, a success is luck or needs no memory.",
    )
