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

from robomme_interference_data.build_dataset.sources.base import Frame, SourceEpisode
from robomme_interference_data.build_dataset.sources.exactness import (
    probe_video,
    stream_is_exact,
)
from robomme_interference_data.build_dataset.sources.frames_table import (
    TABLE,
    EpisodeRows,
    read_frames_table,
)
from robomme_interference_data.build_dataset.sources.images import (
    check_size,
    decode_image,
    png_size,
)
from robomme_interference_data.build_dataset.sources.tables import RowSpan
from robomme_interference_data.errors import (
    FormatError,
    InvalidIdError,
    MissingFileError,
    SourceError,
    TruncatedVideoError,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.video import iter_frames

__all__ = ["FramesSource"]

_VIDEO_SUFFIXES = (".mkv", ".mp4", ".avi", ".mov", ".webm")
_REQUIRED_CAMERA = "front"


@dataclass(frozen=True)
class _Images:
    """Where the images of one camera of an episode are.

    Attributes:
        path: Video file or folder of PNG images, relative to the source's folder.
        rate: Frames per second of the video; None for a folder.
        size: `(height, width)` in pixels.
        exact: Whether the files are certain to keep every pixel.
        state: What changes when the files do: their latest time and total size.
    """

    path: str
    rate: float | None
    size: tuple[int, int]
    exact: bool
    state: tuple[int, int]


@dataclass(frozen=True)
class _Key:
    """Where an episode lies: its rows, its images by camera, and the state of the table."""

    start: int
    images: dict[str, _Images]
    state: tuple[int, int]


class FramesSource:
    """Episodes in a frames folder.

    Args:
        folder: The folder that holds `frames.parquet`.

    Raises:
        SourceError: There is no such table in it.
    """

    kind = "frames"

    def __init__(self, folder: Path):
        self._folder = folder
        self.provenance: dict[str, Any] = {"kind": self.kind}
        if not (folder / TABLE).is_file():
            raise SourceError(
                f"{folder} is no frames folder: {TABLE} is missing",
                "docs/sources.md describes the layout, with an example that writes one.",
            )

    def episodes(self) -> list[SourceEpisode]:
        """List all episodes; see `Source.episodes`.

        Raises:
            SourceError: The folder is not as described; says which episode and file, and what to
                do.
        """
        path = self._folder / TABLE
        table = read_frames_table(path)
        state = _state(path)
        places = self._find([episode.id for episode in table.episodes])
        found = []
        for episode in table.episodes:
            images = {
                camera: self._probe(episode, place)
                for camera, place in sorted(places[episode.id].items())
            }
            declared = episode.values["exact"]
            certain = all(image.exact for image in images.values())
            found.append(
                SourceEpisode(
                    id=episode.id,
                    goals=(episode.goal,),
                    raw_length=episode.length,
                    demonstration_length=episode.demonstration_length,
                    seed=episode.values["seed"],
                    difficulty=episode.values["difficulty"],
                    simulator=episode.values["simulator"],
                    exact=certain if declared is None else declared,
                    cameras={camera: image.size for camera, image in images.items()},
                    key=_Key(episode.start, images, state),
                    state_size=table.state_size,
                    action_size=table.action_size,
                )
            )
        return sorted(found, key=lambda episode: episode.id)

    def read(self, episode: SourceEpisode) -> Generator[Frame, None, None]:
        """Stream the frames of an episode; see `Source.read`.

        Raises:
            SourceError: A video or image is damaged, has another size, or is not there, or a
                video has more or fewer frames than the table has rows.
        """
        key: _Key = episode.key
        try:
            if _state(self._folder / TABLE) != key.state:
                raise SourceError(f"{TABLE} has changed since it was listed", "Start again.")
            rows = RowSpan(self._folder / TABLE, key.start, key.start + episode.raw_length)
            states = rows.vectors("state")
            actions = None if episode.action_size is None else rows.vectors("action")
            with ExitStack() as stack:
                streams = {
                    camera: stack.enter_context(closing(self._stream(episode, key.images[camera])))
                    for camera in episode.cameras
                }
                for number in range(episode.raw_length):
                    found = {}
                    for camera, stream in streams.items():
                        image = next(stream, None)
                        if image is None:
                            raise self._miscounted(episode, camera, number)
                        check_size(image, episode.cameras[camera], camera, number, "the first one")
                        found[camera] = image
                    start = episode.demonstration_length
                    yield Frame(
                        images=found,
                        state=states[number],
                        action=None if actions is None else actions[number],
                        is_demonstration=None if start is None else number < start,
                    )
                for camera, stream in streams.items():
                    more = sum(1 for _ in stream)
                    if more:
                        raise self._miscounted(episode, camera, episode.raw_length + more)
        except (FormatError, MissingFileError, TruncatedVideoError, SourceError) as error:
            raise SourceError(f"{episode.id}: {error.message}", error.hint) from error

    def _find(self, episodes: list[EpisodeId]) -> dict[EpisodeId, dict[str, Path]]:
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
                try:
                    episode = EpisodeId.parse(
                        f"{family}/{split}/{path.stem if kind == 'videos' else path.name}"
                    )
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

    def _probe(self, episode: EpisodeRows, path: Path) -> _Images:
        relative = path.relative_to(self._folder).as_posix()
        try:
            if path.is_dir():
                _check_names(path, episode.length)
                with (path / _image_name(0)).open("rb") as first:
                    size = png_size(first.read(24))
                return _Images(relative, None, size, True, _state(path))
            stream = probe_video(path)
            if stream.rate is None:
                raise SourceError(
                    f"{path} does not say its frame rate",
                    "Write it again with a constant frame rate, for example as .mkv.",
                )
            exact = stream_is_exact(stream)
            return _Images(relative, stream.rate, stream.size, exact, _state(path))
        except (FormatError, SourceError, OSError) as error:
            message = error.message if isinstance(error, FormatError | SourceError) else error
            hint = error.hint if isinstance(error, FormatError | SourceError) else None
            raise SourceError(f"{episode.id}: {message}", hint) from error

    def _stream(
        self, episode: SourceEpisode, images: _Images
    ) -> Generator[NDArray[np.uint8], None, None]:
        path = self._folder / images.path
        if images.rate is not None:
            yield from iter_frames(path, 0, None, images.rate)
            return
        for number in range(episode.raw_length):
            file = path / _image_name(number)
            try:
                yield decode_image(file.read_bytes())
            except FormatError as error:
                raise SourceError(f"{file}: {error.message}", error.hint) from None
            except OSError as error:
                raise SourceError(f"{file} cannot be read: {error.strerror}") from None

    def _miscounted(self, episode: SourceEpisode, camera: str, frames: int) -> SourceError:
        return SourceError(
            f"{self._folder / episode.key.images[camera].path} holds {frames} frames; {TABLE} has "
            f"{episode.raw_length} rows",
            "Write the video again with one frame for every row.",
        )


def _check_names(folder: Path, length: int) -> None:
    """Check that a folder holds the images 0 to `length - 1`, and no others."""
    expected = {_image_name(number) for number in range(length)}
    names = {path.name for path in folder.iterdir() if not path.name.startswith(".")}
    missing, extra = sorted(expected - names), sorted(names - expected)
    if missing or extra:
        what = f"lacks {missing[0]}" if missing else f"holds {extra[0]}"
        raise SourceError(
            f"{folder} {what}; {TABLE} has {length} rows, so it holds {_image_name(0)} to "
            f"{_image_name(length - 1)} and nothing else",
            "Number the images of an episode from 0, six digits, one for every row.",
        )


def _image_name(number: int) -> str:
    return f"{number:06d}.png"


def _state(path: Path) -> tuple[int, int]:
    found = [file.stat() for file in (path.iterdir() if path.is_dir() else [path])]
    return max(each.st_mtime_ns for each in found), sum(each.st_size for each in found)
