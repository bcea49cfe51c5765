"""Make the index of a dataset: embed every stored frame of a camera, and keep it beside the data.

An index is made in a hidden folder beside its place, an episode at a time, so that an interrupted
run goes on from there. The header is written last: without it there is no index.
"""

from collections.abc import Sequence
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
from robomme_interference_data.embeddings import (
    EmbeddingIndex,
    encoder_id,
    index_folder,
    normalised,
)
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
from robomme_interference_data.retrieval.parts import Parts
from robomme_interference_data.retrieval.segment import typical_cosine

__all__ = ["IndexReport", "build_index"]


@dataclass(frozen=True)
class IndexReport:
    """What was done for one dataset.

    Attributes:
        folder: Where the index lies.
        frames: Frames in it.
        embedded: Frames that were embedded now; the others were there already.
        typical_cosine: Median cosine of two frames of the train pool.
        computed_in: Where and in which precision it was computed, in words.
        batch: How many images at a time.
    """

    folder: Path
    frames: int
    embedded: int
    typical_cosine: float
    computed_in: str
    batch: int


def build_index(
    roots: Sequence[Path],
    encoder: Encoder,
    progress: BuildProgress,
    *,
    camera: str = "front",
    threads: int = 1,
    force: bool = False,
) -> list[IndexReport]:
    """Embed every stored frame of datasets whose frames are to be compared with each other.

    What an encoder is centred on, and what it finds in any two frames, come from the train pool
    alone: the distractor units. So the embedding of a frame, and where its history is cut, depend
    on no other query. The same data, encoder, device and batch give the same bytes, interrupted or
    not. An index that is there and right is left as it is, on whatever device it was computed.

    Args:
        roots: Folders of the datasets, one of them the distractor units.
        encoder: What embeds.
        progress: Shows how far it is.
        camera: Camera to embed, with or without `observation.images.`.
        threads: Threads that decode and preprocess beside the encoder.
        force: Make all of it again.

    Raises:
        UnknownNameError: A dataset has no such camera.
        InvalidOptionError: There are no distractor units among them.
        BuildError: Another process makes one of the indexes, an interrupted run computed its part
            differently, or the encoder gave something that is no finite number.
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
            reports[work] = work.make(progress, threads, pool, force=force)
            if pool is None:
                pool = units.index(encoder.name, camera)
        return [reports[work] for work in works]


class _Work:
    """The index of one dataset, being made."""

    def __init__(self, dataset: Dataset, encoder: Encoder, camera: str, pool: str):
        assert isinstance(dataset.files, LocalFiles)
        self.dataset = dataset
        self.encoder = encoder
        feature = CAMERA_PREFIX + camera.removeprefix(CAMERA_PREFIX)
        if feature not in dataset.cameras:
            known = [name.removeprefix(CAMERA_PREFIX) for name in dataset.cameras]
            raise UnknownNameError(
                f"camera {camera!r} is not in {dataset.files.describe()}", nearest(camera, known)
            )
        self.folder = dataset.files.root / index_folder(encoder.name, feature)
        self.parts = Parts(self.folder.parent / f".{self.folder.name}.building", dataset, feature)
        self.frames = sum(self.parts.lengths)
        self.plan: dict[str, Any] = {
            "format_version": FORMAT_VERSION,
            "encoder": {"name": encoder_id(encoder.name), "fingerprint": encoder.fingerprint},
            "computed": {"in": encoder.computed_in, "batch": encoder.batch},
            "camera": feature,
            "pool": pool,
            "revision": dataset.revision,
        }

    def holding(self) -> Any:
        self.parts.folder.mkdir(parents=True, exist_ok=True)
        busy = BuildError(f"another process makes {self.folder}", "Wait for it to end, or stop it.")
        return hold(self.parts.folder / "lock", busy)

    def make(
        self, progress: BuildProgress, threads: int, pool: EmbeddingIndex | None, *, force: bool
    ) -> IndexReport:
        """Make the index unless it is there.

        Args:
            progress: Shows how far it is.
            threads: Threads that decode and preprocess.
            pool: The index of the train pool, or None if this is the one.
            force: Make it even if it is there.
        """
        for folder in (self.folder, self.parts.folder):
            for partial in folder.glob(".*.partial"):  # of a run that was killed while writing
                partial.unlink()
        embedded = 0
        if not force and self.is_done(pool):
            progress.advance(self.frames, before=True)
        else:
            self.parts.begin(self.plan, force=force)
            embedded = self.parts.embed(self.encoder, progress, threads)
            self.finish(pool)
        self.parts.remove()
        header = read_json(self.folder / INDEX_HEADER)
        computed = header["computed"]
        typical = header["typical_cosine"]
        return IndexReport(
            self.folder, self.frames, embedded, typical, computed["in"], computed["batch"]
        )

    def is_done(self, pool: EmbeddingIndex | None) -> bool:
        """Tell whether the index is there, made as planned on whatever device, and whole."""
        try:
            header = read_json(self.folder / INDEX_HEADER)
            if pool is not None and (
                header["encoder"]["sha256"] != pool.fingerprint
                or header["typical_cosine"] != pool.typical_cosine
            ):
                return False
            computed = {name: header["computed"][name] for name in self.plan["computed"]}
            described = {name: header[name] for name in self.plan}
            described["encoder"] = {n: header["encoder"][n] for n in self.plan["encoder"]}
            wanted = {**self.plan, "computed": computed}
            return canonical_json(described) == canonical_json(wanted) and all(
                sha256_file(self.folder / name) == file["sha256"]
                for name, file in header["files"].items()
            )
        except (OSError, KeyError, TypeError, FormatError):
            return False

    def finish(self, pool: EmbeddingIndex | None) -> None:
        """Write the index, its header last."""
        (self.folder / INDEX_HEADER).unlink(missing_ok=True)
        centre = None
        if self.encoder.centred:
            centre = self._mean() if pool is None else pool.centre
        size = next(self.parts.features()).shape[1]
        names = [INDEX_EMBEDDINGS, INDEX_ROWS]
        with atomic_path(self.folder / INDEX_EMBEDDINGS) as partial:
            out = np.lib.format.open_memmap(  # type: ignore[no-untyped-call]
                partial, mode="w+", dtype=np.float16, shape=(self.frames, size)
            )
            first = 0
            for features in self.parts.features():
                out[first : first + len(features)] = normalised(features, centre)
                first += len(features)
            out.flush()
            if pool is None:
                typical = typical_cosine(np.split(out, np.cumsum(self.parts.lengths)[:-1]))
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

    def _mean(self) -> NDArray[np.float32]:
        """Return the mean of the features, `(D,) float32`, each episode weighing the same."""
        means = (features.mean(axis=0, dtype=np.float64) for features in self.parts.features())
        return np.asarray(sum(means) / len(self.parts.lengths), np.float32)

    def _rows(self) -> pa.Table:
        lengths = self.parts.lengths
        episodes = np.repeat(np.arange(len(lengths)), lengths)
        firsts = np.cumsum([0, *lengths[:-1]])
        rows = np.arange(self.frames)
        return pa.table(
            {
                "episode_index": pa.array(episodes, pa.int64()),
                "episode_id": self.dataset.episodes["episode_id"].take(pa.array(episodes)),
                "frame": pa.array(rows - np.repeat(firsts, lengths), pa.int32()),
                "row": pa.array(rows, pa.int64()),
            }
        )
