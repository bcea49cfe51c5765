"""Which buffers a buffer set plans next, given those that it plans now and a request. Pure rules.

What is planned stays planned: published results and running evaluations refer to it.
"""

from collections.abc import Collection
from dataclasses import dataclass

from robomme_interference_data.build_dataset.config import BuffersConfig, parse_position_limit
from robomme_interference_data.constants import POSITION_LIMIT, RULE_VERSION
from robomme_interference_data.errors import InvalidOptionError, counted, named
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.conditions import (
    DEFAULT_CONDITIONS,
    Condition,
    in_order,
    parse_condition,
)

from .planned import PlannedBuffers


@dataclass(frozen=True)
class NextBuffers:
    """The buffers that a buffer set plans next, and how they differ from the present ones.

    Attributes:
        conditions: The conditions, in the order of tables.
        seed: Seed of the draw of distractor units.
        position_limit: Most positions of history and rollout; None for no limit.
        added: Conditions that are not planned now.
        dropped: Conditions that are planned now, but not next.
        redrawn: Conditions that stay, whose buffers get other units.
        dropped_queries: Query episodes whose buffers are planned now, but not next.
    """

    conditions: tuple[Condition, ...]
    seed: int
    position_limit: int | None
    added: tuple[str, ...] = ()
    dropped: tuple[str, ...] = ()
    redrawn: tuple[str, ...] = ()
    dropped_queries: tuple[EpisodeId, ...] = ()

    @property
    def loses(self) -> bool:
        """Whether buffers that are planned now would be gone or hold other units."""
        return bool(self.dropped or self.redrawn or self.dropped_queries)

    def lines(self) -> list[str]:
        """Return what changes, a line each."""
        lines = []
        if self.added:
            lines.append(f"Adds {', '.join(self.added)}")
        if self.dropped:
            lines.append(f"Drops {', '.join(self.dropped)}")
        if self.redrawn:
            lines.append(f"Draws other units for {', '.join(self.redrawn)}")
        if self.dropped_queries:
            number = counted(len(self.dropped_queries), "query episode")
            lines.append(f"Drops {number}, such as {self.dropped_queries[0]}")
        return lines


def next_buffers(
    planned: PlannedBuffers | None,
    request: BuffersConfig,
    *,
    queries: Collection[EpisodeId] | None = None,
    units_change: bool = False,
) -> NextBuffers:
    """Return the next plan: what is planned and what is requested, without what is to be dropped.

    Args:
        planned: The present plan; None if there is none.
        request: The requested change.
        queries: The query episodes that the demonstrations will hold; None for at least the present
            ones.
        units_change: Whether the distractors will hold other units than the present plan drew from.

    Raises:
        InvalidOptionError: A condition to be dropped is requested too, or is not planned.
    """
    dropped = {parse_condition(name).name for name in request.drop}
    requested = [condition.name for condition in in_order(request.conditions or DEFAULT_CONDITIONS)]
    if request.position_limit is not None:
        limit = parse_position_limit(request.position_limit)
    else:
        limit = POSITION_LIMIT if planned is None else planned.header.position_limit
    if planned is None:
        if dropped:
            raise InvalidOptionError(
                f"{named('drop', ','.join(sorted(dropped)))}: no condition is planned yet",
                "Leave it out.",
                option="drop",
            )
        return NextBuffers(in_order(requested), request.seed or 0, limit, tuple(requested))
    header = planned.header
    for name in sorted(dropped - {*header.conditions}):
        raise InvalidOptionError.one_of("drop", name, header.conditions)
    if both := dropped & {*request.conditions}:
        raise InvalidOptionError(
            f"{named('conditions')} and {named('drop')} both name {min(both)}",
            "Name it in one of them.",
            option="drop",
        )
    seed = header.seed if request.seed is None else request.seed
    # All units are drawn by rank among all eligible ones, so one more can change any buffer.
    redraws = units_change or seed != header.seed or header.rule_version != RULE_VERSION
    kept = [name for name in header.conditions if name not in dropped]
    added = [name for name in request.conditions if name not in header.conditions]
    gone = set() if queries is None else planned.queries - {*queries}
    return NextBuffers(
        conditions=in_order([*kept, *added]),
        seed=seed,
        position_limit=limit,
        added=tuple(added),
        dropped=tuple(name for name in header.conditions if name in dropped),
        redrawn=tuple(name for name in kept if redraws and parse_condition(name).k > 0),
        dropped_queries=tuple(sorted(gone)),
    )
