"""Source `frames`: a documented folder layout, for recordings of any robot.

`frames.parquet` has one row per frame, and each camera and episode has either a video file or a
folder of PNG images; see `docs/how-to/your-own-recordings.md`.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, override

from robomme_interference_data.errors import InvalidIdError, InvalidOptionError, SourceError, named
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.simulators.episode import choose_cameras
from robomme_interference_data.storage.files import is_hidden
from robomme_interference_data.storage.parquet import RowSpan
from robomme_interference_data.storage.text import read_bytes
from robomme_interference_data.storage.video.frames import iter_frames

from ..alike import same_rate
from .base import Recording, Robot, Source, SourceEpisode, compose, file_state
from .frames_table import LAYOUT, TABLE, EpisodeRows, read_frames_table
from .images import decode_images, probe_video

_MAX_IMAGE_BYTES = 256 << 20
"""Four times the bytes of the largest image that is decoded."""

_VIDEO_SUFFIXES = (".mkv", ".mp4", ".avi", ".mov", ".webm")


@dataclass(frozen=True)
class _Key:
    """An episode's rows, all cameras of the folder, its own images, and the state of its files."""

    rows: EpisodeRows
    cameras: tuple[str, ...]
    images: dict[str, Path]
    state: tuple[Any, ...]


class FramesSource(Source):
    """Episodes in a frames folder, the one that holds `frames.parquet`."""

    def __init__(self, location: str | Path):
        self._folder = Path(location).expanduser()
        self.provenance = {"kind": "frames"}
        if not (self._folder / TABLE).is_file():
            raise SourceError(f"{self._folder} is no frames folder: {TABLE} is missing", LAYOUT)

    @override
    def episodes(self) -> list[SourceEpisode]:
        table = read_frames_table(self._folder / TABLE)
        images: dict[EpisodeId, dict[str, Path]] = {episode: {} for episode in sorted(table)}
        for path, camera, name in self._image_paths():
            try:
                episode = EpisodeId.parse(name)
            except InvalidIdError as error:
                raise SourceError(f"{path}: {error.message}", error.hint) from None
            if episode not in images:
                raise SourceError(f"{path} belongs to {episode}, which {TABLE} does not list")
            other = images[episode].setdefault(camera, path)
            if other != path:
                raise SourceError(
                    f"camera {camera!r} of {episode} has two recordings: {other} and {path}",
                    "Keep one of them.",
                )
        cameras = tuple(sorted({camera for paths in images.values() for camera in paths}))
        return [self._listed(name, table[name], cameras, paths) for name, paths in images.items()]

    def _listed(
        self,
        name: EpisodeId,
        rows: EpisodeRows | SourceError,
        cameras: tuple[str, ...],
        paths: dict[str, Path],
    ) -> SourceEpisode:
        if isinstance(rows, SourceError):
            return SourceEpisode(name, problem=rows)
        key = _Key(rows, cameras, paths, self._state(paths))
        return SourceEpisode(name, key, marked=rows.lesson is not None)

    @override
    def read(self, episode: SourceEpisode, cameras: tuple[str, ...] | None) -> Recording:
        episode.check()
        key: _Key = episode.key
        if not key.cameras and cameras != ():
            raise InvalidOptionError(
                f"{self._folder} has neither videos nor images",
                f"Add {self._folder}/videos/CAMERA/{episode.id}.mkv or "
                f"{self._folder}/images/CAMERA/{episode.id}/000000.png and so on, with the name of "
                f"the camera, or set {named('cameras')} to none, to store states alone.",
            )
        chosen = choose_cameras(cameras, key.cameras)
        for camera in chosen:
            if camera not in key.images:
                raise SourceError(
                    f"it has no images of camera {camera!r}",
                    f"Add {self._folder}/videos/{camera}/{episode.id}.mkv or "
                    f"{self._folder}/images/{camera}/{episode.id}/000000.png and so on, or leave "
                    f"the camera out with {named('cameras')}.",
                )
        if self._state(key.images) != key.state:
            raise SourceError("its files have changed since they were listed", "Start again.")
        streams, exact = {}, True
        rates: set[float] = set()
        for camera in chosen:
            path, length = key.images[camera], key.rows.length
            if path.is_dir():
                _check_names(path, length)
                files = [path / _image_name(number) for number in range(length)]
                streams[camera] = decode_images(
                    ((f, read_bytes(f, _MAX_IMAGE_BYTES)) for f in files), exact=True
                )
            else:
                video = probe_video(path, key.rows.fps)
                if video.count != length:
                    raise SourceError(
                        f"{path} holds {video.count} frames; {TABLE} has {length} rows",
                        "Write a row for each frame, and no others.",
                    )
                rates.add(video.rate)
                streams[camera] = iter_frames(path, 0, length, video.rate, first_s=video.first_s)
                exact = exact and video.exact
        if rates and not same_rate(min(rates), max(rates)):
            raise SourceError(
                "its videos state different frame rates: "
                + ", ".join(f"{rate:g}" for rate in sorted(rates)),
                "Write all videos of an episode at one rate, or give that in a column fps.",
            )
        rows = RowSpan(self._folder / TABLE, key.rows.start, key.rows.start + key.rows.length)
        actions = rows.vectors("action") if "action" in rows.names else None
        return Recording(
            goals=(key.rows.goal,),
            seed=key.rows.seed,
            difficulty=key.rows.difficulty,
            simulator=key.rows.simulator,
            exact=exact if key.rows.exact is None else key.rows.exact,
            frames=compose(streams, rows.vectors("state"), actions, key.rows.lesson),
            robot=Robot(key.rows.fps or min(rates, default=None), names=key.rows.names),
        )

    def _image_paths(self) -> Iterator[tuple[Path, str, str]]:
        """Yield each video file and folder of images, its camera, and the episode's id."""
        for kind in ("videos", "images"):
            for path in sorted((self._folder / kind).glob("*/*/*/*")):
                if is_hidden(path.relative_to(self._folder).as_posix()):
                    continue
                video = kind == "videos"
                fits = path.suffix.lower() in _VIDEO_SUFFIXES if video else path.is_dir()
                if not fits:
                    expected = f"video ({', '.join(_VIDEO_SUFFIXES)})" if video else "image folder"
                    raise SourceError(f"{path} is not an episode's {expected}", LAYOUT)
                camera, family, split = path.relative_to(self._folder / kind).parts[:3]
                yield path, camera, f"{family}/{split}/{path.stem if video else path.name}"

    def _state(self, images: dict[str, Path]) -> tuple[Any, ...]:
        return tuple(file_state(path) for path in (self._folder / TABLE, *images.values()))


def _check_names(path: Path, length: int) -> None:
    """Check that a folder holds an image for each row, and nothing else."""
    expected = {_image_name(number) for number in range(length)}
    names = {file.name for file in path.iterdir() if not file.name.startswith(".")}
    if wrong := sorted(expected ^ names):
        what = f"lacks {wrong[0]}" if wrong[0] in expected else f"holds {wrong[0]}"
        raise SourceError(
            f"{path} {what}; {TABLE} has {length} rows, so it must hold {_image_name(0)} to "
            f"{_image_name(length - 1)} and nothing else",
            LAYOUT,
        )


def _image_name(number: int) -> str:
    return f"{number:06d}.png"
