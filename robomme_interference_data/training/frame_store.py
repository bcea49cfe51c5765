"""All values of a dataset's feature in one memory-mapped array, to read items at random.

Decoding a video takes milliseconds a frame; training reads each frame many times. So frames are
decoded once, compared with their SHA-256, resized, and stored in
`FOLDER/<kind>-<revision>/<feature>-<size>px/values.npy`, beside the states and actions.
"""

import math
import os
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import CAMERA_PREFIX
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.errors import BusyError, FormatError, HashMismatchError
from robomme_interference_data.runtime.progress import WorkProgress
from robomme_interference_data.storage.arrays import FeatureDigests, allocate_array, map_array
from robomme_interference_data.storage.staging import replace_folder, staging_dir

from .images import resize

_VALUES = "values.npy"

_PAUSE_S = 0.5
"""Seconds between looks at the work of another process."""


def first_rows(dataset: Dataset) -> NDArray[np.int64]:
    """Return the row of each episode's first frame, and the number of rows: `(E + 1,) int64`."""
    return np.cumsum([0, *(record.length for record in dataset.records())], dtype=np.int64)


def stored_values(
    dataset: Dataset, feature: str, folder: Path, size: int | None, progress: WorkProgress
) -> NDArray[Any]:
    """Return all values of a feature, episode after episode, as a read-only memory map.

    They are stored at the first call, which resumes after an interruption. If another process is
    storing them, such as another rank of the same training, this one waits for it.

    Args:
        dataset: The dataset.
        feature: `observation.images.front`, `observation.state`, …
        folder: Folder of the store.
        size: Side of resized images in pixels; None for no change of size. Not for vectors.
        progress: Shows the number of stored episodes.

    Returns:
        Images `(N, 3, H, W) uint8`, vectors `(N, D) float32`; N is the last one of `first_rows`.

    Raises:
        HashMismatchError: Frames or vectors differ from the recorded ones.
        OSError: The disk is full.
    """
    shape, dtype = _layout(dataset, feature, size)
    name = feature if size is None else f"{feature}-{size}px"
    out = folder / f"{dataset.kind}-{dataset.revision[:16]}" / name
    while not (out / _VALUES).is_file():
        try:
            with staging_dir(out) as work:
                _store(dataset, feature, size, work, progress)
                replace_folder(work / "values", out)
        except BusyError:
            with progress.status(f"Waiting for another process that stores {feature}"):
                time.sleep(_PAUSE_S)
    try:
        return map_array(out / _VALUES, dtype, shape)
    except FormatError as error:
        hint = f"It is a copy of stored frames: delete {out}, and the next use makes it again."
        raise FormatError(error.message, hint) from None


def _layout(dataset: Dataset, feature: str, size: int | None) -> tuple[tuple[int, ...], Any]:
    rows, value = int(first_rows(dataset)[-1]), dataset.features[feature]
    if not feature.startswith(CAMERA_PREFIX):
        return (rows, *value), np.float32
    height, width, _ = value
    return (rows, 3, size or height, size or width), np.uint8


def _store(
    dataset: Dataset, feature: str, size: int | None, work: Path, progress: WorkProgress
) -> None:
    """Write `values/values.npy` in a staging folder; files in `done` mark stored episodes."""
    shape, dtype = _layout(dataset, feature, size)
    path, done = work / "values" / _VALUES, work / "done"
    if done.is_dir():
        values = np.lib.format.open_memmap(path, "r+")  # type: ignore[no-untyped-call]
    else:
        path.parent.mkdir(exist_ok=True)
        try:
            values = allocate_array(path, dtype, shape)
        except OSError as error:
            size = math.prod(shape) * np.dtype(dtype).itemsize
            what = f"{error.strerror}: {size / 1e6:,.0f} MB of {feature} in {work.parent}"
            raise OSError(error.errno, f"{what}; free space, or set another `store`") from None
        done.mkdir()
    rows = first_rows(dataset)
    missing = [episode for episode in range(len(dataset)) if not (done / str(episode)).exists()]

    def store(episode: int) -> None:
        target = values[rows[episode] : rows[episode + 1]]
        _read(dataset, feature, episode, size, target)
        values.flush()
        (done / str(episode)).touch()

    progress.start(f"{dataset.kind}: {feature.rpartition('.')[2]}", len(dataset))
    progress.advance(len(dataset) - len(missing), before=True)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        try:
            for stored in as_completed([pool.submit(store, episode) for episode in missing]):
                stored.result()
                progress.advance(1)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _read(
    dataset: Dataset, feature: str, episode: int, size: int | None, target: NDArray[Any]
) -> None:
    """Read an episode's values into `target`, and compare those of its session with the digest."""
    record, digests = dataset.record(episode), FeatureDigests()
    start, stop = record.session
    if feature.startswith(CAMERA_PREFIX):
        for index, frame in enumerate(dataset.iter_frames(episode, feature, 0, record.length)):
            if start <= index < stop:
                digests.update(feature, frame)
            target[index] = resize(frame[None], size)[0]
    else:
        target[...] = dataset.read_vectors(episode, feature, 0, record.length)
        digests.update(feature, target[start:stop])
    if digests.current()[feature] != record.feature_sha256.get(feature):
        raise HashMismatchError.damaged(
            f"{dataset.files.describe()}: {feature} of {record.episode_id} does not have the "
            "recorded SHA-256"
        )
