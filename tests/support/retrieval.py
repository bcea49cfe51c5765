"""Indexes, buffers with other sessions than planned, and cosines made up by hand."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from support.buffer_sets import QUERIES, with_sessions

from robomme_interference_data import Buffer, EpisodeId, Session, SessionEntry, load_buffer_set
from robomme_interference_data.constants import DEMONSTRATIONS, DISTRACTORS
from robomme_interference_data.data.index_layout import IndexHeader
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.retrieval.encoders.thumbnail import Thumbnail
from robomme_interference_data.retrieval.index import build_index
from robomme_interference_data.retrieval.measure import Similarities
from robomme_interference_data.retrieval.segment import FrameSpan, adjacent_cosines, cosines
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.manifest import layout_sessions
from robomme_interference_data.storage.files import write_json
from robomme_interference_data.storage.text import read_header

QUIET = WorkProgress(quiet=True)
FRAMES = [3 * 49, 17 * 32]
"""Stored frames of the golden buffer set: demonstrations and units."""


def change_header(path: Path, **fields: Any) -> None:
    """Change fields of an index's header, and its SHA-256 with them."""
    header = replace(read_header(path, IndexHeader), **fields)
    write_json(path, to_dict(replace(header, sha256=header.digest())))


class TwoSums:
    """An encoder whose arithmetic is exact everywhere: sums of red and green, and a constant."""

    name = "thumbnail"
    centered = True
    batch = 8
    computed_in = "whole numbers"
    fingerprint: ClassVar[dict[str, Any]] = {"name": "two-sums", "version": 1}

    def prepare(self, images: np.ndarray) -> np.ndarray:
        sums = images[..., :2].sum(axis=(1, 2), dtype=np.int64) // 64
        return np.concatenate([sums, np.full((len(sums), 1), 16)], axis=1).astype(np.float32)

    def features(self, prepared: np.ndarray) -> np.ndarray:
        return prepared


class Interrupted(Thumbnail):
    """Thumbnails, until some batches are done."""

    def __init__(self, after: int):
        super().__init__()
        self.left = after

    def features(self, prepared: Any) -> Any:
        self.left -= 1
        if self.left < 0:
            raise KeyboardInterrupt
        return prepared


def make_index(
    buffer_set: Path,
    encoder: Any = None,
    names: Sequence[str] = (DEMONSTRATIONS, DISTRACTORS),
    **options: Any,
) -> list[int]:
    """Make the index; returns how many frames of each dataset were embedded now."""
    roots = [buffer_set / name for name in names]
    reports = build_index(roots, encoder or Thumbnail(), QUIET, **options)
    return [report.embedded for report in reports]


def files_of(buffer_set: Path) -> dict[str, bytes]:
    """All files of the indexes of a buffer set, those of unfinished ones too."""
    found = (path for path in buffer_set.glob("*/index/**/*") if path.is_file())
    return {path.relative_to(buffer_set).as_posix(): path.read_bytes() for path in found}


def remade(buffer_set: Path, entries: Iterable[SessionEntry], **changes: Any) -> Buffer:
    """The k3 buffer of the first query with other sessions."""
    opened = load_buffer_set(buffer_set)
    manifest = with_sessions(opened.manifest(QUERIES[0], "k3"), *entries)
    return Buffer(replace(manifest, **changes), opened.query(QUERIES[0]), opened.datasets)


def sessions_of(names: Sequence[str], spans: Sequence[FrameSpan], lessons: Sequence[int]) -> Any:
    """Sessions of these episodes in these places; those of the given numbers are of the lesson."""
    entries = []
    for number, (name, (start, stop)) in enumerate(zip(names, spans, strict=True)):
        source = EpisodeId.parse(name)
        role = "lesson" if number in lessons else "distractor"
        span = (start, stop) if number in lessons else (0, stop - start)
        stored = role, "0" * 64, number_of(name), *span, 1, "0" * 64
        entries.append(SessionEntry(role, source.family, source, *stored))
    return layout_sessions(tuple(entries))


def number_of(text: str) -> int:
    """A number for an episode, for each another: what is stored is told apart by it."""
    return int.from_bytes(text.encode()) % 10**8


def made(
    episode: str = "MoveCube/test/0",
    condition: str = "k2",
    *,
    cuts: dict[int, float],
    high: dict[int, float],
    spans: tuple[FrameSpan, ...] = ((0, 6), (6, 11), (11, 15)),
    lessons: Sequence[int] = (0,),
    units: tuple[str, ...] = (),
) -> Similarities:
    """A buffer whose adjacent cosines are 1 but before `cuts`, and 0 with the query but at `high`.

    Args:
        episode: The query.
        condition: The condition.
        cuts: Cosine of the frame before with this one.
        high: Cosine of a frame with the query.
        spans: Where its sessions lie.
        lessons: Which of them are of the lesson.
        units: Sources of the others; its own if none are given.
    """
    frames = spans[-1][1]
    adjacent, alike = np.ones(frames - 1, np.float32), np.zeros(frames, np.float32)
    for place, value in cuts.items():
        adjacent[place - 1] = value
    for place, value in high.items():
        alike[place] = value
    own = (f"Other/train/{number_of(episode) + n}" for n in range(len(spans)))
    others = iter(units or own)
    names = [episode if n in lessons else next(others) for n in range(len(spans))]
    sessions: tuple[Session, ...] = sessions_of(names, spans, lessons)
    query = EpisodeId.parse(episode)
    return Similarities(query, condition, sessions, adjacent, alike, 0.0, lambda: np.eye(frames))


def embedded(history: np.ndarray, query: np.ndarray, lesson: FrameSpan = (0, 0)) -> Similarities:
    """A buffer of these embeddings: a lesson and what is around it."""
    spans = list(pairwise(sorted({0, *lesson, len(history)})))
    lessons = [spans.index(lesson)] if lesson in spans else []
    sessions = sessions_of(["MoveCube/test/0"] * len(spans), spans, lessons)
    episode, alike = EpisodeId.parse("MoveCube/test/0"), cosines(history, query)
    rows = history.astype(np.float32)
    return Similarities(
        episode, "k2", sessions, adjacent_cosines(history), alike, 0.0, lambda: rows
    )
