"""The ceiling of a memory rule: success of an observer that uses marked evidence only.

The ideal observer (`recall`) knows the parts of the answer of whose evidence its memory keeps a
frame, and draws one of the answers that agree. Its expected success is 1 / (agreeing answers), a
function of manifests and records: nothing is decoded or simulated, and there is no rollout.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from robomme_interference_data.constants import ABILITIES
from robomme_interference_data.data.buffer import Buffer
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.query import Query
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.retrieval.grade import ALL
from robomme_interference_data.retrieval.stored_selector import StoredSelector
from robomme_interference_data.schema.conditions import NO_HISTORY, in_order
from robomme_interference_data.schema.evidence import known_parts
from robomme_interference_data.schema.sampling import Memory, evidence_kept
from robomme_interference_data.schema.shifts import NO_SHIFT, parse_shift
from robomme_interference_data.simulators.registry import recorded_scene
from robomme_interference_data.viz.tables import Table

from .run.config import CeilingConfig, check_retrieval, with_camera
from .run.plan import nothing_to_retrieve

_Kept = tuple[float | None, float | None]
"""Share of the evidence that a memory keeps, and the ideal observer's chance."""


@dataclass(frozen=True)
class Ceiling:
    """Means over some of the queries under one condition.

    Attributes:
        part: Which queries they are: those of a family or of an ability, or `ALL`.
        condition: Name of the condition.
        queries: Number of queries.
        evidence_kept: Mean share of the lesson's evidence spans of which the memory keeps a frame,
            over the queries whose lesson is given and whose evidence is known; None without any.
        success: Mean chance that the ideal observer succeeds, over the queries whose possible
            answers are known; None without any.
    """

    part: str
    condition: str
    queries: int
    evidence_kept: float | None
    success: float | None


def ceiling(buffer_set: BufferSet, config: CeilingConfig) -> list[Ceiling]:
    """Return the ceiling of a memory on a buffer set, by part and condition."""
    memory = Memory.parse(config.memory)
    if config.frames < 1:
        raise InvalidOptionError.expected("frames", config.frames, "1 or more")
    check_retrieval(config)
    config = with_camera(config, buffer_set)
    if config.shift != NO_SHIFT and config.retrieval is None:
        raise InvalidOptionError(
            f"the shift {config.shift} has no effect without a retrieval step",
            'Set one, such as retrieval="thumbnail", or leave the shift out.',
        )
    if config.retrieval is not None and NO_HISTORY in config.conditions:
        raise nothing_to_retrieve(
            f"Leave {NO_HISTORY} out: its ceiling is that of the memory without retrieval."
        )
    queries_with_evidence(buffer_set)
    names = [condition.name for condition in in_order(config.conditions or buffer_set.conditions)]
    buffer_set.check_tables(names)
    cells: dict[tuple[str, str], list[_Kept]] = {}
    for name in names:
        for buffer in buffer_set.buffers(condition=name):
            received = _received(buffer_set, buffer, config)
            if received is None:
                continue
            kept = _kept(buffer, memory, received, config.frames)
            for part in (buffer.episode_id.family, buffer.query.record.ability, ALL):
                if part is not None:
                    cells.setdefault((part, buffer.condition), []).append(kept)
    ceilings = []
    for part in (*buffer_set.families, *ABILITIES, ALL):
        for name in names:
            queries = cells.get((part, name))
            if queries:
                shares, chances = zip(*queries, strict=True)
                ceilings.append(Ceiling(part, name, len(queries), _mean(shares), _mean(chances)))
    return ceilings


def queries_with_evidence(buffer_set: BufferSet) -> list[Query]:
    """Return the queries for which the lesson frames that show the answer are known.

    Raises:
        InvalidOptionError: There is none.
    """
    queries = [buffer_set.query(episode) for episode in buffer_set.episode_ids]
    known = [query for query in queries if query.record.evidence is not None]
    if not known:
        raise InvalidOptionError(
            f"the frames of {buffer_set.location} that show the answer are unknown",
            "Build it from a source with evidence: see docs/reference/sources.md.",
        )
    return known


def _kept(buffer: Buffer, memory: Memory, received: Sequence[int], frames: int) -> _Kept:
    """Return what a memory keeps at the first step, of the frames that it received of a buffer.

    A part of the answer is known from that many kept `frames` on.
    """
    if buffer.evidence is None:
        return None, None
    kept = memory.kept(received)
    first_counts = buffer.query.first_counts
    known = known_parts(buffer.evidence, kept, frames, first_counts=first_counts)
    success = chance(buffer.query, known)
    return evidence_kept(buffer.evidence, kept), success


def chance(query: Query, known: dict[int, str]) -> float | None:
    """Return the chance of a draw among the answers that agree with what is known to be right.

    In a day, where some queries have no lesson, an observer that knows nothing does nothing.
    """
    spans, scene = query.record.evidence, recorded_scene(query)
    if spans is None or scene is None:
        return None
    if query.record.ability is not None and (not known or query.record.ability == "absent"):
        return float(query.record.ability == "absent" and not known)
    # All parts together leave one answer.
    [right] = scene.agreeing({span.part: span.text for span in spans})
    agreeing = scene.agreeing(known)
    # 0 where a contradicting lesson rules out the right answer.
    return (right in agreeing) / len(agreeing)


def _received(buffer_set: BufferSet, buffer: Buffer, config: CeilingConfig) -> Sequence[int] | None:
    """Return the frames that the memory gets; None if a retrieval step has no history."""
    if config.retrieval is None:
        return range(len(buffer))
    if not len(buffer):
        return None
    step = StoredSelector(
        config.retrieval, rule=config.retrieval_rule, camera=config.retrieval_camera
    )
    return step.select(buffer_set, buffer, parse_shift(config.shift)).tolist()


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def ceiling_table(cells: Sequence[Ceiling], title: str) -> Table:
    """Return the table for the terminal."""
    return Table(
        "ceiling",
        title,
        {
            "part": "text",
            "condition": "text",
            "queries": "count",
            "evidence_kept": "rate",
            "expected_success": "rate",
        },
        [(c.part, c.condition, c.queries, c.evidence_kept, c.success) for c in cells],
        "evidence kept: mean share of the lesson's evidence spans of which the memory keeps a "
        "frame at the first step, empty without a lesson; expected success: of the ideal observer "
        "(recall), which knows these parts of the answer and draws one of the answers that agree. "
        "Empty where unknown.",
    )
