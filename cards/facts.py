"""What cards say of data, computed from it: counts, exactness, sources, limits."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    MANIFEST_ROWS,
    MANIFESTS,
    QUESTIONS_PATH,
    RECORDS_PATH,
    REPORT_PATH,
    SUMS_PATH,
)
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.data.questions import Question
from robomme_interference_data.errors import FormatError, InvalidOptionError, MissingFileError
from robomme_interference_data.schema.conditions import DEFAULT_CONDITIONS, parse_condition
from robomme_interference_data.schema.manifest import BufferManifest
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.storage.files import read_json, sha256_file

from .film import film_of_buffer_set, film_of_lesson
from .markdown import code
from .publication import Publication
from .sources import (
    Rows,
    data_limits,
    dataset_rows,
    repositories_of,
    source_details,
    source_kinds_of,
)
from .tables import condition_table, count_table, goal_table, unit_table

_BUFFERS = f"{MANIFESTS}/{MANIFEST_ROWS}"
_FILE_SETS = {"frames": "data/*/*.parquet", "videos": "videos/*/*/*.mp4"}


@dataclass(frozen=True)
class CardTable:
    """A table of a repository that `datasets.load_dataset` finds.

    Attributes:
        name: Its name there.
        record: What a row is.
        path: Its file.
        sha256: SHA-256 of the file.
        split: Name under which its rows load: the split that all of their episodes are of, such as
            `test`, or `mixed`.
    """

    name: str
    record: type
    path: str
    sha256: str
    split: str


@dataclass(frozen=True)
class Facts:
    """What a card says of what is published: values computed from data.

    Attributes:
        kind: Name of its template.
        title: What it is, for readers.
        description: The same in a sentence.
        origin: How it was made, in a sentence.
        examples: How many examples it has: stored frames, or rollouts.
        tables: Its tables; the first is the one that loads by default.
        families: Families of its query episodes.
        simulators: Simulators that its episodes come from.
        limits: What it is not good for, as plain text, a sentence or two each.
        provenance: Returns names and values of where it comes from, which are Markdown.
        pictures: Draws the pictures of the card: bytes by path.
        values: What else its template names.
        base: Where what it was made for lies; `namespace/name@commit` if on the Hub.
        repositories: Repositories on the Hub that it was built from, and the commit of each.
        source_kinds: Kinds of the sources that it was built from, such as `robomme-h5`.
        details: Plain values that are shown as JSON, by their titles.
        file_sets: Patterns of its files that are no tables, by name.
        tags: Tags on the Hub beside those of every card.
    """

    kind: str
    title: str
    description: str
    origin: str
    examples: int
    tables: Sequence[CardTable]
    families: Sequence[str]
    simulators: Sequence[str]
    limits: Sequence[str]
    provenance: Callable[[Publication], Rows]
    pictures: Callable[[], Mapping[str, bytes]]
    values: Mapping[str, Any]
    base: object = None
    repositories: Mapping[str, str | None] = field(default_factory=dict)
    source_kinds: Sequence[str] = ()
    details: Mapping[str, Any] = field(default_factory=dict)
    file_sets: Mapping[str, str] = field(default_factory=dict)
    tags: Sequence[str] = ("LeRobot",)


def demonstrations_facts(dataset: Dataset) -> Facts:
    """Return what there is to say of a dataset of demonstrations."""
    if dataset.kind != DEMONSTRATIONS:
        raise InvalidOptionError(
            f"{dataset.files.describe()} is a dataset of {dataset.kind}, not of {DEMONSTRATIONS}",
            "Units are published with the manifests that name them: give the buffer set.",
        )
    records = records_of(dataset)
    film = film_of_lesson(dataset, records)
    frames, skipped = sum(record.length for record in records), _skipped(dataset)
    families = _families(records)
    more = (
        f"{skipped:,} recorded episodes yielded no demonstration, or were of no use: "
        f"{REPORT_PATH} names each and says why."
    )
    return Facts(
        kind=DEMONSTRATIONS,
        title="RoboMME-Interference demonstrations",
        description=f"Demonstrations of RoboMME-Interference: {len(records):,} query episodes, "
        f"{frames:,} frames, families {', '.join(families)}.",
        origin="Recorded episodes were cut, encoded, decoded again and compared.",
        examples=frames,
        tables=[_episodes(dataset, records)],
        families=families,
        simulators=dataset.identity.simulators,
        limits=data_limits(records, dataset.identity.simulators, [more] * bool(skipped)),
        provenance=lambda about: dataset_rows(dataset),
        pictures=film.pictures,
        values={
            "film": film,
            "cameras": dataset.cameras,
            "episodes": len(records),
            "counts": count_table(records),
            "goals": goal_table(records),
            "first": records[0].episode_id,
            "header": None,
            "other_conditions": [],
            "same_family": 0,
            "skipped": skipped,
            "inexact": sum(not record.exact for record in records),
        },
        repositories=repositories_of(dataset),
        source_kinds=source_kinds_of([dataset]),
        details=source_details({DEMONSTRATIONS: dataset}),
        file_sets=_FILE_SETS,
    )


def buffer_set_facts(buffer_set: BufferSet) -> Facts:
    """Return what there is to say of a buffer set."""
    header, datasets = (
        buffer_set.header,
        {name: buffer_set.datasets[name] for name in buffer_set.datasets},
    )
    records = {name: records_of(dataset) for name, dataset in datasets.items()}
    lessons, units = records[DEMONSTRATIONS], {**records}
    del units[DEMONSTRATIONS]
    every_unit = [record for found in units.values() for record in found]
    ids = {*buffer_set.episode_ids}
    queries = tuple(one for one in lessons if one.episode_id in ids)
    manifests = tuple(buffer_set.manifests())
    film = film_of_buffer_set(buffer_set, queries, manifests)
    same_family = count_same_family(manifests)
    simulators = sorted({name for one in datasets.values() for name in one.identity.simulators})
    more = (
        f"{same_family:,} buffers hold distractors of the query's own family, which the "
        "paper's protocol rules out: results stand beside none of the benchmark."
    )
    split_name, questions = one_split(queries), _questions(buffer_set)
    tables = [CardTable("buffers", BufferManifest, _BUFFERS, header.rows, split_name)]
    for name in [*units][:1]:
        own = _episodes(datasets[name], units[name])
        tables.append(replace(own, split=one_split(every_unit)))
    if questions is not None:
        tables.append(CardTable("questions", Question, QUESTIONS_PATH, questions, split_name))

    def provenance(about: Publication) -> Rows:
        rows = [
            ("demonstrations", code(about.base) if about.base else "not published"),
            ("revision of the buffer set", code(buffer_set.revision)),
            (f"SHA-256 of `{_BUFFERS}`", code(header.rows)),
        ]
        rows += [row for name, one in datasets.items() for row in dataset_rows(one, name)]
        return [*rows, ("version of the draw", code(header.rule_version))]

    return Facts(
        kind="buffer_set",
        title="RoboMME-Interference buffers",
        description=f"History buffers of RoboMME-Interference: {len(manifests):,} buffers of "
        f"{len(queries):,} query episodes under {', '.join(buffer_set.conditions)}, and the distractor "
        "units that they hold.",
        origin="The sessions of every buffer were drawn by SHA-256, rule version "
        f"{header.rule_version}, seed {header.seed}.",
        examples=sum(record.length for record in every_unit),
        tables=tables,
        families=_families(queries),
        simulators=simulators,
        limits=data_limits(queries, simulators, [more] * bool(same_family)),
        provenance=provenance,
        pictures=film.pictures,
        values={
            "film": film,
            "cameras": buffer_set.cameras,
            "buffers": len(manifests),
            "queries": len(queries),
            "units": len(every_unit),
            "units_split": one_split(every_unit),
            "conditions": buffer_set.conditions,
            "condition_table": condition_table(buffer_set.conditions, manifests),
            "counts": unit_table(queries, every_unit),
            "goals": goal_table(lessons),
            "questions": questions is not None,
            "first": queries[0].episode_id,
            "header": header,
            "other_conditions": _beyond_paper(buffer_set.conditions),
            "same_family": same_family,
            "skipped": sum(_skipped(datasets[name]) for name in units),
            "inexact": sum(not one.exact for one in manifests),
        },
        base=header.datasets[DEMONSTRATIONS].location,
        repositories={k: v for one in datasets.values() for k, v in repositories_of(one).items()},
        source_kinds=source_kinds_of(datasets.values()),
        details=source_details(datasets),
        file_sets={**_FILE_SETS, "manifest": f"{MANIFESTS}/*.json"},
    )


def records_of(dataset: Dataset) -> tuple[EpisodeRecord, ...]:
    """Return the episodes of a dataset, in canonical order."""
    return tuple(sorted(dataset.records(), key=lambda one: one.episode_id.sort_key))


def one_split(records: Iterable[EpisodeRecord]) -> str:
    """Return the one split that episodes are of, or `mixed`: the name under which rows load."""
    found = {record.episode_id.split for record in records}
    return found.pop() if len(found) == 1 else "mixed"


def count_same_family(manifests: Iterable[BufferManifest]) -> int:
    """Return how many buffers have a distractor of the query's own family."""
    return sum(
        any(
            session.role == "distractor" and session.source.family == one.episode_id.family
            for session in one.sessions
        )
        for one in manifests
    )


