"""What a memory rule leaves of the answer: the ceiling of every policy with it, without a rollout.

The ideal observer (`recall`) knows the parts of the answer of whose evidence its memory keeps a
frame, and draws one of the answers that agree. So its expected success is 1 / (agreeing answers),
and follows from manifests and records alone; nothing is decoded, nor simulated.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from robomme_interference_data.data.buffer import Buffer
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.query import Query
from robomme_interference_data.data.views import live_embedding
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.retrieval.encoders import encoder_name, published_threshold
from robomme_interference_data.retrieval.grade import ALL
from robomme_interference_data.retrieval.select import Rule, choose, measure
from robomme_interference_data.schema.conditions import NO_HISTORY, in_order
from robomme_interference_data.schema.evidence import known_parts
from robomme_interference_data.schema.sampling import MEMORIES, check_memory, evidence_kept
from robomme_interference_data.schema.shifts import NO_SHIFT, parse_shift
from robomme_interference_data.simulators.registry import recorded_scene
from robomme_interference_data.viz.tables import Table

from .run.config import CeilingConfig, non_default_retrieval


@dataclass(frozen=True)
class Left:
    """What a memory keeps of the answer of one buffer.

    Attributes:
        family: Of the query.
        condition: Name of the condition.
        evidence_kept: Share of the lesson's evidence spans of which it keeps a frame; None without
            a lesson, and where evidence is unknown.
        success: Chance that the ideal observer succeeds; None where the answers that agree with
            what is known are not known themselves.
    """

    family: str
    condition: str
    evidence_kept: float | None
    success: float | None


@dataclass(frozen=True)
class Ceiling:
    """Means over the queries of a family, or of `ALL`, under one condition.

    Attributes:
        queries: How many there are.
        evidence_kept, success: Means of what `Left` has, over the queries that have it; None if
            none has.
    """

    family: str
    condition: str
    queries: int
    evidence_kept: float | None
    success: float | None


def ceiling(buffer_set: BufferSet, config: CeilingConfig) -> list[Ceiling]:
    """Return the ceiling of a memory on a buffer set, by family and condition, and of all families."""
    check_memory(config.memory, "ceiling")
    non_default_retrieval(config)
    if config.shift != NO_SHIFT and config.retrieval is None:
        raise InvalidOptionError(
            f"the shift {config.shift} says nothing without a retrieval step: memories do not look",
            "Add one, such as retrieval='thumbnail', or leave it out.",
        )
    if config.retrieval is not None and NO_HISTORY in config.conditions:
        raise InvalidOptionError(
            f"a retrieval step has nothing to retrieve from under {NO_HISTORY}",
            f"Leave {NO_HISTORY} out: the ceiling there is that of the memory without retrieval.",
        )
    if all(buffer_set.query(one).record.evidence is None for one in buffer_set.episode_ids):
        raise InvalidOptionError(
            f"it is unknown which frames of {buffer_set.location} show the answer",
            "Build it from a source with evidence: see docs/sources.md.",
        )
    names = [one.name for one in in_order(config.conditions or buffer_set.conditions)]
    found = [
        what_is_left(buffer, config.memory, frames)
        for name in names
        for buffer in buffer_set.buffers(condition=name)
        if (frames := _given(buffer_set, buffer, config)) is not None
    ]
    return [*_cells(found, buffer_set.families), *_cells(found, (ALL,))]


def what_is_left(buffer: Buffer, memory: str, frames: Sequence[int]) -> Left:
    """Return what a memory keeps of the answer at the first step, given frames of a buffer."""
    told = buffer.episode_id.family, buffer.condition
    if buffer.evidence is None:
        return Left(*told, None, None)
    kept = [frames[place] for place in MEMORIES[memory](len(frames))]
    success = chance(buffer.query, known_parts(buffer.evidence, kept))
    return Left(*told, evidence_kept(buffer.evidence, kept), success)


def chance(query: Query, known: dict[int, str]) -> float | None:
    """Return the chance of a draw among the answers that agree with what is known to be right."""
    spans, scene = query.record.evidence, recorded_scene(query)
    if spans is None or scene is None:
        return None
    [right] = scene.agreeing({span.part: span.text for span in spans})
    left = scene.agreeing(known)
    return (right in left) / len(left)


def _given(buffer_set: BufferSet, buffer: Buffer, config: CeilingConfig) -> Sequence[int] | None:
    """Return the frames that the memory is given; None where there is nothing to retrieve from."""
    if config.retrieval is None:
        return range(len(buffer))
    if not len(buffer):
        return None
    name = encoder_name(config.retrieval)
    rule = Rule.parse(config.retrieval_rule, published_threshold(name))
    under, camera = parse_shift(config.shift), config.retrieval_camera
    seen = live_embedding(buffer_set, buffer, under, name, camera)
    return choose(measure(buffer, name, camera, seen), rule).frames.tolist()


def _cells(found: Sequence[Left], families: Iterable[str]) -> Iterator[Ceiling]:
    for family in families:
        groups: dict[str, list[Left]] = {}
        for one in found:
            if family in (ALL, one.family):
                groups.setdefault(one.condition, []).append(one)
        for condition, those in groups.items():
            kept = _mean(one.evidence_kept for one in those)
            success = _mean(one.success for one in those)
            yield Ceiling(family, condition, len(those), kept, success)


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def ceiling_table(cells: Sequence[Ceiling], title: str) -> Table:
    """Return the table for the terminal."""
    return Table.make(
        "ceiling",
        title,
        "family condition queries:count evidence_kept:rate expected_success:rate",
        ((c.family, c.condition, c.queries, c.evidence_kept, c.success) for c in cells),
        "evidence kept: mean share of the lesson's evidence spans of which the memory keeps a "
        "frame at the first step; expected success: of the ideal observer (recall), which knows "
        "these parts of the answer and draws one of those that agree. Empty where unknown; "
        "evidence kept also where the history holds no lesson.",
    )
