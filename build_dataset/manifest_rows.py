"""The rows of a split's manifests, made in batches: memory does not grow with their number.

Rules 1 to 5 and 8 of the protocol; the draw itself is `draw.py`.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from robomme_interference_data.constants import MAX_STEPS, SPLITS, UNIT_FRAMES
from robomme_interference_data.dataset import Dataset
from robomme_interference_data.draw import UnitPool, lesson_share
from robomme_interference_data.errors import HistoryTooLongError
from robomme_interference_data.ids import EpisodeId, condition_name
from robomme_interference_data.manifest_io import QUERY_TYPE, SCHEMA, SESSION_TYPE

__all__ = ["BATCH", "Batch", "ManifestPlan", "ManifestRows", "check_history"]

BATCH = 1024
"""Queries in a batch; also bounds the rows of a row group, so that few bytes find one buffer."""


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


@dataclass(frozen=True)
class Batch:
    """Rows of some queries.

    Attributes:
        queries: Number of queries.
        table: Their rows.
        lines: The same as JSON, a line each.
    """

    queries: int
    table: pa.RecordBatch
    lines: list[str]


class ManifestRows:
    """Makes the rows of all buffers, batch by batch; `counts` grows with them."""

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

    def batches(self) -> Iterator[Batch]:
        """Yield the rows, queries by family, split and index.

        Raises:
            PoolTooSmallError: A query needs more units than the other families have.
            HistoryTooLongError: A buffer exceeds the position limit.
        """
        table = self.plan.demonstrations.episodes
        order = np.lexsort(
            (
                table["source_episode"].to_numpy(),
                [SPLITS.index(split) for split in table["split"].to_pylist()],
                _family_ranks(table["family"].to_pylist()),
            )
        )
        for start in range(0, len(order), BATCH):
            yield self._batch(table.take(order[start : start + BATCH]).combine_chunks())

    def _batch(self, table: pa.Table) -> Batch:
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
        return Batch(len(queries), batch, lines)

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
