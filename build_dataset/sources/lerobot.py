"""Source `lerobot`: a LeRobot dataset, v3.0 or v2.1, in a folder or on the Hub.

Read with pyarrow and PyAV alone. `docs/sources.md` describes the column map and the families file.
"""

from collections.abc import Generator, Iterator
from contextlib import ExitStack, closing, contextmanager
from functools import cached_property
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
from robomme_interference_data.build_dataset.sources.columns import ColumnMap, resolve_columns
from robomme_interference_data.build_dataset.sources.exactness import info_is_exact
from robomme_interference_data.build_dataset.sources.families import (
    BLOCK_EPISODES,
    BLOCK_FAMILIES,
    ids_by_block,
    ids_by_columns,
    ids_by_file,
)
from robomme_interference_data.build_dataset.sources.goals import families_for_goal, goal_fits
from robomme_interference_data.build_dataset.sources.images import decode_image, is_png
from robomme_interference_data.constants import IDENTITY_PATH, SPLITS
from robomme_interference_data.errors import (
    FormatError,
    InvalidOptionError,
    MissingFileError,
    SourceError,
    TruncatedVideoError,
)
from robomme_interference_data.files import read_json
from robomme_interference_data.hub import HubFiles, locate
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.lerobot_files import LeRobotFiles
from robomme_interference_data.parquet import RowSpan

__all__ = ["LeRobotSource"]

_ROBOMME_REPOS = ("lerobot/robomme", "Yinpei/robomme_data_lerobot")
_MEND = "Correct the dataset, or leave the episode out."
_MEND_FAMILIES = (
    "Name the family of every episode in a file: --families-file families.csv, with the line "
    "episode_index,family first."
)


