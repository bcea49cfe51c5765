"""Make the index of a dataset: embed every stored frame of a camera, and keep it beside the data.

An index is made in a hidden folder beside its place, an episode at a time, so that an interrupted
run goes on from there. The header is written last: without it there is no index.
"""

import shutil
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from robomme_interference_data.constants import (
    CAMERA_PREFIX,
    DISTRACTORS,
    FORMAT_VERSION,
    INDEX_CENTRE,
    INDEX_EMBEDDINGS,
    INDEX_HEADER,
    INDEX_ROWS,
)
from robomme_interference_data.dataset import Dataset
from robomme_interference_data.embeddings import EmbeddingIndex, index_folder, normalised
from robomme_interference_data.errors import (
    BuildError,
    FormatError,
    InvalidOptionError,
    UnknownNameError,
    nearest,
)
from robomme_interference_data.files import (
    LocalFiles,
    atomic_path,
    canonical_json,
    read_json,
    sha256_file,
    write_json,
)
from robomme_interference_data.locks import hold
from robomme_interference_data.progress import BuildProgress
from robomme_interference_data.retrieval.encoders.base import Encoder, fingerprint_digest
from robomme_interference_data.retrieval.segment import typical_cosine

__all__ = ["IndexReport", "build_index"]

_PLAN = "plan.json"


@dataclass(frozen=True)
class IndexReport:
    """What was done for one dataset.

    Attributes:
        folder: Where the index lies.
        frames: Frames in it.
        embedded: Frames that were embedded now; the others were there already.
        typical_cosine: Median cosine of two frames of the train pool.
    """

    folder: Path
    frames: int
    embedded: int
    typical_cosine: float


def build_index(
    roots: Sequence[Path],
    encoder: Encoder,
    progress: BuildProgress,
    *,
    camera: str = "front",
    threads: int = 1,
) -> list[IndexReport]:
    """Embed every stored frame of datasets whose frames are to be compared with each other.

    What an encoder is centred on, and what it finds in any two frames, come from the train pool
    alone: the distractor units. So the embedding of a frame, and where its history is cut, depend
    on no other query. The same data, encoder and device give the same bytes, interrupted or not.
    An index that is there and right is left as it is.

    Args:
        roots: Folders of the datasets, one of them the distractor units.
        encoder: What embeds.
        progress: Shows how far it is.
        camera: Camera to embed, with or without `observation.images.`.
        threads: Threads that decode and preprocess beside the encoder.

    Raises:
        UnknownNameError: A dataset has no such camera.
        InvalidOptionError: There are no distractor units among them.
        BuildError: Another process makes one of the indexes.
        MissingFileError, FormatError, TruncatedVideoError: A dataset cannot be read.
    """
    if threads < 1:
        raise InvalidOptionError(f"threads={threads}; expected 1 or more")
    datasets = [Dataset(LocalFiles(root)) for root in roots]
    units = next((dataset for dataset in datasets if dataset.kind == DISTRACTORS), None)
    if units is None:
        raise InvalidOptionError(
            f"{datasets[0].files.describe()} holds {datasets[0].kind}; expected distractor units "
            "beside them, which tell what any two frames share",
            "Index both at once: robomme-interference index --data SPLIT",
        )
    works = [_Work(dataset, encoder, camera, units.revision) for dataset in datasets]
    with ExitStack() as held:
        for work in works:
            held.enter_context(work.holding())
        progress.start(encoder.name, sum(work.frames for work in works))
        pool: EmbeddingIndex | None = None
        reports = {}
        for work in sorted(works, key=lambda work: work.dataset is not units):
            reports[work] = work.make(encoder, progress, threads, pool)
            if pool is None:
                pool = units.index(encoder.name)
        return [reports[work] for work in works]


