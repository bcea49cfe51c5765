"""What readers of a comparison of runs must know: what differs, is left out, or flips by chance."""

from collections.abc import Iterable, Iterator, Mapping, Sequence

from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.stats.intervals import wilson
from robomme_interference_data.viz.tables import percent

from .rows.reading import CheckedRows
from .sides import Side
from .tables.pairs import Pairs


def differing(
    rows: CheckedRows, other_rows: CheckedRows, matched: Iterable[tuple[Side, Side]]
) -> Iterator[str]:
    """Yield notes on what differs between two runs: shifts, and revisions of buffer sets."""
    names = dict.fromkeys((a.outcomes.simulator, b.outcomes.simulator) for a, b in matched)
    for first, second in names:
        if first != second:
            yield (
                f"a is of {first} and b of {second}: the scenes are the same, and the difference "
                "is the effect of the shift."
            )
        revisions = [rows.revisions.get(first), other_rows.revisions.get(second)]
        if any(simulator == first for simulator, _ in rows.scenes):
            continue  # of another benchmark, whose scenes are known to be the same
        if rows is not other_rows and revisions == [None, None]:
            yield f"The rows of {first} name no revision of a buffer set: the histories may differ."
        elif revisions[0] != revisions[1]:
            named = " and ".join(revision or "unknown" for revision in revisions)
            yield (
                f"The rows of {first} are of different buffer sets (revisions {named}): the "
                "histories may differ."
            )


def noise_floor(a: Side, b: Side, pairs: Mapping[str, Pairs]) -> Iterator[str]:
    """Yield a note on the share of episodes that flip between two runs of a system, if any."""
    shares = []
    for condition, compared in pairs.items():
        if compared.pairs:
            low, high = wilson(compared.gained + compared.lost, compared.pairs)
            shares.append(
                f"{condition} {percent(compared.flips)} of {compared.pairs} "
                f"(95% interval {100 * low:.1f} to {100 * high:.1f})"
            )
    if not shares:
        return
    seeds, other_seeds = (
        {repeat.model_seed for repeat in side.outcomes.repeats} for side in (a, b)
    )
    if seeds == other_seeds:
        which = "the same"
    else:
        which = "partly other" if seeds & other_seeds else "other"
    yield (
        f"{a.system} ran in both, with {which} model seeds, in "
        f"{a.outcomes.simulator}. If nothing else differs, this share of episodes flips by chance "
        f"(the noise floor): {', '.join(shares)}."
    )


def stopped_early(name: str, sides: Iterable[Side]) -> Iterator[str]:
    """Yield a note on planned episodes of a run that do not count, if any."""
    lacking = []
    for side in sides:
        for condition, planned in side.planned.items():
            count = len(planned - side.counted(condition))
            if count:
                lacking.append(
                    f"{side.system} in {side.outcomes.simulator}, {condition} "
                    f"({count:,} of {len(planned):,})"
                )
    if lacking:
        yield (
            f"{name} was stopped early, is still running, or broke in part; planned episodes that "
            f"do not count: {'; '.join(lacking)}. Looking again and again finds too much: plan the "
            "looks (--looks)."
        )


def left_out(
    name: str, sides: Iterable[Side], matched: Mapping[Side, Side], conditions: Sequence[str]
) -> Iterator[str]:
    """Yield a note on the episodes of a run that the comparison leaves out, if any."""
    listed = []
    for side in sides:
        other = matched.get(side)
        lone = []
        both = [tuple(conditions)] if conditions else [(c, c) for c in side.conditions]
        for here, there in both:
            counted_there = set[EpisodeId]() if other is None else other.counted(there)
            count = len(side.counted(here) - counted_there)
            if count:
                lone.append(f"{here} ({count:,})")
        if lone:
            listed.append(f"{side.system} in {side.outcomes.simulator}, {', '.join(lone)}")
    if listed:
        yield f"Only in {name}, and left out (episodes): {'; '.join(listed)}."


def below_table(runs: Sequence[CheckedRows], look: tuple[int, int], alpha: float) -> Iterator[str]:
    """Yield what the note of the table states of looks, and of files that have no plan."""
    number, planned = look
    if planned > 1:
        yield (
            f"Look {number} of {planned} (alpha spending like O'Brien and Fleming's boundaries): "
            f"a difference is significant if p holm is below {alpha:.2g}, and intervals have the "
            f"level {1 - alpha:.4%}."
        )
    unplanned = dict.fromkeys(
        str(path) for rows in runs for path, run in rows.sources.items() if not run
    )
    if unplanned:
        yield (
            "Without the record of a run, complete means all episodes that occur: "
            f"{', '.join(unplanned)}."
        )
