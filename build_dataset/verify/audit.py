"""Audit the distractors of a buffer set: the use of units, and leaks."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from statistics import mean
from typing import Any

from robomme_interference_data.constants import (
    CAMERA_PREFIX,
    CONTRADICTIONS,
    DAYS,
    DEMONSTRATIONS,
    DISTRACTORS,
    MANIFEST_PATH,
)
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.errors import FormatError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.conditions import KINDS, ConditionKind, parse_condition
from robomme_interference_data.schema.manifest import BufferManifest, SessionEntry
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.viz.tables import Columns, Table


@dataclass(frozen=True)
class Leak:
    """Content of a buffer or of the pool that reveals more than a distractor may; its location."""

    kind: str
    where: str


@dataclass
class Audit:
    """Use of units by condition over all queries, and leaks.

    `uses` has the uses of each unit, `positions` those of each family at each position (from 1)
    among the units of a buffer.
    """

    uses: dict[str, dict[EpisodeId, int]]
    positions: dict[str, dict[int, Counter[str]]] = field(default_factory=dict)
    leaks: list[Leak] = field(default_factory=list)

    @property
    def fullest(self) -> str:
        """The condition whose buffers hold the most units."""
        return max(self.uses, key=lambda name: len(self.positions.get(name, {})))

    def tables(self) -> tuple[Table, Table]:
        """Return the uses of a unit by condition, and the families at each position."""
        counts: Columns = {"units": "count", "min": "count", "mean": "ratio", "max": "count"}
        rows = [(name, *_usage(uses.values())) for name, uses in self.uses.items()]
        columns: Columns = {"condition": "text"}
        columns |= counts
        columns["unused"] = "count"
        uses = Table("uses", "Uses of a unit", columns, rows)
        positions = self.positions.get(self.fullest, {})
        families: dict[str, list[int]] = {}
        for unit, count in sorted(self.uses[self.fullest].items()):
            families.setdefault(unit.family, []).append(count)
        columns = {"family": "text"}
        columns |= counts
        columns |= {str(position): "count" for position in sorted(positions)}
        mix = [
            (
                family,
                *_usage(used)[:4],
                *(positions[position][family] for position in sorted(positions)),
            )
            for family, used in families.items()
        ]
        return uses, Table(
            "families",
            f"Families of the units under {self.fullest}",
            columns,
            mix,
            "Columns 1, 2, …: buffers with the family at that position among their units.",
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the audit as plain values, for JSON."""
        uses, families = self.tables()
        return {
            "uses": uses.records(),
            "families": families.records(),
            "units": {str(unit): n for unit, n in sorted(self.uses[self.fullest].items())},
            "leaks": [asdict(leak) for leak in self.leaks],
        }


def _usage(counts: Any) -> tuple[Any, ...]:
    numbers = list(counts)
    return len(numbers), min(numbers), mean(numbers), max(numbers), numbers.count(0)


def audit_buffer_set(buffer_set: BufferSet) -> Audit:
    """Count the use of units and look for leaks."""
    units = list(buffer_set.datasets[DISTRACTORS].records())
    queries = list(buffer_set.datasets[DEMONSTRATIONS].records())
    pool = sorted(unit.episode_id for unit in units)
    audit = Audit({name: dict.fromkeys(pool, 0) for name in buffer_set.conditions})
    audit.leaks += _pool_leaks(units, queries)
    for manifest in buffer_set.manifests():
        uses = audit.uses.get(manifest.condition)
        if uses is None:
            path = buffer_set.files.path(MANIFEST_PATH)
            raise FormatError.damaged(path, f"{manifest.condition} is not among its conditions")
        positions = audit.positions.setdefault(manifest.condition, {})
        drawn: Counter[EpisodeId] = Counter()
        kind = parse_condition(manifest.condition).kind
        for session in manifest.sessions:
            where = f"{manifest}: {session.source}"
            if session.dataset == DAYS:  # tasks are no units: what a day holds is planned
                if session.source.split not in ("train", manifest.episode_id.split):
                    audit.leaks.append(Leak("of another split", where))
                continue
            if session.source.split != "train" and not _is_query(session, manifest, kind):
                audit.leaks.append(Leak("not a train episode", where))
            if session.role != "distractor":
                continue
            same = manifest.episode_id.family in (session.family, session.source.family)
            if same != kind.own_family:
                audit.leaks.append(Leak("same family" if same else "other family", where))
            if session.source in drawn:
                audit.leaks.append(Leak("repeated unit", where))
            uses[session.source] = uses.get(session.source, 0) + 1
            drawn[session.source] += 1
            positions.setdefault(drawn.total(), Counter())[session.family] += 1
    return audit


def _is_query(session: SessionEntry, manifest: BufferManifest, kind: ConditionKind) -> bool:
    """Return whether a session shows the query's scene, as its kind of condition permits."""
    role, source = session.role, session.source
    if role == "contradiction":
        return CONTRADICTIONS in kind.needs and (
            source.answer is not None and source.scene == manifest.episode_id
        )
    held = role == "filler" and kind is KINDS["held"]
    return (role == "lesson" or held) and source == manifest.episode_id


def _pool_leaks(units: Sequence[EpisodeRecord], queries: Sequence[EpisodeRecord]) -> Iterator[Leak]:
    for unit in units:
        if unit.episode_id.split != "train":
            yield Leak("not a train episode", f"unit {unit.episode_id}")
    # Official seeds identify a scene across splits and numbers.
    scenes: dict[tuple[str | None, str, int | None], EpisodeId] = {
        (query.simulator, query.episode_id.family, query.seed): query.episode_id
        for query in queries
        if query.seed is not None and query.episode_id.split == "test"
    }
    for unit in units:
        scene = scenes.get((unit.simulator, unit.episode_id.family, unit.seed))
        if scene is not None:
            where = f"unit {unit.episode_id} and query {scene} (seed {unit.seed})"
            yield Leak("same scene", where)
    for records in (units, queries):
        seen: dict[tuple[str, str], EpisodeId] = {}
        for record in records:
            for feature, digest in record.feature_sha256.items():
                if feature.startswith(CAMERA_PREFIX):
                    first = seen.setdefault((feature, digest), record.episode_id)
                    if first != record.episode_id:
                        where = f"{first} and {record.episode_id} ({feature})"
                        yield Leak("identical frames", where)
