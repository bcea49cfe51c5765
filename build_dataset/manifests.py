"""Plan the buffers of a split: for every query episode and every condition, what it holds.

Rules 1 to 5 and 8 of the protocol; the draw itself is `draw.py`, what a condition holds is
`conditions.py`.
"""

import shutil
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import batched
from pathlib import Path

import pyarrow.parquet as pq

from robomme_interference_data.conditions import DEFAULT_CONDITIONS, Condition, in_order
from robomme_interference_data.constants import (
    ACTION,
    DEMONSTRATIONS,
    DISTRACTORS,
    FORMAT_VERSION,
    IDENTITY_PATH,
    MANIFEST_HEADER,
    MANIFEST_ROWS,
    MANIFESTS,
    MAX_STEPS,
    POSITION_LIMIT,
    RULE_VERSION,
)
from robomme_interference_data.dataset import Dataset
from robomme_interference_data.digest import combine
from robomme_interference_data.draw import UnitPool
from robomme_interference_data.errors import (
    BuildError,
    FormatError,
    HistoryTooLongError,
    InvalidOptionError,
    SourceError,
)
from robomme_interference_data.files import (
    Files,
    LocalFiles,
    sha256_file,
    working,
    write_json,
)
from robomme_interference_data.hub import HubFiles
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.parquet import writing
from robomme_interference_data.query import Query
from robomme_interference_data.records import (
    BufferManifest,
    EpisodeRecord,
    ManifestDataset,
    ManifestHeader,
    SessionEntry,
    place_sessions,
)
from robomme_interference_data.rows import arrow_schema, to_dict, to_table
from robomme_interference_data.sampling import lesson_frames, lesson_share

_BATCH = 1024
"""Rows in a row group: few bytes find one buffer."""


@dataclass(frozen=True)
class ManifestPlan:
    """All that decides the manifests.

    Attributes:
        demonstrations: The query episodes.
        distractors: The units.
        conditions: For which buffers are planned, in order.
        seed: Seed of the draw.
        position_limit: Longest history plus rollout that the systems hold; None for no limit.
    """

    demonstrations: Dataset
    distractors: Dataset
    conditions: tuple[Condition, ...]
    seed: int = 0
    position_limit: int | None = POSITION_LIMIT

    @cached_property
    def pool(self) -> UnitPool:
        """The units, to be drawn."""
        return UnitPool((one.episode_id for one in self.distractors.records()), self.seed)

    @cached_property
    def units(self) -> dict[EpisodeId, SessionEntry]:
        """The units as sessions."""
        return {
            one.episode_id: _entry(
                "distractor", self.distractors, one, one.length, combine(one.feature_sha256)
            )
            for one in self.distractors.records()
        }


def in_folder(root: Path) -> dict[str, Files]:
    """Return where the datasets of a split lie that is built in a folder."""
    return {name: LocalFiles(root / name) for name in (DEMONSTRATIONS, DISTRACTORS)}


