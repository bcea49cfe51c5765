"""Audit the distractors of a split: how units are used, and whether anything leaks."""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

from robomme_interference_data.constants import CAMERA_PREFIX, DEMONSTRATIONS, DISTRACTORS
from robomme_interference_data.dataset import Dataset
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema import BufferManifest

__all__ = ["Audit", "Leak", "audit_split"]


@dataclass(frozen=True)
class Leak:
    """Material in a buffer or pool that tells more, or other, than a distractor may.

    Attributes:
        kind: `same family`, `repeated unit`, `not a train episode`, `same scene` or
            `identical frames`.
        where: The buffer or the episodes.
    """

    kind: str
    where: str


@dataclass
class Audit:
    """How often what is used.

    Attributes:
        units: For each k, how often each unit of the pool is used over all queries, 0 included.
        positions: For each place after the lesson (from 1), how often each family stands there,
            over the buffers with the largest k.
        leaks: All leaks found.
    """

    units: dict[int, dict[EpisodeId, int]]
    positions: dict[int, Counter[str]] = field(default_factory=dict)
    leaks: list[Leak] = field(default_factory=list)

    def usage(self, k: int) -> dict[str, float]:
        """Return minimum, mean and maximum uses of a unit, and how many are unused, at one k."""
        counts = list(self.units[k].values())
        return {
            "min": min(counts),
            "mean": sum(counts) / len(counts),
            "max": max(counts),
            "unused": counts.count(0),
        }

    def family_usage(self, k: int) -> dict[str, dict[str, float]]:
        """Return the same by family of the unit."""
        families: dict[str, list[int]] = {}
        for unit, count in self.units[k].items():
            families.setdefault(unit.family, []).append(count)
        return {
            family: {
                "units": len(counts),
                "min": min(counts),
                "mean": sum(counts) / len(counts),
                "max": max(counts),
            }
            for family, counts in sorted(families.items())
        }

    def as_dict(self) -> dict[str, Any]:
        """Return the audit as plain values, for JSON."""
        return {
            "usage": {str(k): self.usage(k) for k in self.units},
            "families": self.family_usage(max(self.units)),
            "positions": {
                str(place): dict(sorted(counts.items()))
                for place, counts in sorted(self.positions.items())
            },
            "units": {str(u): n for u, n in sorted(self.units[max(self.units)].items())},
            "leaks": [{"kind": leak.kind, "where": leak.where} for leak in self.leaks],
        }


def audit_split(
    manifests: Iterable[BufferManifest], datasets: dict[str, Dataset], k_values: tuple[int, ...]
) -> Audit:
    """Count the use of units and look for leaks.

    Args:
        manifests: All buffers of the split.
        datasets: Its `demonstrations` and `distractors`.
        k_values: The planned numbers of distractor sessions.
    """
    pool = [record.id for record in datasets[DISTRACTORS].records()]
    audit = Audit({k: dict.fromkeys(pool, 0) for k in k_values})
    audit.leaks += _pool_leaks(datasets)
    for manifest in manifests:
        audit.leaks += _buffer_leaks(manifest)
        others = [session for session in manifest.sessions if session.role != "lesson"]
        uses = audit.units.setdefault(manifest.k, dict.fromkeys(pool, 0))
        for place, session in enumerate(others, 1):
            uses[session.source] = uses.get(session.source, 0) + 1
            if manifest.k == max(k_values):
                audit.positions.setdefault(place, Counter())[session.family] += 1
    return audit


def _buffer_leaks(manifest: BufferManifest) -> Iterator[Leak]:
    name = f"{manifest.episode_id} at k={manifest.k}"
    distractors = [session for session in manifest.sessions if session.role == "distractor"]
    for session in distractors:
        if manifest.family in (session.family, session.source.family):
            yield Leak("same family", f"{name}: {session.source}")
        if session.source.split != "train":
            yield Leak("not a train episode", f"{name}: {session.source}")
    for source, count in Counter(session.source for session in distractors).items():
        if count > 1:
            yield Leak("repeated unit", f"{name}: {source}, {count} times")


def _pool_leaks(datasets: dict[str, Dataset]) -> Iterator[Leak]:
    units = list(datasets[DISTRACTORS].records())
    queries = list(datasets[DEMONSTRATIONS].records())
    for unit in units:
        if unit.id.split != "train":
            yield Leak("not a train episode", f"unit {unit.id}")
    # The same scene under another split or number: official seeds name the scene.
    scenes = {
        (query.simulator, query.id.family, query.seed): query.id
        for query in queries
        if query.seed is not None and query.id.split == "test"
    }
    for unit in units:
        query = (
            None if unit.seed is None else scenes.get((unit.simulator, unit.id.family, unit.seed))
        )
        if query is not None:
            yield Leak("same scene", f"unit {unit.id} and query {query} (seed {unit.seed})")
    for records in (units, queries):
        seen: dict[tuple[str, str], EpisodeId] = {}
        for record in records:
            for feature, digest in record.feature_sha256.items():
                if feature.startswith(CAMERA_PREFIX):
                    first = seen.setdefault((feature, digest), record.id)
                    if first != record.id:
                        yield Leak("identical frames", f"{first} and {record.id} ({feature})")