class _Work:
    """The index of one dataset, being made."""

    def __init__(self, dataset: Dataset, encoder: Encoder, camera: str, pool: str):
        assert isinstance(dataset.files, LocalFiles)
        self.dataset = dataset
        self.camera = CAMERA_PREFIX + camera.removeprefix(CAMERA_PREFIX)
        if self.camera not in dataset.cameras:
            known = [name.removeprefix(CAMERA_PREFIX) for name in dataset.cameras]
            raise UnknownNameError(
                f"camera {camera!r} is not in {dataset.files.describe()}", nearest(camera, known)
            )
        self.folder = dataset.files.root / index_folder(encoder.name)
        self.parts = self.folder.parent / f".{self.folder.name}.building"
        self.lengths = [record.length for record in dataset.records()]
        self.frames = sum(self.lengths)
        self.plan: dict[str, Any] = {
            "format_version": FORMAT_VERSION,
            "encoder": {
                "name": self.folder.name,
                "fingerprint": encoder.fingerprint,
                "computed_in": encoder.computed_in,
            },
            "camera": self.camera,
            "pool": pool,
            "revision": dataset.revision,
        }

    def holding(self) -> Any:
        self.parts.mkdir(parents=True, exist_ok=True)
        busy = BuildError(f"another process makes {self.folder}", "Wait for it to end, or stop it.")
        return hold(self.parts / "lock", busy)

    def make(
        self, encoder: Encoder, progress: BuildProgress, threads: int, pool: EmbeddingIndex | None
    ) -> IndexReport:
        """Make the index unless it is there.

        Args:
            encoder: What embeds.
            progress: Shows how far it is.
            threads: Threads that decode and preprocess.
            pool: The index of the train pool, or None if this is the one.
        """
        embedded = 0
        if self.is_done(pool):
            progress.advance(self.frames, before=True)
        else:
            self.begin()
            embedded = self.embed(encoder, progress, threads)
            self.finish(encoder.centred, pool)
        shutil.rmtree(self.parts)
        header = read_json(self.folder / INDEX_HEADER)
        return IndexReport(self.folder, self.frames, embedded, header["typical_cosine"])

    def is_done(self, pool: EmbeddingIndex | None) -> bool:
        """Tell whether the index is there, made as planned, and whole."""
        try:
            header = read_json(self.folder / INDEX_HEADER)
            if pool is not None and (
                header["encoder"]["sha256"] != pool.fingerprint
                or header["typical_cosine"] != pool.typical_cosine
            ):
                return False
            described = {name: header[name] for name in self.plan}
            described["encoder"] = {n: header["encoder"][n] for n in self.plan["encoder"]}
            return canonical_json(described) == canonical_json(self.plan) and all(
                sha256_file(self.folder / name) == file["sha256"]
                for name, file in header["files"].items()
            )
        except (OSError, KeyError, TypeError, FormatError):
            return False

    def begin(self) -> None:
        """Drop what an earlier run left, unless it was made as planned."""
        plan = self.parts / _PLAN
        try:
            kept = canonical_json(read_json(plan)) == canonical_json(self.plan)
        except (OSError, FormatError):
            kept = False
        if not kept:
            for path in self.parts.glob("*.npy"):
                path.unlink()
            write_json(plan, self.plan)

    def embed(self, encoder: Encoder, progress: BuildProgress, threads: int) -> int:
        """Make the parts that are missing; returns the number of embedded frames."""
        missing = []
        for episode, length in enumerate(self.lengths):
            if self._part(episode) is None:
                missing.append(episode)
            else:
                progress.advance(length, before=True)
        rows: list[NDArray[np.float32]] = []
        for episode, stop, prepared in self._prepared(encoder, missing, threads):
            rows.append(encoder.features(prepared))
            progress.advance(len(rows[-1]))
            if stop == self.lengths[episode]:
                with atomic_path(self._path(episode)) as partial, partial.open("wb") as file:
                    np.save(file, np.concatenate(rows))
                rows = []
        return sum(self.lengths[episode] for episode in missing)

    def features(self) -> Iterator[NDArray[np.float32]]:
        """Yield the features of each episode, `(T, D) float32`."""
        for episode in range(len(self.lengths)):
            part = self._part(episode)
            if part is None:
                raise BuildError(
                    f"{self._path(episode)} has vanished", "Run the same command again."
                )
            yield part

    def finish(self, centred: bool, pool: EmbeddingIndex | None) -> None:
        """Write the index, its header last."""
        (self.folder / INDEX_HEADER).unlink(missing_ok=True)
        centre = (self._mean() if pool is None else pool.centre) if centred else None
        size = next(self.features()).shape[1]
        names = [INDEX_EMBEDDINGS, INDEX_ROWS]
        with atomic_path(self.folder / INDEX_EMBEDDINGS) as partial:
            out = np.lib.format.open_memmap(  # type: ignore[no-untyped-call]
                partial, mode="w+", dtype=np.float16, shape=(self.frames, size)
            )
            first = 0
            for features in self.features():
                out[first : first + len(features)] = normalised(features, centre)
                first += len(features)
            out.flush()
            if pool is None:
                typical = typical_cosine(np.split(out, np.cumsum(self.lengths)[:-1]))
            else:
                typical = pool.typical_cosine
            del out
        with atomic_path(self.folder / INDEX_ROWS) as partial:
            pq.write_table(self._rows(), partial)
        centre_sha256 = None
        if centre is not None:
            names.append(INDEX_CENTRE)
            with atomic_path(self.folder / INDEX_CENTRE) as partial, partial.open("wb") as file:
                np.save(file, centre)
            centre_sha256 = sha256_file(self.folder / INDEX_CENTRE)
        else:
            (self.folder / INDEX_CENTRE).unlink(missing_ok=True)
        encoder = self.plan["encoder"]
        digest = fingerprint_digest(encoder["fingerprint"], centre_sha256)
        header = {
            **self.plan,
            "encoder": {**encoder, "sha256": digest},
            "frames": self.frames,
            "size": size,
            "typical_cosine": typical,
            "files": {
                name: {
                    "bytes": (self.folder / name).stat().st_size,
                    "sha256": sha256_file(self.folder / name),
                }
                for name in names
            },
        }
        write_json(self.folder / INDEX_HEADER, header)

    def _prepared(
        self, encoder: Encoder, episodes: Sequence[int], threads: int
    ) -> Iterator[tuple[int, int, Any]]:
        """Yield `(episode, stop, prepared images)` in order, some batches ahead.

        A batch never spans two episodes, so that what is in it does not depend on what an earlier
        run left.
        """

        def prepare(episode: int, start: int, stop: int) -> Any:
            images = np.empty((stop - start, *self.dataset.features[self.camera]), np.uint8)
            self.dataset.read_frames(episode, self.camera, start, images)
            return encoder.prepare(images)

        waiting: deque[tuple[int, int, Future[Any]]] = deque()
        with ThreadPoolExecutor(threads) as pool:
            try:
                for episode in episodes:
                    for start in range(0, self.lengths[episode], encoder.batch):
                        stop = min(start + encoder.batch, self.lengths[episode])
                        waiting.append((episode, stop, pool.submit(prepare, episode, start, stop)))
                        if len(waiting) > 2 * threads:
                            done, last, future = waiting.popleft()
                            yield done, last, future.result()
                for done, last, future in waiting:
                    yield done, last, future.result()
            finally:
                pool.shutdown(cancel_futures=True)

    def _path(self, episode: int) -> Path:
        return self.parts / f"{episode}.npy"

    def _part(self, episode: int) -> NDArray[np.float32] | None:
        try:
            part = np.load(self._path(episode), mmap_mode="r")
        except (OSError, ValueError, EOFError):
            return None
        return part if len(part) == self.lengths[episode] else None

    def _mean(self) -> NDArray[np.float32]:
        """Return the mean of the features, `(D,) float32`, each episode weighing the same."""
        total = sum(features.mean(axis=0, dtype=np.float64) for features in self.features())
        return np.asarray(total / len(self.lengths), np.float32)

    def _rows(self) -> pa.Table:
        episodes = np.repeat(np.arange(len(self.lengths)), self.lengths)
        firsts = np.cumsum([0, *self.lengths[:-1]])
        rows = np.arange(self.frames)
        return pa.table(
            {
                "episode_index": pa.array(episodes, pa.int64()),
                "episode_id": self.dataset.episodes["episode_id"].take(pa.array(episodes)),
                "frame": pa.array(rows - np.repeat(firsts, self.lengths), pa.int32()),
                "row": pa.array(rows, pa.int64()),
            }
        )
