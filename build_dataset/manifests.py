"""Write the manifests of a split: for every query episode and every k, what its buffer holds.

Rules 1 to 5 and 8 of the protocol; the draw itself is `draw.py`. Rows are made in batches, so
that memory does not grow with their number.
"""

import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from robomme_interference_data.build_dataset.locks import locked
from robomme_interference_data.constants import (
    ACTION,
    DEMONSTRATIONS,
    DISTRACTORS,
    FORMAT_VERSION,
    MANIFEST_JSON,
    MANIFEST_JSONL,
    MANIFEST_PARQUET,
    MAX_K,
    MAX_STEPS,
    POSITION_LIMIT,
    RULE_VERSION,
    SPLITS,
    UNIT_FRAMES,
)
from robomme_interference_data.dataset import Dataset
from robomme_interference_data.draw import UnitPool, lesson_share
from robomme_interference_data.errors import (
    BuildError,
    HistoryTooLongError,
    InvalidOptionError,
    SourceError,
)
from robomme_interference_data.files import atomic_path, sha256_file, write_json
from robomme_interference_data.ids import EpisodeId, condition_name
from robomme_interference_data.manifest_io import QUERY_TYPE, SCHEMA, SESSION_TYPE

__all__ = ["ManifestPlan", "check_history", "expected_rows", "plan_manifests", "write_manifests"]

_BATCH = 1024
"""Queries in a batch; also bounds the rows of a row group, so that few bytes find one buffer."""

_FILES = (MANIFEST_PARQUET, MANIFEST_JSONL, MANIFEST_JSON)


@dataclass(frozen=True)
class ManifestPlan:
    """All that decides the manifests.

    Attributes:
        demonstrations: The query episodes.
        distractors: The units.
        k: Numbers of distractor sessions, ascending.
        seed: Seed of the draw.
        position_limit: Longest history plus rollout that the systems hold; None for no limit.
    """

    demonstrations: Dataset
    distractors: Dataset
    k: tuple[int, ...]
    seed: int
    position_limit: int | None


def check_history(query: EpisodeId, lesson_frames: int, k: int, position_limit: int | None) -> None:
    """Check that a buffer and its rollout fit the systems' position embeddings (rule 8).

    Raises:
        HistoryTooLongError: Lesson + 32·k + 1300 exceeds the limit.
    """
    needed = lesson_frames + UNIT_FRAMES * k + MAX_STEPS
    if position_limit is not None and needed > position_limit:
        raise HistoryTooLongError(
            f"{query} at k={k} needs {needed} positions ({lesson_frames} lesson + "
            f"{UNIT_FRAMES}·{k} distractor frames + {MAX_STEPS} steps); the released servers hold "
            f"{position_limit}",
            "Plan a smaller k, or --position-limit none for systems without such a limit.",
        )


def plan_manifests(
    demonstrations: Dataset,
    distractors: Dataset,
    k: Sequence[int] = (0, 1, 3, 7),
    seed: int = 0,
    position_limit: int | None = POSITION_LIMIT,
) -> ManifestPlan:
    """Check that two datasets and the options make a split.

    Raises:
        InvalidOptionError: A k is not from 0 to 63 or comes twice, or a dataset is of the wrong
            kind.
        SourceError: The datasets do not fit each other, or a unit is not of the train split.
    """
    ordered = tuple(sorted(k))
    if not ordered or len(set(ordered)) != len(ordered) or ordered[0] < 0 or ordered[-1] > MAX_K:
        raise InvalidOptionError(
            f"--k {' '.join(map(str, k))}; expected distinct numbers from 0 to {MAX_K}"
        )
    for option, dataset in ((DEMONSTRATIONS, demonstrations), (DISTRACTORS, distractors)):
        if dataset.kind != option:
            raise InvalidOptionError(
                f"--{option} {dataset.files.describe()} is a dataset of {dataset.kind}",
                f"Give the folder that robomme-interference build {option} made.",
            )
    shown, others = _shown(demonstrations), _shown(distractors)
    if shown != others:
        raise SourceError(
            f"sessions of both datasets cannot follow one another in a buffer: the demonstrations "
            f"have {shown}, the distractors {others}",
            "Build both with the same --cameras, from sources with the same sizes.",
        )
    splits = set(distractors.episodes["split"].to_pylist())
    if splits != {"train"}:
        raise SourceError(
            f"distractor units must come from train episodes, so that no query's own scene leaks "
            f"into another buffer; found {', '.join(sorted(splits))}",
            "Build the distractors with --split train.",
        )
    return ManifestPlan(demonstrations, distractors, ordered, seed, position_limit)


def _shown(dataset: Dataset) -> dict[str, tuple[int, ...]]:
    """Return the features that a buffer shows, with their shapes: cameras and state."""
    return {name: shape for name, shape in dataset.features.items() if name != ACTION}