def plan_manifests(
    places: Mapping[str, Files],
    conditions: Sequence[str | Condition] = DEFAULT_CONDITIONS,
    seed: int = 0,
    position_limit: int | None = POSITION_LIMIT,
) -> ManifestPlan:
    """Check that the datasets of a split and the options fit each other.

    Args:
        places: Where `demonstrations` and `distractors` lie; see `in_folder`.
        conditions: For which buffers are planned.
        seed: Seed of the draw.
        position_limit: See `ManifestPlan`.

    Raises:
        InvalidIdError, InvalidOptionError: A condition is none, or comes twice.
        MissingFileError, FormatError: A dataset is missing or damaged.
        SourceError: The datasets do not fit each other, or a unit is not of the train split.
    """
    ordered = in_order(conditions)
    opened = {}
    for name in (DEMONSTRATIONS, DISTRACTORS):
        opened[name] = dataset = Dataset(places[name])
        if dataset.kind != name:
            raise InvalidOptionError(
                f"{dataset.files.describe()} is a dataset of {dataset.kind}",
                f"Put there what robomme-interference build {name} made.",
            )
    shown = {
        name: {feature: s for feature, s in one.features.items() if feature != ACTION}
        for name, one in opened.items()
    }
    if shown[DEMONSTRATIONS] != shown[DISTRACTORS]:
        raise SourceError(
            "sessions of both datasets cannot follow one another in a buffer: the demonstrations "
            f"have {shown[DEMONSTRATIONS]}, the distractors {shown[DISTRACTORS]}",
            "Build both with the same --cameras, from sources with the same sizes.",
        )
    splits = {record.episode_id.split for record in opened[DISTRACTORS].records()}
    if splits != {"train"}:
        raise SourceError(
            "distractor units must come from train episodes, so that no query's own scene leaks "
            f"into another buffer; found {', '.join(sorted(splits))}",
            "Build the distractors with --split train.",
        )
    return ManifestPlan(opened[DEMONSTRATIONS], opened[DISTRACTORS], ordered, seed, position_limit)


class _Material:
    """What the conditions' rules make the history of one query of; see `conditions.Material`."""

    def __init__(self, plan: ManifestPlan, record: EpisodeRecord):
        self._plan = plan
        self._record = record
        self._units: list[SessionEntry] = []

    @cached_property
    def _lesson(self) -> SessionEntry:
        record, dataset = self._record, self._plan.demonstrations
        if record.exec_start_idx is None or record.lesson_sha256 is None:
            raise FormatError.damaged(dataset.files.describe(), f"{record.episode_id}: no lesson")
        sha = combine(record.lesson_sha256)
        return _entry("lesson", dataset, record, record.exec_start_idx, sha)

    def lesson(self) -> SessionEntry:
        return self._lesson

    def units(self, k: int) -> Sequence[SessionEntry]:
        if k > len(self._units):  # fewer begin those that are drawn
            drawn = self._plan.pool.draw(self._record.episode_id, k)
            self._units = [self._plan.units[unit] for unit in drawn]
        return self._units[:k]


def _entry(
    role: str, dataset: Dataset, record: EpisodeRecord, stop: int, sha256: str
) -> SessionEntry:
    """Return the session that an episode is from its beginning on."""
    name = record.episode_id
    place = dataset.kind, dataset.revision, record.episode_index
    return SessionEntry(role, name.family, name, *place, 0, stop, 1, sha256)


def planned_buffers(plan: ManifestPlan) -> Iterator[BufferManifest]:
    """Yield the manifests of all buffers: queries in canonical order, conditions as planned.

    Raises:
        PoolTooSmallError: A query needs more units than the other families have.
        HistoryTooLongError: A buffer exceeds the position limit.
    """
    datasets = {one.kind: one for one in (plan.demonstrations, plan.distractors)}
    lossy = {
        (kind, e.episode_id) for kind, d in datasets.items() for e in d.records() if not e.exact
    }
    for record in sorted(plan.demonstrations.records(), key=lambda one: one.episode_id.sort_key):
        place, material = Query(plan.demonstrations, record).place, _Material(plan, record)
        # The largest first: fewer units begin those that are drawn for it.
        sessions = {one.name: one.sessions(material) for one in reversed(plan.conditions)}
        for condition in plan.conditions:
            entries = sessions[condition.name]
            lessons = place_sessions(entries, "lesson")
            frames = sum(one.num_frames for one in entries)
            _check_length(plan, record, condition, frames)
            yield BufferManifest(
                episode_id=record.episode_id,
                condition=condition.name,
                k=condition.k,
                goals=record.goals,
                seed=record.seed,
                difficulty=record.difficulty,
                simulator=record.simulator,
                exact=record.exact
                and not (lossy and any((one.dataset, one.source) in lossy for one in entries)),
                lesson_frames=lesson_frames(lessons, 0, frames),
                history_frames=frames,
                lesson_share=lesson_share(lessons, 0, frames),
                query=place,
                sessions=entries,
            )


