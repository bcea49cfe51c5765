"""What cards tell of data, computed from it: counts, exactness, provenance, limits."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from statistics import mean, median
from typing import Any

from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    DIFFICULTIES,
    FAMILIES,
    IDENTITY_PATH,
    REPORT_PATH,
)
from robomme_interference_data.data.buffer_set import Split
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.schema.conditions import DEFAULT_CONDITIONS
from robomme_interference_data.schema.manifest import BufferManifest
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.storage.files import read_json, sha256_file
from robomme_interference_data.viz.tables import Table

from .contents import questions_of
from .limits import limits
from .markdown import escape
from .publication import check_repo_id, is_commit

LOSSY_SOURCE = "lerobot/robomme"
"""A published dataset of the same episodes whose pictures are lossily compressed."""


@dataclass(frozen=True)
class DatasetFacts:
    """What there is to say of a dataset.

    Attributes:
        dataset: The dataset.
    """

    dataset: Dataset

    @cached_property
    def records(self) -> tuple[EpisodeRecord, ...]:
        """Its episodes, in canonical order."""
        return tuple(sorted(self.dataset.records(), key=lambda one: one.episode_id.sort_key))

    @cached_property
    def identity_sha256(self) -> str:
        """SHA-256 of `meta/interference.json`, under which every file of it lies."""
        return sha256_file(self.dataset.files.path(IDENTITY_PATH))

    @cached_property
    def skipped(self) -> int:
        """Recorded episodes that yielded nothing."""
        told = read_json(self.dataset.files.path(REPORT_PATH)).get("skipped")
        return len(told) if isinstance(told, list) else 0

    @property
    def limits(self) -> list[str]:
        """What demonstrations are not good for; see `limits`."""
        more = (
            f"{self.skipped:,} recorded episodes yielded no demonstration, or were of no use: "
            f"{REPORT_PATH} names each and says why."
        )
        simulators = self.dataset.identity.simulators
        return limits(self.records, simulators, [more] * bool(self.skipped))

    @property
    def frames(self) -> int:
        """Stored frames."""
        return sum(record.length for record in self.records)

    @property
    def families(self) -> tuple[str, ...]:
        """Families of its episodes, in canonical order."""
        return tuple(dict.fromkeys(record.episode_id.family for record in self.records))

    @property
    def inexact(self) -> int:
        """Episodes of which a frame was ever lossily compressed."""
        return sum(not record.exact for record in self.records)

    @property
    def split_name(self) -> str:
        """`test` if all of its episodes are of that split, and so on; `mixed` if they differ."""
        return one_split(record.episode_id.split for record in self.records)

    @property
    def repositories(self) -> dict[str, str | None]:
        """Repositories on the Hub that it was built from, and the commit of each."""
        found: dict[str, str | None] = {}
        for one in self.dataset.identity.sources:
            repo, revision = one.get("repo"), one.get("revision")
            with suppress(InvalidOptionError):  # whoever wrote the data may have written anything
                found[check_repo_id(repo)] = revision if is_commit(revision) else None
        return found

    def counts(self) -> Table:
        """Return how many episodes there are by family and difficulty, and their frames."""
        groups = by_family(self.records)
        rows = [
            (escape(name), len(found), *_difficulties(found), sum(one.length for one in found))
            for name, found in groups.items()
        ]
        rows.append(_total("all", rows))
        columns = "family episodes:count easy:count medium:count hard:count other:count"
        return Table.make("counts", "Episodes", f"{columns} frames:count", rows)

    def goals(self) -> Table:
        """Return the goal of the first episode of each family."""
        rows = [
            (escape(found[0].episode_id), escape(found[0].difficulty or ""), escape(found[0].goal))
            for found in by_family(self.records).values()
        ]
        return Table.make("goals", "Goals", "episode difficulty goal", rows)


@dataclass(frozen=True)
class SplitFacts:
    """What there is to say of a split.

    Attributes:
        split: The split.
    """

    split: Split

    @cached_property
    def datasets(self) -> dict[str, DatasetFacts]:
        """Its datasets by name."""
        return {name: DatasetFacts(one) for name, one in self.split.datasets.items()}

    @property
    def demonstrations(self) -> DatasetFacts:
        """The query episodes and their lessons."""
        return self.datasets[DEMONSTRATIONS]

    @property
    def base(self) -> str | None:
        """Where the demonstrations lie on the Hub, `namespace/name@commit`, if they do."""
        return self.split.header.datasets[DEMONSTRATIONS].place

    @property
    def units(self) -> dict[str, DatasetFacts]:
        """The datasets of units by name."""
        return {name: one for name, one in self.datasets.items() if name != DEMONSTRATIONS}

    @cached_property
    def queries(self) -> tuple[EpisodeRecord, ...]:
        """The query episodes, in canonical order."""
        wanted = {*self.split.episode_ids}
        return tuple(one for one in self.demonstrations.records if one.episode_id in wanted)

    @cached_property
    def manifests(self) -> tuple[BufferManifest, ...]:
        """All buffers."""
        return tuple(self.split.manifests())

    @property
    def questions(self) -> bool:
        """Whether it has questions about the past."""
        return bool(questions_of(self.split))

    @property
    def split_name(self) -> str:
        """`test` if all queries are of that split, and so on; `mixed` if they differ."""
        return one_split(record.episode_id.split for record in self.queries)

    @property
    def units_split(self) -> str:
        """The same of the units."""
        every = (record for one in self.units.values() for record in one.records)
        return one_split(record.episode_id.split for record in every)

    @property
    def inexact(self) -> int:
        """Buffers that hold a lossily compressed frame."""
        return sum(not one.exact for one in self.manifests)

    @property
    def repositories(self) -> dict[str, str | None]:
        """See `DatasetFacts.repositories`."""
        found: dict[str, str | None] = {}
        for one in self.datasets.values():
            found |= one.repositories
        return found

    @property
    def simulators(self) -> tuple[str, ...]:
        """Simulators that episodes come from."""
        every = (name for one in self.datasets.values() for name in one.dataset.identity.simulators)
        return tuple(sorted(set(every)))

    @property
    def limits(self) -> list[str]:
        """What the split is not good for; see `limits`."""
        more = (
            f"{self.same_family:,} buffers hold distractors of the query's own family, which the "
            "paper's protocol rules out: results stand beside none of the benchmark."
        )
        return limits(self.queries, self.simulators, [more] * bool(self.same_family))

    @cached_property
    def same_family(self) -> int:
        """Buffers with a session that is no lesson, and yet of the query's own family."""
        return sum(
            any(
                session.role == "distractor" and session.source.family == one.episode_id.family
                for session in one.sessions
            )
            for one in self.manifests
        )

    def counts(self) -> Table:
        """Return how many queries there are by family and difficulty, and units by family."""
        queries, units = by_family(self.queries), self._units()
        names = sorted({*queries, *units}, key=_family_rank)
        rows = []
        for name in names:
            found = queries.get(name, [])
            rows.append((escape(name), len(found), *_difficulties(found), units[name]))
        rows.append(_total("all", rows))
        columns = "family queries:count easy:count medium:count hard:count other:count units:count"
        return Table.make("counts", "Queries and units", columns, rows)

    def conditions(self) -> Table:
        """Return what the buffers of each condition hold."""
        groups: dict[str, list[BufferManifest]] = {name: [] for name in self.split.conditions}
        for one in self.manifests:
            groups.setdefault(one.condition, []).append(one)
        rows = []
        for name, found in groups.items():
            frames = [one.history_frames for one in found] or [0]
            rows.append(
                (
                    *(escape(name), "paper" if name in DEFAULT_CONDITIONS else "ours"),
                    *(len(found), max((len(one.sessions) for one in found), default=0)),
                    *(min(frames), round(median(frames)), max(frames)),
                    mean(one.lesson_share for one in found) if found else None,
                )
            )
        columns = "condition whose buffers:count sessions:count min:count median:count max:count"
        return Table.make("conditions", "Conditions", f"{columns} lesson_share:rate", rows)

    def _units(self) -> Counter[str]:
        families = (
            record.episode_id.family for one in self.units.values() for record in one.records
        )
        return Counter(families)