class LeRobotSource:
    """Episodes of a LeRobot dataset.

    Args:
        location: A folder, or a dataset repository on the Hub, as `hub.locate` reads it.
        split: Split of episodes that do not say it themselves.
        columns: Logical name (`front`, `wrist`, `state`, `action`, `is_demo`, `exec_start_idx`)
            to the dataset's column, where that is not named as usual.
        families_file: File that names the family of every episode, see `docs/sources.md`.

    Raises:
        InvalidOptionError: The location is neither, or the split is unknown.
        MissingFileError, HubError, FormatError: Its `meta/info.json` cannot be had or read.
    """

    time_limit = 1800.0
    whole = True

    def __init__(
        self,
        location: str,
        *,
        split: str = "train",
        columns: dict[str, str] | None = None,
        families_file: Path | None = None,
    ):
        if split not in SPLITS:
            raise InvalidOptionError.one_of("split", split, SPLITS)
        self._files = locate(location)
        self._split = split
        self._given_columns = columns
        self._families_file = families_file
        self.provenance: dict[str, Any] = {"kind": "lerobot"}
        if isinstance(self._files, HubFiles):
            self.provenance |= {"repo": self._files.repo_id, "revision": self._files.commit}

    def __getstate__(self) -> dict[str, Any]:
        lazy = ("_lerobot", "_columns", "_identity")
        return {name: value for name, value in self.__dict__.items() if name not in lazy}

    def episodes(self) -> list[SourceEpisode]:
        """List all episodes; see `Source.episodes`. Only `meta/` is read.

        Raises:
            MissingFileError, HubError: A file in `meta/` is missing, or cannot be fetched.
            FormatError: A file in `meta/` cannot be read.
            UnknownNameError, InvalidOptionError: The column map does not fit.
            SourceError: The dataset cannot be used; says which episode, why and what to do.
        """
        rows, known = self._lerobot.all_rows(), self._lerobot.tasks
        ids = self._ids(rows)
        for index, name in ids.items():
            row = rows[index]
            goals = self._goals(row)
            for task in row.get("tasks") or ():
                if task not in known:
                    raise FormatError.damaged(
                        self._where, f"episode {index}: unknown task {task!r}"
                    )
            if self._simulator(row) in (None, "robomme"):
                self._check_goals(index, name, goals)
        found = [SourceEpisode(one, (i, self._state(i))) for i, one in ids.items()]
        return sorted(found, key=lambda episode: episode.id)

    def read(self, episode: SourceEpisode, cameras: tuple[str, ...] | None) -> Recording:
        """Open an episode; see `Source.read`."""
        index = episode.key[0]
        columns, row = self._columns, self._lerobot.row(index)
        chosen = choose_cameras(cameras, tuple(columns.cameras), episode.id)
        with _naming(episode.id):
            rows = self._lerobot.rows(index)
            start = _demonstration_length(rows, columns, row.get("exec_start_idx"))
            states = self._lerobot.vectors(index, columns.state)
            actions = self._lerobot.vectors(index, columns.action) if columns.action else None
            exact = row.get("exact")
            if exact is None:
                exact = all(self._is_exact(rows, columns.cameras[camera]) for camera in chosen)
        frames = self._frames(episode, rows, states, actions, start, chosen, bool(exact))
        difficulty, seed = row.get("difficulty"), row.get("seed")
        goals = self._goals(row)
        return Recording(goals, seed, difficulty, self._simulator(row), bool(exact), frames)

    def close(self) -> None:
        """Nothing is held."""

    @cached_property
    def _lerobot(self) -> LeRobotFiles:
        return LeRobotFiles(self._files)

    @cached_property
    def _columns(self) -> ColumnMap:
        return resolve_columns(self._lerobot.features, self._given_columns, self._where)

    @cached_property
    def _identity(self) -> dict[str, Any]:
        try:
            return read_json(self._files.path(IDENTITY_PATH))
        except MissingFileError:
            return {}

    @property
    def _where(self) -> str:
        return self._files.describe()

    def _frames(
        self,
        episode: SourceEpisode,
        rows: RowSpan,
        states: NDArray[np.float32],
        actions: NDArray[np.float32] | None,
        start: int | None,
        cameras: tuple[str, ...],
        exact: bool,
    ) -> Generator[Frame]:
        with _naming(episode.id), ExitStack() as stack:
            images = {
                camera: stack.enter_context(
                    closing(
                        self._images(episode.key[0], rows, self._columns.cameras[camera], exact)
                    )
                )
                for camera in cameras
            }
            for number, state in enumerate(states):
                yield Frame(
                    images={camera: next(stream) for camera, stream in images.items()},
                    state=state,
                    action=None if actions is None else actions[number],
                    is_demonstration=None if start is None else number < start,
                )

    def _images(
        self, index: int, rows: RowSpan, column: str, exact: bool
    ) -> Generator[NDArray[np.uint8]]:
        """Decode the images of an episode in order, `(H, W, 3) uint8` RGB, one in memory."""
        if self._lerobot.features[column]["dtype"] == "video":
            yield from self._lerobot.iter_frames(index, column, 0, len(rows))
            return
        shape = self._lerobot.shape(column)
        for number, data in enumerate(rows.images(column)):
            if exact and not is_png(data):
                raise SourceError(
                    f"frame {number} of column {column!r} is a JPEG, the first one a PNG",
                    "Convert the dataset to PNG throughout, or leave the episode out.",
                )
            image = decode_image(data)
            if image.shape != shape:
                raise SourceError(
                    f"frame {number} of column {column!r} has the shape {image.shape}; info.json "
                    f"says {shape}",
                    _MEND,
                )
            yield image

    def _is_exact(self, rows: RowSpan, column: str) -> bool:
        """Tell whether images are exact, by their codec or by the first one stored in parquet."""
        feature = self._lerobot.features[column]
        if feature["dtype"] == "video":
            return info_is_exact(
                {**(feature.get("video_info") or {}), **(feature.get("info") or {})}
            )
        return is_png(next(rows.images(column)))

    def _ids(self, rows: list[dict[str, Any]]) -> dict[int, EpisodeId]:
        indices = list(range(len(rows)))
        if self._families_file is not None:
            return ids_by_file(self._families_file, indices, self._split)
        named = ids_by_columns(dict(enumerate(rows)), self._split, self._where)
        if named is not None:
            return named
        if self._by_block:
            return ids_by_block(indices, self._split)
        raise SourceError(
            f"{self._where} does not say of what family its {len(indices)} episodes are: it has no "
            "per-episode column episode_id or family, and is not one of RoboMME's with "
            f"{len(BLOCK_FAMILIES) * BLOCK_EPISODES}",
            _MEND_FAMILIES,
        )

    @property
    def _by_block(self) -> bool:
        """Whether it is laid out as RoboMME's datasets, which have no family column."""
        own = {"episode_id", "family"} & set(self._lerobot.table.column_names)
        total = len(BLOCK_FAMILIES) * BLOCK_EPISODES
        return not own and self._families_file is None and len(self._lerobot) == total

    def _simulator(self, row: dict[str, Any]) -> str | None:
        known = isinstance(self._files, HubFiles) and self._files.repo_id in _ROBOMME_REPOS
        if self._by_block or known:
            return "robomme"
        said = row.get("simulator") or self._identity.get("simulator")
        return said or self._lerobot.info.get("simulator")

    def _goals(self, row: dict[str, Any]) -> tuple[str, ...]:
        goals = tuple(row.get("goals") or row.get("tasks") or ())
        if not goals or not all(isinstance(goal, str) and goal for goal in goals):
            raise FormatError.damaged(self._where, "an episode without a task text")
        return goals

    def _check_goals(self, index: int, name: EpisodeId, goals: tuple[str, ...]) -> None:
        for goal in goals:
            if not goal_fits(name.family, goal):
                others = " and ".join(families_for_goal(goal)) or "no family of RoboMME"
                raise SourceError(
                    f"{self._where}: episode {index} would be {name}, but its goal {goal!r} "
                    f"cannot be one of {name.family}; it fits {others}",
                    _MEND_FAMILIES,
                )

    def _state(self, index: int) -> tuple[Any, ...]:
        """Return what changes when the episode's files do: the commit, or times and sizes."""
        if isinstance(self._files, HubFiles):
            return (self._files.commit,)
        place = self._lerobot.place(index)
        states: list[Any] = []
        for relative in (place.data, *(path for path, _ in place.videos.values())):
            path = self._files.root / relative
            # A part of a dataset may be here only; what is missing is missed when it is read.
            status = path.stat() if path.is_file() else None
            states.append(status and (status.st_mtime_ns, status.st_size))
        return tuple(states)