def _check_length(
    plan: ManifestPlan, record: EpisodeRecord, condition: Condition, frames: int
) -> None:
    """Check that a buffer and its rollout fit the systems' position embeddings (rule 8)."""
    needed, limit = frames + MAX_STEPS, plan.position_limit
    if limit is not None and needed > limit:
        raise HistoryTooLongError(
            f"{record.episode_id} under {condition} needs {needed} positions ({frames} history "
            f"frames + {MAX_STEPS} steps); the released servers hold {limit}",
            "Leave out that condition, or --position-limit none for systems without such a limit.",
        )


def check_place(root: Path) -> None:
    """Check that nothing else lies where the manifests of a split are to be.

    Raises:
        BuildError: The folder holds something else.
    """
    out = root.resolve() / MANIFESTS
    strangers = {path.name for path in out.iterdir()} if out.is_dir() else set()
    strangers -= {MANIFEST_ROWS, MANIFEST_HEADER}
    if (strangers and not (out / MANIFEST_HEADER).is_file()) or out.is_file():
        raise BuildError(
            f"{out} exists and holds no manifests, but {min(strangers, default='is a file')}"
        )


def write_manifests(plan: ManifestPlan, root: Path) -> Iterator[int]:
    """Write the manifests of a split; yields the number of buffers done after each batch.

    The files appear whole; `manifest.json` is the last, and names the SHA-256 of the rows.

    Args:
        plan: What to write.
        root: The split; manifests of an earlier run are replaced.

    Raises:
        PoolTooSmallError, HistoryTooLongError: As `planned_buffers`.
        BuildError: The folder holds something else, or is being written by another process.
    """
    out = root.resolve() / MANIFESTS
    rows, header = out / MANIFEST_ROWS, out / MANIFEST_HEADER
    with working(out) as work:
        try:
            out.mkdir(exist_ok=True)
            check_place(root)
            written = work / rows.name
            counts = yield from _write_rows(plan, written)
            write_json(work / header.name, to_dict(_header(plan, counts, sha256_file(written))))
            # An old header must not vouch for new rows, should this end here.
            header.unlink(missing_ok=True)
            written.replace(rows)
            (work / header.name).replace(header)
        finally:
            shutil.rmtree(work, ignore_errors=True)


def _write_rows(plan: ManifestPlan, path: Path) -> Generator[int, None, dict[str, int]]:
    """Write all rows; yields the number of buffers after each batch, and returns the counts."""
    schema = arrow_schema(BufferManifest)
    buffers = sessions = 0
    with (
        writing(path) as file,
        pq.ParquetWriter(file, schema, compression="zstd") as writer,
    ):
        for batch in batched(planned_buffers(plan), _BATCH):
            writer.write_table(to_table(batch, schema), row_group_size=_BATCH)
            buffers += len(batch)
            sessions += sum(len(manifest.sessions) for manifest in batch)
            yield len(batch)
    return {"queries": len(plan.demonstrations), "buffers": buffers, "sessions": sessions}


def _header(plan: ManifestPlan, counts: dict[str, int], rows: str) -> ManifestHeader:
    return ManifestHeader(
        format_version=FORMAT_VERSION,
        rule_version=RULE_VERSION,
        seed=plan.seed,
        conditions=tuple(condition.name for condition in plan.conditions),
        position_limit=plan.position_limit,
        datasets={
            dataset.kind: ManifestDataset(
                dataset.kind,
                dataset.identity.version,
                dataset.revision,
                sha256_file(dataset.files.path(IDENTITY_PATH)),
                dataset.files.describe() if isinstance(dataset.files, HubFiles) else None,
            )
            for dataset in (plan.demonstrations, plan.distractors)
        },
        counts=counts,
        rows=rows,
    )
