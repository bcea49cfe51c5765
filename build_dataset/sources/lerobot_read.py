"""Find the rows and stream the images of one episode of a LeRobot dataset."""

from collections.abc import Generator, Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.build_dataset.sources.images import decode_image, is_png
from robomme_interference_data.build_dataset.sources.lerobot_layout import EpisodePlace
from robomme_interference_data.build_dataset.sources.tables import RowSpan
from robomme_interference_data.errors import (
    FormatError,
    MissingFileError,
    SourceError,
    TruncatedVideoError,
)
from robomme_interference_data.files import Files
from robomme_interference_data.video import iter_frames

__all__ = ["episode_rows", "iter_images", "naming"]

_DAMAGED = "The dataset is damaged or incomplete: download it again."


@contextmanager
def naming(what: object) -> Iterator[None]:
    """Put an episode's name in front of what goes wrong with its files.

    Raises:
        SourceError: A file is missing or damaged, or does not fit the metadata.
    """
    try:
        yield
    except (MissingFileError, FormatError, TruncatedVideoError, SourceError) as error:
        raise SourceError(f"{what}: {error.message}", error.hint) from error


def episode_rows(files: Files, where: EpisodePlace) -> RowSpan:
    """Find the rows of an episode in its data file.

    Raises:
        MissingFileError, FormatError: The file is missing or cannot be read.
        SourceError: The rows are not all there, or not in order.
    """
    path = files.path(where.data)
    found = np.flatnonzero(RowSpan(path).scalars("episode_index") == where.index)
    if len(found) != where.length or found[-1] - found[0] + 1 != where.length:
        raise SourceError(
            f"{path} holds {len(found)} rows of it; {where.length}, one after the other, are "
            "expected",
            _DAMAGED,
        )
    rows = RowSpan(path, int(found[0]), int(found[-1]) + 1)
    if not np.array_equal(rows.scalars("frame_index"), np.arange(where.length)):
        raise SourceError(
            f"{path}: its frame_index does not count from 0 to {where.length - 1}", _DAMAGED
        )
    return rows


def iter_images(
    files: Files, where: EpisodePlace, column: str, rows: RowSpan, fps: float, exact: bool
) -> Generator[NDArray[np.uint8], None, None]:
    """Decode the images of an episode in order, `(H, W, 3) uint8` RGB, one in memory.

    Args:
        files: How to reach the dataset.
        where: The episode.
        column: The camera's column, stored as video or in parquet.
        rows: The episode's rows.
        fps: Frames per second of the dataset.
        exact: Whether the episode was listed as exact.

    Raises:
        MissingFileError, FormatError, TruncatedVideoError: The video or an image is missing or
            damaged.
        SourceError: A JPEG in an episode that was listed as exact.
    """
    if column in where.videos:
        relative, first = where.videos[column]
        yield from iter_frames(files.path(relative), first, first + where.length, fps)
        return
    for number, data in enumerate(rows.images(column)):
        if exact and not is_png(data):
            raise SourceError(
                f"frame {number} of column {column!r} is a JPEG, the dataset's first one a PNG",
                "Convert the dataset to PNG throughout, or leave the episode out.",
            )
        yield decode_image(data)
