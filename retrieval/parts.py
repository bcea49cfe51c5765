"""What is done of an index that is being made: the features of each episode, in a hidden folder."""

import shutil
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.dataset import Dataset
from robomme_interference_data.errors import BuildError, FormatError
from robomme_interference_data.files import atomic_path, canonical_json, read_json, write_json
from robomme_interference_data.progress import BuildProgress
from robomme_interference_data.retrieval.encoders.base import Encoder

__all__ = ["Parts"]

_PLAN = "plan.json"


class Parts:
    """The features of a dataset's episodes, a file each: an interrupted run goes on from there.

    Args:
        folder: Where they lie until the index is whole.
        dataset: The dataset.
        camera: Feature name of the camera that is embedded.
    """

    def __init__(self, folder: Path, dataset: Dataset, camera: str):
        self.folder = folder
        self._dataset = dataset
        self._camera = camera
        self.lengths = [record.length for record in dataset.records()]

    def begin(self, plan: dict[str, Any], *, force: bool) -> None:
        """Drop what an earlier run left, unless it was made as planned.

        Args:
            plan: What determines the features; under `computed` the device and the batch, which
                change them by what the precision leaves open.
            force: Drop it anyhow.

        Raises:
            BuildError: It was computed on another device or in other batches.
        """
        path = self.folder / _PLAN
        try:
            found = read_json(path)
        except (OSError, FormatError):
            found = {}
        if not force and canonical_json(found) == canonical_json(plan):
            return
        if not force and canonical_json({**found, "computed": plan["computed"]}) == canonical_json(
            plan
        ):
            was, now = found["computed"], plan["computed"]
            raise BuildError(
                f"{self.folder} holds what an interrupted run computed with {was['in']}, "
                f"{was['batch']} images at a time; now {now['in']}, {now['batch']} at a time",
                f"Give the same --device and --batch {was['batch']} to go on, or --force to begin "
                "anew.",
            )
        for part in self.folder.glob("*.npy"):
            part.unlink()
        write_json(path, plan)

    def embed(self, encoder: Encoder, progress: BuildProgress, threads: int) -> int:
        """Make the parts that are missing; returns the number of embedded frames.

        Raises:
            BuildError: The encoder gave something that is no finite number.
        """
        missing = []
        for episode, length in enumerate(self.lengths):
            if self._part(episode) is None:
                missing.append(episode)
            else:
                progress.advance(length, before=True)
        rows: list[NDArray[np.float32]] = []
        for episode, stop, prepared in self._prepared(encoder, missing, threads):
            features = encoder.features(prepared)
            if not np.isfinite(features).all():
                raise BuildError(
                    f"encoder {encoder.name!r} gave values that are not finite for frames up to "
                    f"{stop - 1} of {self._dataset.record(episode).id}",
                    "Its weights may be damaged, or its precision too low: try --device cpu",
                )
            rows.append(features)
            progress.advance(len(features))
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

    def remove(self) -> None:
        """Remove the folder: the index is whole."""
        shutil.rmtree(self.folder)

    def _prepared(
        self, encoder: Encoder, episodes: Sequence[int], threads: int
    ) -> Iterator[tuple[int, int, Any]]:
        """Yield `(episode, stop, prepared images)` in order, some batches ahead.

        A batch never spans two episodes, so that what is in it does not depend on what an earlier
        run left.
        """

        def prepare(episode: int, start: int, stop: int) -> Any:
            images = np.empty((stop - start, *self._dataset.features[self._camera]), np.uint8)
            self._dataset.read_frames(episode, self._camera, start, images)
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
        return self.folder / f"{episode}.npy"

    def _part(self, episode: int) -> NDArray[np.float32] | None:
        try:
            part = np.load(self._path(episode), mmap_mode="r")
        except (OSError, ValueError, EOFError):
            return None
        return part if len(part) == self.lengths[episode] else None