def write_manifests(plan: ManifestPlan, out: Path) -> Iterator[int]:
    """Write the manifest files; yields the number of queries done after each batch.

    The files appear together when all are complete; `manifest.json` is the last, and names the
    SHA-256 of the others.

    Args:
        plan: What to write.
        out: Folder of the manifests; files of an earlier run are replaced.

    Raises:
        PoolTooSmallError: A query needs more units than the other families have.
        HistoryTooLongError: A buffer exceeds the position limit.
        BuildError: `out` holds something else, or is being written by another process.
    """
    out = out.resolve()
    with locked(out) as work:
        try:
            _clear(out)
            yield from _write(plan, out)
        finally:
            shutil.rmtree(work, ignore_errors=True)


def _clear(out: Path) -> None:
    """Make the folder, and remove what a killed run left half-written in it."""
    if out.is_file():
        raise BuildError(f"{out} is a file", "Choose another --out.")
    out.mkdir(parents=True, exist_ok=True)
    partial = {path for name in _FILES for path in out.glob(f".{name}.*.partial")}
    others = set(out.iterdir()) - partial - {out / name for name in _FILES}
    if others and not (out / MANIFEST_JSON).is_file():
        raise BuildError(
            f"{out} exists and holds no manifests, but {min(others).name}", "Choose another --out."
        )
    for path in partial:
        path.unlink()


def _write(plan: ManifestPlan, out: Path) -> Iterator[int]:
    rows = _Rows(plan)
    with (
        atomic_path(out / MANIFEST_PARQUET) as parquet,
        atomic_path(out / MANIFEST_JSONL) as jsonl,
        pq.ParquetWriter(parquet, SCHEMA, compression="zstd") as writer,
        jsonl.open("w", encoding="utf-8") as lines,
    ):
        for batch in rows.batches():
            writer.write_batch(batch.table, row_group_size=_BATCH)
            lines.writelines(batch.lines)
            yield batch.queries
        # An old manifest.json must not vouch for new files, should writing stop here.
        (out / MANIFEST_JSON).unlink(missing_ok=True)
    write_json(
        out / MANIFEST_JSON,
        {
            "format_version": FORMAT_VERSION,
            "rule_version": RULE_VERSION,
            "seed": plan.seed,
            "k": list(plan.k),
            "position_limit": plan.position_limit,
            "datasets": {
                dataset.kind: {
                    name: dataset.identity[name]
                    for name in ("name", "version", "revision", "exact", "counts", "simulators")
                }
                for dataset in (plan.demonstrations, plan.distractors)
            },
            "counts": rows.counts,
            "files": {
                name: {"sha256": sha256_file(out / name), "bytes": (out / name).stat().st_size}
                for name in (MANIFEST_PARQUET, MANIFEST_JSONL)
            },
        },
    )


def expected_rows(plan: ManifestPlan) -> Iterator[dict[str, Any]]:
    """Yield the rows that `write_manifests` would write, in order, as plain values."""
    for batch in _Rows(plan).batches():
        yield from batch.table.to_pylist()


@dataclass(frozen=True)
class _Batch:
    queries: int
    table: pa.RecordBatch
    lines: list[str]