@contextmanager
def _naming(what: object) -> Iterator[None]:
    """Put an episode's name in front of what goes wrong with its files.

    Raises:
        SourceError: A file is missing or damaged, or does not fit the metadata.
    """
    try:
        yield
    except (MissingFileError, FormatError, TruncatedVideoError, SourceError) as error:
        raise SourceError(f"{what}: {error.message}", error.hint) from error


def _demonstration_length(rows: RowSpan, columns: ColumnMap, said: int | None) -> int | None:
    """Return the number of demonstration frames of an episode; None if nothing marks them.

    Args:
        rows: Its rows.
        columns: Which columns may mark it.
        said: What the per-episode metadata says, or None.

    Raises:
        SourceError: A column is not as it should be, or two do not agree.
    """
    found = {} if said is None else {"meta/": said}
    if columns.is_demo is not None:
        flags = rows.scalars(columns.is_demo) != 0
        found[columns.is_demo] = count = int(flags.sum())
        if flags[count:].any():
            raise SourceError(
                f"column {columns.is_demo!r} is true in {count} frames, not all of them at the "
                "beginning; a demonstration comes first and in one piece",
                _MEND,
            )
    if columns.exec_start_idx is not None:
        values = np.unique(rows.scalars(columns.exec_start_idx))
        if len(values) != 1 or not 0 <= values[0] <= len(rows):
            raise SourceError(
                f"column {columns.exec_start_idx!r} holds {', '.join(map(str, values[:5]))}; "
                f"expected one number from 0 to {len(rows)} in all frames",
                _MEND,
            )
        found[columns.exec_start_idx] = int(values[0])
    if len(set(found.values())) > 1:
        told = " and ".join(f"{start} by {name}" for name, start in found.items())
        raise SourceError(f"the number of demonstration frames is not clear: {told}", _MEND)
    return next(iter(found.values()), None)