def _families(records: Iterable[EpisodeRecord]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(record.episode_id.family for record in records))


def _episodes(dataset: Dataset, records: Iterable[EpisodeRecord]) -> CardTable:
    digest = dataset.sums().get(RECORDS_PATH)
    if digest is None:
        where = dataset.files.describe()
        raise FormatError.damaged(where, f"{RECORDS_PATH} is not in {SUMS_PATH}")
    return CardTable("episodes", EpisodeRecord, RECORDS_PATH, digest, one_split(records))


def _questions(buffer_set: BufferSet) -> str | None:
    """Return the SHA-256 of the questions of a buffer set, or None if it has none."""
    with suppress(MissingFileError):
        return sha256_file(buffer_set.files.path(QUESTIONS_PATH))
    return None


def _skipped(dataset: Dataset) -> int:
    """Return how many recorded episodes yielded nothing."""
    skipped = read_json(dataset.files.path(REPORT_PATH)).get("skipped")
    return len(skipped) if isinstance(skipped, list) else 0


def _beyond_paper(conditions: Iterable[str]) -> list[tuple[list[str], str]]:
    """Return the conditions beyond the paper's, kind by kind, with what they hold in words."""
    named = {one: parse_condition(one).kind for one in conditions if one not in DEFAULT_CONDITIONS}
    kinds = dict.fromkeys(named.values())
    return [([f"`{one}`" for one in named if named[one] == kind], kind.holds) for kind in kinds]