class _Rows:
    """Makes the rows of all buffers, batch by batch."""

    def __init__(self, plan: ManifestPlan):
        self.plan = plan
        units = plan.distractors.episodes
        ids = [EpisodeId.parse(text) for text in units["episode_id"].to_pylist()]
        self.pool = UnitPool(ids, plan.seed)
        self.unit_rows = {unit: row for row, unit in enumerate(ids)}
        self.units = _sessions(
            plan.distractors, units, "distractor", units["length"].to_numpy(), units["sha256"]
        )
        self.unit_texts = [_session_text(unit) for unit in self.units.to_pylist()]
        self.counts = {"queries": 0, "buffers": 0, "sessions": 0}

    def batches(self) -> Iterator[_Batch]:
        table = self.plan.demonstrations.episodes
        order = np.lexsort(
            (
                table["source_episode"].to_numpy(),
                [SPLITS.index(split) for split in table["split"].to_pylist()],
                _family_ranks(table["family"].to_pylist()),
            )
        )
        for start in range(0, len(order), _BATCH):
            yield self._batch(table.take(order[start : start + _BATCH]).combine_chunks())

    def _batch(self, table: pa.Table) -> _Batch:
        plan = self.plan
        queries = [
            EpisodeId(family, split, index)
            for family, split, index in zip(
                table["family"].to_pylist(),
                table["split"].to_pylist(),
                table["source_episode"].to_pylist(),
                strict=True,
            )
        ]
        lessons = table["exec_start_idx"].to_numpy()
        drawn: list[list[int]] = []
        for query, lesson in zip(queries, lessons, strict=True):
            check_history(query, int(lesson), plan.k[-1], plan.position_limit)
            drawn.append([self.unit_rows[unit] for unit in self.pool.draw(query, plan.k[-1])])
        lesson_sessions = _sessions(
            plan.demonstrations, table, "lesson", lessons, table["lesson_sha256"]
        )
        rows = [(number, k) for number in range(len(queries)) for k in plan.k]
        places = np.array([number for number, _ in rows])
        # Sessions of all rows in one go: a lesson is its query's number, a unit comes after all
        # lessons.
        used = sorted({unit for units in drawn for unit in units})
        place_of = {unit: len(queries) + place for place, unit in enumerate(used)}
        choices = pa.concat_arrays([lesson_sessions, self.units.take(pa.array(used, pa.int64()))])
        picks = [
            place
            for number, k in rows
            for place in (number, *(place_of[unit] for unit in drawn[number][:k]))
        ]
        offsets = np.concatenate([[0], np.cumsum([1 + k for _, k in rows])])
        sessions = pa.ListArray.from_arrays(
            pa.array(offsets, pa.int32()), choices.take(pa.array(picks, pa.int64()))
        )
        ks = np.array([k for _, k in rows])
        history = lessons[places] + UNIT_FRAMES * ks
        shares = {
            (int(lesson), int(frames)): lesson_share(int(lesson), int(frames))
            for lesson, frames in set(zip(lessons[places], history, strict=True))
        }
        exact_units = plan.distractors.episodes["exact"].to_numpy()
        exact = table["exact"].to_numpy()
        columns = {
            **{
                name: table[source].take(places)
                for name, source in (
                    ("episode_id", "episode_id"),
                    ("family", "family"),
                    ("split", "split"),
                    ("index", "source_episode"),
                    ("goals", "goals"),
                    ("seed", "seed"),
                    ("difficulty", "difficulty"),
                    ("simulator", "simulator"),
                )
            },
            "k": ks,
            "condition": [condition_name(k) for k in ks],
            "exact": [
                bool(exact[number] and exact_units[drawn[number][:k]].all()) for number, k in rows
            ],
            "lesson_frames": lessons[places],
            "history_frames": history,
            "lesson_share": [
                shares[int(lesson), int(frames)]
                for lesson, frames in zip(lessons[places], history, strict=True)
            ],
            "query": _queries(plan.demonstrations, table).take(pa.array(places)),
            "sessions": sessions,
        }
        batch = pa.record_batch(
            [_column(columns[field.name], field.type) for field in SCHEMA], schema=SCHEMA
        )
        lines = self._lines(batch.drop_columns(["sessions"]), lesson_sessions, rows, drawn)
        self.counts["queries"] += len(queries)
        self.counts["buffers"] += len(rows)
        self.counts["sessions"] += len(picks)
        return _Batch(len(queries), batch, lines)

    def _lines(
        self,
        batch: pa.RecordBatch,
        lesson_sessions: pa.StructArray,
        rows: list[tuple[int, int]],
        drawn: list[list[int]],
    ) -> list[str]:
        """Return the rows as JSON lines, their sessions put together from ready-made texts."""
        lessons = [_session_text(lesson) for lesson in lesson_sessions.to_pylist()]
        lines = []
        for row, (number, k) in zip(batch.to_pylist(), rows, strict=True):
            texts = [lessons[number], *(self.unit_texts[unit] for unit in drawn[number][:k])]
            head = json.dumps(row, ensure_ascii=False)
            lines.append(f'{head[:-1]}, "sessions": [{", ".join(texts)}]}}\n')
        return lines


def _sessions(
    dataset: Dataset, table: pa.Table, role: str, stops: Any, hashes: pa.ChunkedArray
) -> pa.StructArray:
    """Return one whole-span session for every row of a dataset's episode table."""
    count = len(table)
    values = {
        "role": [role] * count,
        "family": table["family"],
        "source": table["episode_id"],
        "dataset": [dataset.kind] * count,
        "revision": [dataset.revision] * count,
        "episode_index": table["episode_index"],
        "start": np.zeros(count, np.int32),
        "stop": stops,
        "repeat": np.ones(count, np.int32),
        "sha256": hashes,
    }
    arrays = [_column(values[field.name], field.type) for field in SESSION_TYPE]
    return pa.StructArray.from_arrays(arrays, fields=list(SESSION_TYPE))


def _queries(dataset: Dataset, table: pa.Table) -> pa.StructArray:
    count = len(table)
    values = {
        "dataset": [dataset.kind] * count,
        "revision": [dataset.revision] * count,
        "episode_index": table["episode_index"],
        "frame": table["exec_start_idx"],
    }
    arrays = [_column(values[field.name], field.type) for field in QUERY_TYPE]
    return pa.StructArray.from_arrays(arrays, fields=list(QUERY_TYPE))


def _column(values: Any, kind: pa.DataType) -> pa.Array:
    if isinstance(values, pa.ChunkedArray):
        values = values.combine_chunks()
    return values.cast(kind) if isinstance(values, pa.Array) else pa.array(values, kind)


def _session_text(session: dict[str, Any]) -> str:
    return json.dumps(session, ensure_ascii=False)


def _family_ranks(families: list[str]) -> list[int]:
    ordered = sorted(set(families), key=lambda family: EpisodeId(family, "test", 0).sort_key)
    rank = {family: number for number, family in enumerate(ordered)}
    return [rank[family] for family in families]
