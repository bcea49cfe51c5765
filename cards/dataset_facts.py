"""What the cards of demonstrations and of buffer sets state."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from typing import Any

from robomme_interference_data.constants import (
    CONTRADICTIONS,
    DAYS,
    DEMONSTRATIONS,
    DISTRACTORS,
    EXECUTIONS,
    MANIFEST_ROWS,
    MANIFESTS,
    PAPER_UNIT,
    QUESTIONS_PATH,
    RAW_DISTRACTORS,
    RECORDS_PATH,
    REPORT_PATH,
    SHIFTED,
    STATE,
    UNITS,
)
from robomme_interference_data.data.buffer import Buffer
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.data.query import Query
from robomme_interference_data.data.query_sessions import buffer_manifest
from robomme_interference_data.data.questions import Question
from robomme_interference_data.data.renderers import dataset_renderers
from robomme_interference_data.data.state_reader import other_state_sizes, query_state_size
from robomme_interference_data.errors import FormatError, InvalidOptionError, MissingFileError
from robomme_interference_data.schema.conditions import DEFAULT_CONDITIONS, parse_condition
from robomme_interference_data.schema.manifest import BufferManifest
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.schema.renderers import renderers_note
from robomme_interference_data.storage.text import read_json
from robomme_interference_data.viz.filmstrip import strip_png

from .facts import CardTable, Facts, data_limits, dataset_rows, repositories_of
from .markdown import Raw, code
from .tables import condition_table, count_table, goal_table, unit_table

STRIP = "README-strip.png"

_BUFFERS = f"{MANIFESTS}/{MANIFEST_ROWS}"
_FOLDERS = {
    RAW_DISTRACTORS: "the distractor units at full rate",
    CONTRADICTIONS: "lessons in the scenes of the queries with other answers",
    SHIFTED: "the first live observations under shifts of light, camera, clutter and colors",
    EXECUTIONS: "what follows each lesson: live frames, states and actions",
    DAYS: "recordings of a robot's days, many tasks without a cut",
}


def demonstrations_facts(dataset: Dataset) -> Facts:
    """Return what the card of a dataset of demonstrations states."""
    if dataset.kind != DEMONSTRATIONS:
        raise InvalidOptionError(
            f"{dataset.files.describe()} is a dataset of {dataset.kind}; expected {DEMONSTRATIONS}",
            "Units are published with the manifests that name them: give the buffer set.",
        )
    records = _records(dataset)
    if not records:
        raise FormatError.damaged(dataset.files.describe(), "no episodes")
    query, lesson = Query(dataset, records[0]), dataset.session("lesson", records[0])
    manifest = buffer_manifest(query, parse_condition("k0"), (lesson,), exact=records[0].exact)
    frames, skipped = sum(record.length for record in records), _skipped([dataset])
    limits = []
    if skipped:
        limits.append(
            f"{skipped:,} recorded episodes yielded no demonstration, or were not used: "
            f"{REPORT_PATH} lists them with the reason."
        )
    return _facts(
        {"": dataset},
        records,
        Buffer(manifest, query, {dataset.kind: dataset}),
        limits,
        {
            "cameras": dataset.cameras,
            "fps": Raw(f"{dataset.fps:g}"),
            "episodes": len(records),
            "counts": count_table(records),
            "goals": goal_table(records),
            "skipped": skipped,
            "inexact": sum(not record.exact for record in records),
        },
        kind=DEMONSTRATIONS,
        title="RoboMME-Interference demonstrations",
        examples=frames,
        tables=[CardTable("episodes", EpisodeRecord, RECORDS_PATH, one_split(records))],
        provenance=dataset_rows(dataset),
    )


def buffer_set_facts(buffer_set: BufferSet) -> Facts:
    """Return what the card of a buffer set states."""
    header, datasets = buffer_set.header, dict(buffer_set.datasets)
    records = {name: _records(dataset) for name, dataset in datasets.items()}
    lessons, ids = records.pop(DEMONSTRATIONS), {*buffer_set.episode_ids}
    units = [record for name in UNITS for record in records.get(name, ())]
    queries = tuple(record for record in lessons if record.episode_id in ids)
    manifests = tuple(buffer_set.manifests())
    if not (manifests and queries):
        raise FormatError.damaged(buffer_set.location, "no buffers")
    # The film strip shows k3 where there is one: seven units would be too small to see.
    first = [manifest for manifest in manifests if manifest.episode_id == queries[0].episode_id]
    shown = max(first, key=lambda manifest: (manifest.condition == "k3", len(manifest.sessions)))
    same_family = count_same_family(manifests)
    unit = datasets[DISTRACTORS].unit if DISTRACTORS in datasets else PAPER_UNIT
    limits = []
    if same_family:
        limits.append(
            f"{same_family:,} buffers hold distractors of the query's own family, which the "
            "paper's protocol excludes: results are not comparable with those of the benchmark."
        )
    if unit != PAPER_UNIT:
        limits.append(
            f"Distractor units have {unit}, not the paper's {PAPER_UNIT}: results are not "
            "comparable with those of the benchmark."
        )
    split_name, has_questions = one_split(queries), _has_questions(buffer_set)
    tables = [CardTable("buffers", BufferManifest, _BUFFERS, split_name)]
    if DISTRACTORS in records:
        tables.append(CardTable("episodes", EpisodeRecord, RECORDS_PATH, one_split(units)))
    if has_questions:
        tables.append(CardTable("questions", Question, QUESTIONS_PATH, split_name))
    return _facts(
        datasets,
        queries,
        buffer_set.load(shown.episode_id, shown.condition, cameras=()),  # fetches no video
        limits,
        {
            "unit": unit,
            "cameras": buffer_set.cameras,
            "buffers": len(manifests),
            "queries": len(queries),
            "units": len(units),
            "units_split": one_split(units),
            "conditions": buffer_set.conditions,
            "condition_table": condition_table(buffer_set.conditions, manifests),
            "counts": unit_table(queries, units),
            "goals": goal_table(lessons),
            "folders": {name: what for name, what in _FOLDERS.items() if name in datasets},
            "questions": has_questions,
            "header": header,
            "other_conditions": _beyond_paper(buffer_set.conditions),
            "same_family": same_family,
            "skipped": _skipped(datasets[name] for name in records),
            "inexact": sum(not manifest.exact for manifest in manifests),
        },
        kind="buffer_set",
        title="RoboMME-Interference buffers",
        examples=sum(record.length for record in units),
        tables=tables,
        provenance=[
            ("revision of the buffer set", code(buffer_set.revision)),
            (f"SHA-256 of `{_BUFFERS}`", code(header.rows)),
            *(row for name, dataset in datasets.items() for row in dataset_rows(dataset, name)),
            ("version of the draw", code(header.rule_version)),
        ],
        base_kind=DEMONSTRATIONS,
        base=header.datasets[DEMONSTRATIONS].location,
    )


def _facts(
    datasets: Mapping[str, Dataset],
    queries: Sequence[EpisodeRecord],
    shown: Buffer,
    limits: Iterable[str],
    values: Mapping[str, Any],
    **fields: Any,
) -> Facts:
    """Return the facts that demonstrations and buffer sets share, completed by `fields`.

    `shown` is the buffer whose film strip the card shows, drawn once and only when needed.
    """
    dataset = shown.query.dataset
    camera = dataset.camera() if dataset.cameras else None
    sessions = ", ".join(f"{session.role} {session.source}" for session in shown.sessions)
    simulators = {record.simulator for dataset in datasets.values() for record in dataset.records()}
    named = sorted(filter(None, simulators))
    sources = {name: list(dataset.identity.sources) for name, dataset in datasets.items()}

    @cache
    def pictures() -> dict[str, bytes]:
        if camera is None:
            return {}
        shown.fetch([camera])
        return {STRIP: strip_png(shown)}

    return Facts(
        simulators=named,
        simulated=None not in simulators,
        limits=data_limits(queries, named, [*limits, *_changes(datasets)]),
        pictures=pictures,
        values={
            "strip": STRIP,
            "caption": f"{shown.episode_id} under {shown.condition}: "
            f"{sessions or 'no session'}. Goal: {shown.goal}",
            "shown": shown,
            "camera": camera,
            "difficulties": any(record.difficulty for record in queries),
            "first": queries[0].episode_id,
            "header": None,
            "other_conditions": [],
            "same_family": 0,
            **values,
        },
        repositories={
            repo_id: commit
            for dataset in datasets.values()
            for repo_id, commit in repositories_of(dataset).items()
        },
        details={
            f"Sources of the {name or DEMONSTRATIONS}": recorded
            for name, recorded in sources.items()
            if recorded
        },
        **fields,
    )


def _changes(datasets: Mapping[str, Dataset]) -> list[str]:
    """Return what the datasets lack or changed of their recordings, and how they differ."""
    limits = []
    for name, dataset in datasets.items():
        named = name or DEMONSTRATIONS
        sources = dataset.identity.sources
        if sizes := sorted({str(source["resize"]) for source in sources if "resize" in source}):
            limits.append(f"The frames of the {named} are resized: {sizes[0]}.")
        if dataset.features[STATE] == (0,):
            limits.append(f"The {named} have no robot states: states have length 0.")
    if note := renderers_note(dataset_renderers(datasets).items()):
        limits.append(note)
    others = other_state_sizes(datasets) if DEMONSTRATIONS in datasets else {}
    for name, size in others.items():
        limits.append(
            f"The states of the {name} have {size} values, those of the lessons "
            f"{query_state_size(datasets)}: buffers that hold both have no single array of states, "
            "unless the units' are padded or omitted."
        )
    return limits


def one_split(records: Iterable[EpisodeRecord]) -> str:
    """Return the split of all episodes, or `mixed`."""
    splits = {record.episode_id.split for record in records}
    return splits.pop() if len(splits) == 1 else "mixed"


def count_same_family(manifests: Iterable[BufferManifest]) -> int:
    """Return how many buffers have a distractor of the query's own family."""
    return sum(
        any(
            session.role == "distractor" and session.source.family == manifest.episode_id.family
            for session in manifest.sessions
        )
        for manifest in manifests
    )


def _records(dataset: Dataset) -> tuple[EpisodeRecord, ...]:
    return tuple(sorted(dataset.records(), key=lambda record: record.episode_id.sort_key))


def _has_questions(buffer_set: BufferSet) -> bool:
    with suppress(MissingFileError):
        return buffer_set.files.path(QUESTIONS_PATH).is_file()
    return False


def _skipped(datasets: Iterable[Dataset]) -> int:
    """Return how many recorded episodes yielded nothing."""
    reports = (read_json(dataset.files.path(REPORT_PATH)).get("skipped") for dataset in datasets)
    return sum(len(skipped) for skipped in reports if isinstance(skipped, list))


def _beyond_paper(conditions: Iterable[str]) -> list[tuple[list[str], str]]:
    """Return the conditions beyond the paper's, grouped by kind, with what the kind holds."""
    names: dict[Any, list[str]] = {}
    for condition in conditions:
        if condition not in DEFAULT_CONDITIONS:
            names.setdefault(parse_condition(condition).kind, []).append(f"`{condition}`")
    return [(of_kind, kind.holds) for kind, of_kind in names.items()]
