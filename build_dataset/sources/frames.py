"""Source `frames`: a documented folder layout, for recordings of any robot.

`docs/sources.md` describes it: `frames.parquet` with one row a frame, and for each camera and
episode either a video file or a folder of PNG images.
"""

from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import InvalidIdError, SourceError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.simulators.base import choose_cameras
from robomme_interference_data.storage.parquet import RowSpan
from robomme_interference_data.storage.video import iter_frames

from .base import (
    Recording,
    Source,
    SourceEpisode,
    compose,
    file_state,
)
from .frames_table import (
    TABLE,
    EpisodeRows,
    read_frames_table,
)
from .images import (
    decode_images,
    probe_video,
)

_VIDEO_SUFFIXES = (".mkv", ".mp4", ".avi", ".mov", ".webm")
_REQUIRED_CAMERA = "front"


@dataclass(frozen=True)
class _Key:
    """Where an episode lies: its rows, its images by camera, and the state of all these files."""

    rows: EpisodeRows
    images: dict[str, Path]
    state: tuple[Any, ...]


class FramesSource(Source):
    """Episodes in a frames folder.

    Args:
        folder: The folder that holds `frames.parquet`.
    """

    def __init__(self, folder: Path):
        self._folder = folder
        self.provenance = {"kind": "frames"}
        if not (folder / TABLE).is_file():
            raise SourceError(
                f"{folder} is no frames folder: {TABLE} is missing",
                "docs/sources.md describes the layout, with an example that writes one.",
            )

    def episodes(self) -> list[SourceEpisode]:
        """List all episodes; see `Source.episodes`."""
        table = read_frames_table(self._folder / TABLE)
        places = self._find(sorted(table))
        return [
            SourceEpisode(name, _Key(rows, places[name], self._state(places[name])))
            for name, rows in sorted(table.items())
        ]

    def read(self, episode: SourceEpisode, cameras: tuple[str, ...] | None) -> Recording:
        """Open an episode; see `Source.read`."""
        key: _Key = episode.key
        chosen = choose_cameras(cameras, tuple(key.images))
        if self._state(key.images) != key.state:
            raise SourceError("its files have changed since they were listed", "Start again.")
        streams, exact = {}, True
        for camera in chosen:
            path, length = key.images[camera], key.rows.length
            if path.is_dir():
                _check_names(path, length)
                files = [path / _image_name(number) for number in range(length)]
                streams[camera] = decode_images(((f, f.read_bytes()) for f in files), exact=True)
            else:
                rate, lossless = probe_video(path)
                streams[camera] = _iter_video(path, rate, length)
                exact = exact and lossless
        rows = RowSpan(self._folder / TABLE, key.rows.start, key.rows.start + key.rows.length)
        actions = rows.vectors("action") if "action" in rows.names else None
        return Recording(
            goals=(key.rows.goal,),
            seed=key.rows.seed,
            difficulty=key.rows.difficulty,
            simulator=key.rows.simulator,
            exact=exact if key.rows.exact is None else key.rows.exact,
            frames=compose(streams, rows.vectors("state"), actions, key.rows.lesson),
        )

    def _find(self, episodes: Iterable[EpisodeId]) -> dict[EpisodeId, dict[str, Path]]:
        """Find the video or image folder of every camera of every episode."""
        found: dict[EpisodeId, dict[str, Path]] = {episode: {} for episode in episodes}
        for path, camera, name in self._image_places():
            try:
                episode = EpisodeId.parse(name)
            except InvalidIdError as error:
                raise SourceError(f"{path}: {error.message}", error.hint) from None
            if episode not in found:
                raise SourceError(
                    f"{path} belongs to {episode}, which {TABLE} does not list",
                    "Add the episode's rows to the table, or move the images out.",
                )
            if camera in found[episode]:
                raise SourceError(
                    f"camera {camera!r} of {episode} is there twice: "
                    f"{found[episode][camera]} and {path}",
                    "Keep one of the two.",
                )
            found[episode][camera] = path
        cameras = sorted({camera for places in found.values() for camera in places})
        for episode, places in found.items():
            for camera in (_REQUIRED_CAMERA, *cameras):
                if camera not in places:
                    raise SourceError(
                        f"{episode} has no images of camera {camera!r}",
                        f"Every episode of a folder needs the same cameras, {_REQUIRED_CAMERA!r} "
                        f"among them: add {self._folder}/videos/{camera}/{episode}.mkv or "
                        f"{self._folder}/images/{camera}/{episode}/000000.png and so on.",
                    )
        return found

    def _image_places(self) -> Iterator[tuple[Path, str, str]]:
        """Yield each video file and folder of images, its camera, and the episode's id."""
        for kind in ("videos", "images"):
            for path in sorted((self._folder / kind).glob("*/*/*/*")):
                if path.name.startswith("."):
                    continue
                if kind == "videos" and path.suffix.lower() not in _VIDEO_SUFFIXES:
                    raise SourceError(
                        f"{path} is no video file; expected one of {', '.join(_VIDEO_SUFFIXES)}",
                        "Move it out of the folder, or write it in one of these containers.",
                    )
                if kind == "images" and not path.is_dir():
                    raise SourceError(
                        f"{path} is a file; expected a folder with the images of an episode",
                        "Name them images/<camera>/<Family>/<split>/<index>/000000.png and so on.",
                    )
                camera, family, split = path.relative_to(self._folder / kind).parts[:3]
                index = path.stem if kind == "videos" else path.name
                yield path, camera, f"{family}/{split}/{index}"

    def _state(self, images: dict[str, Path]) -> tuple[Any, ...]:
        return tuple(file_state(path) for path in (self._folder / TABLE, *images.values()))


def _check_names(path: Path, length: int) -> None:
    """Check that a folder holds an image for each row, and nothing else."""
    expected = {_image_name(number) for number in range(length)}
    names = {file.name for file in path.iterdir() if not file.name.startswith(".")}
    if wrong := sorted(expected ^ names):
        what = f"lacks {wrong[0]}" if wrong[0] in expected else f"holds {wrong[0]}"
        raise SourceError(
            f"{path} {what}; {TABLE} has {length} rows, so it holds {_image_name(0)} to "
            f"{_image_name(length - 1)} and nothing else",
            "Number the images of an episode from 0, six digits, one for every row.",
        )


def _iter_video(path: Path, rate: float, length: int) -> Generator[NDArray[np.uint8]]:
    count = 0
    for count, image in enumerate(iter_frames(path, 0, None, rate), 1):
        if count <= length:
            yield image
    if count != length:
        raise SourceError(
            f"{path} holds {count} frames; {TABLE} has {length} rows",
            "Write the video again with one frame for every row.",
        )


def _image_name(number: int) -> str:
    return f"{number:06d}.png"