def one_split(splits: Iterable[str]) -> str:
    """Return the one split that episodes are of, or `mixed`: the name under which rows load."""
    found = {*splits}
    return found.pop() if len(found) == 1 else "mixed"


def by_family(records: Iterable[EpisodeRecord]) -> dict[str, list[EpisodeRecord]]:
    """Return records by family, in canonical order."""
    groups = defaultdict[str, list[EpisodeRecord]](list)
    for record in records:
        groups[record.episode_id.family].append(record)
    return {name: groups[name] for name in sorted(groups, key=_family_rank)}


def _difficulties(records: Sequence[EpisodeRecord]) -> tuple[int, ...]:
    counts = Counter(record.difficulty for record in records)
    known = [counts[name] for name in DIFFICULTIES]
    return (*known, len(records) - sum(known))


def _total(name: str, rows: Sequence[tuple[Any, ...]]) -> tuple[Any, ...]:
    return (name, *(sum(column) for column in list(zip(*rows, strict=True))[1:]))


def _family_rank(name: str) -> tuple[int, str]:
    return (FAMILIES.index(name) if name in FAMILIES else len(FAMILIES), name)


def kinds_of_sources(facts: Iterable[DatasetFacts]) -> list[str]:
    """Return the kinds of the sources that datasets were built from, such as `robomme-h5`."""
    every = (one.get("kind") for own in facts for one in own.dataset.identity.sources)
    return sorted({kind for kind in every if isinstance(kind, str)})
