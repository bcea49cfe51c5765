"""Audit the distractors of a buffer set: how units are used, and whether anything leaks."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from statistics import mean
from typing import Any

from robomme_interference_data.constants import (
    CAMERA_PREFIX,
    CONTRADICTIONS,
    DEMONSTRATIONS,
    DISTRACTORS,
    MANIFEST_PATH,
)
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.errors import FormatError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.conditions import KINDS, Kind, parse_condition
from robomme_interference_data.schema.manifest import BufferManifest, SessionEntry
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.viz.tables import Table


@dataclass(frozen=True)
class Leak:
    """Material in a buffer or pool that tells more, or other, than a distractor may.

    Attributes:
        kind: `same family`, `other family`, `repeated unit`, `not a train episode`, `same scene`
            or `identical frames`.
        where: The buffer or the episodes.
    """

    kind: str
    where: str


@dataclass
class Audit:
    """How often what is used.

    Attributes:
        uses: For each condition, how often each unit of the pool is used over all queries, 0
            included.
        places: For each condition, how often each family of a unit stands at each place among
            the units of a buffer, from 1.
        leaks: All leaks found.
    """

    uses: dict[str, dict[EpisodeId, int]]
    places: dict[str, dict[int, Counter[str]]] = field(default_factory=dict)
    leaks: list[Leak] = field(default_factory=list)

    @property
    def fullest(self) -> str:
        """The condition whose buffers hold the most units."""
        return max(self.uses, key=lambda name: len(self.places.get(name, {})))

    def tables(self) -> tuple[Table, Table]:
        """Return the uses of a unit by condition, and the families at each place."""
        counts = "units:count min:count mean:ratio max:count"
        rows = ((name, *_usage(uses.values())) for name, uses in self.uses.items())
        uses = Table.make("uses", "Uses of a unit", f"condition {counts} unused:count", rows)
        places = self.places.get(self.fullest, {})
        families: dict[str, list[int]] = {}
        for unit, count in sorted(self.uses[self.fullest].items()):
            families.setdefault(unit.family, []).append(count)
        numbered = " ".join(f"{place}:count" for place in sorted(places))
        mix = (
            (family, *_usage(found)[:4], *(places[place][family] for place in sorted(places)))
            for family, found in families.items()
        )
        return uses, Table.make(
            "families",
            f"Families of the units under {self.fullest}",
            f"family {counts} {numbered}",
            mix,
            "Columns 1, 2, …: buffers with the family at that place among their units.",
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
    found = list(counts)
    return len(found), min(found), mean(found), max(found), found.count(0)


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
        places = audit.places.setdefault(manifest.condition, {})
        drawn: Counter[EpisodeId] = Counter()
        kind = parse_condition(manifest.condition).kind
        for session in manifest.sessions:
            where = f"{manifest}: {session.source}"
            own = _of_the_query(session, manifest, kind)
            if session.source.split != "train" and not own:  # whatever its role
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
            places.setdefault(drawn.total(), Counter())[session.family] += 1
    return audit


def _of_the_query(session: SessionEntry, manifest: BufferManifest, kind: Kind) -> bool:
    """Whether a session shows the query's own scene, as its kind of condition says it may."""
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
    # The same scene under another split or number: official seeds name the scene.
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
