"""Source `frames`: a documented folder layout, for recordings of any robot.

`docs/sources.md` describes it: `frames.parquet` with one row a frame, and for each camera and
episode either a video file or a folder of PNG images.
"""

from collections.abc import Generator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.build_dataset.sources.base import (
    Frame,
    Recording,
    SourceEpisode,
    choose_cameras,
)
from robomme_interference_data.build_dataset.sources.exactness import probe_video, stream_is_exact
from robomme_interference_data.build_dataset.sources.frames_table import (
    TABLE,
    EpisodeRows,
    read_frames_table,
)
from robomme_interference_data.build_dataset.sources.images import decode_image
from robomme_interference_data.errors import InterferenceError, InvalidIdError, SourceError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.parquet import RowSpan
from robomme_interference_data.video import iter_frames

__all__ = ["FramesSource"]

_VIDEO_SUFFIXES = (".mkv", ".mp4", ".avi", ".mov", ".webm")
_REQUIRED_CAMERA = "front"


@dataclass(frozen=True)
class _Key:
    """Where an episode lies: its rows, its images by camera, and the state of all these files."""

    rows: EpisodeRows
    images: dict[str, Path]
    state: tuple[Any, ...]


class FramesSource:
    """Episodes in a frames folder.

    Args:
        folder: The folder that holds `frames.parquet`.

    Raises:
        SourceError: There is no such table in it.
    """

    time_limit = 1800.0
    whole = True

    def __init__(self, folder: Path):
        self._folder = folder
        self.provenance: dict[str, Any] = {"kind": "frames"}
        if not (folder / TABLE).is_file():
            raise SourceError(
                f"{folder} is no frames folder: {TABLE} is missing",
                "docs/sources.md describes the layout, with an example that writes one.",
            )

    def episodes(self) -> list[SourceEpisode]:
        """List all episodes; see `Source.episodes`."""
        path = self._folder / TABLE
        table = read_frames_table(path)
        places = self._find(set(table))
        found = []
        for name, rows in sorted(table.items()):
            images = dict(sorted(places[name].items()))
            state = (_state(path), *map(_state, images.values()))
            found.append(SourceEpisode(name, _Key(rows, images, state)))
        return found

    def read(self, episode: SourceEpisode, cameras: tuple[str, ...] | None) -> Recording:
        """Open an episode; see `Source.read`."""
        key: _Key = episode.key
        chosen = choose_cameras(cameras, tuple(key.images), episode.id)
        try:
            if (_state(self._folder / TABLE), *map(_state, key.images.values())) != key.state:
                raise SourceError("its files have changed since they were listed", "Start again.")
            rates = {camera: _rate(key.images[camera], key.rows.length) for camera in chosen}
        except (InterferenceError, OSError) as error:
            raise _about(episode, error) from error
        declared = key.rows.values["exact"]
        certain = all(exact for _, exact in rates.values())
        return Recording(
            goals=(key.rows.goal,),
            seed=key.rows.values["seed"],
            difficulty=key.rows.values["difficulty"],
            simulator=key.rows.values["simulator"],
            exact=certain if declared is None else declared,
            frames=self._frames(episode, {camera: rate for camera, (rate, _) in rates.items()}),
        )

    def close(self) -> None:
        """Nothing is held."""

    def _frames(self, episode: SourceEpisode, rates: dict[str, float | None]) -> Generator[Frame]:
        key: _Key = episode.key
        length, start = key.rows.length, key.rows.demonstration_length
        try:
            rows = RowSpan(self._folder / TABLE, key.rows.start, key.rows.start + length)
            states = rows.vectors("state")
            actions = rows.vectors("action") if key.rows.actions else None
            with ExitStack() as stack:
                streams = {
                    camera: stack.enter_context(closing(_stream(key.images[camera], rate, length)))
                    for camera, rate in rates.items()
                }
                for number in range(length):
                    images = {camera: next(stream, None) for camera, stream in streams.items()}
                    for camera, image in images.items():
                        if image is None:
                            raise _miscounted(key.images[camera], number, length)
                    yield Frame(
                        images={camera: i for camera, i in images.items() if i is not None},
                        state=states[number],
                        action=None if actions is None else actions[number],
                        is_demonstration=None if start is None else number < start,
                    )
                for camera, stream in streams.items():
                    if more := sum(1 for _ in stream):
                        raise _miscounted(key.images[camera], length + more, length)
        except (InterferenceError, OSError) as error:
            raise _about(episode, error) from error

    def _find(self, episodes: set[EpisodeId]) -> dict[EpisodeId, dict[str, Path]]:
        """Find the video or image folder of every camera of every episode."""
        found: dict[EpisodeId, dict[str, Path]] = {episode: {} for episode in episodes}
        for kind in ("videos", "images"):
            for path in sorted((self._folder / kind).glob("*/*/*/*")):
                if path.name.startswith("."):
                    continue
                camera, family, split = path.relative_to(self._folder / kind).parts[:3]
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
                index = path.stem if kind == "videos" else path.name
                try:
                    episode = EpisodeId.parse(f"{family}/{split}/{index}")
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


def _rate(path: Path, length: int) -> tuple[float | None, bool]:
    """Return the frame rate of a video, None of a folder, and whether it surely keeps pixels."""
    if path.is_dir():
        expected = {_image_name(number) for number in range(length)}
        names = {path.name for path in path.iterdir() if not path.name.startswith(".")}
        if wrong := sorted(expected ^ names):
            what = f"lacks {wrong[0]}" if wrong[0] in expected else f"holds {wrong[0]}"
            raise SourceError(
                f"{path} {what}; {TABLE} has {length} rows, so it holds {_image_name(0)} to "
                f"{_image_name(length - 1)} and nothing else",
                "Number the images of an episode from 0, six digits, one for every row.",
            )
        return None, True
    stream = probe_video(path)
    if stream.rate is None:
        raise SourceError(
            f"{path} does not say its frame rate",
            "Write it again with a constant frame rate, for example as .mkv.",
        )
    return stream.rate, stream_is_exact(stream)


def _stream(path: Path, rate: float | None, length: int) -> Generator[NDArray[np.uint8]]:
    """Yield the images of an episode, all of one size."""
    if rate is not None:
        yield from iter_frames(path, 0, None, rate)
        return
    for number in range(length):
        file = path / _image_name(number)
        try:
            yield decode_image(file.read_bytes())
        except InterferenceError as error:
            raise error.about(file) from None


def _miscounted(path: Path, frames: int, rows: int) -> SourceError:
    return SourceError(
        f"{path} holds {frames} frames; {TABLE} has {rows} rows",
        "Write the video again with one frame for every row.",
    )


def _about(episode: SourceEpisode, error: InterferenceError | OSError) -> SourceError:
    if isinstance(error, InterferenceError):
        return SourceError(f"{episode.id}: {error.message}", error.hint)
    return SourceError(f"{episode.id}: {error.filename} cannot be read: {error.strerror}")


def _image_name(number: int) -> str:
    return f"{number:06d}.png"


def _state(path: Path) -> tuple[int, int]:
    """Return what changes when a file or a folder's files do: latest time and total size."""
    found = [file.stat() for file in (path.iterdir() if path.is_dir() else [path])]
    latest = max((each.st_mtime_ns for each in found), default=0)
    return latest, sum(each.st_size for each in found)
