"""Source `lerobot`: a LeRobot dataset, v3.0 or v2.1, in a folder or on the Hub.

Read with pyarrow and PyAV alone. `docs/sources.md` describes the column map and the families file.
"""

from collections.abc import Generator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from robomme_interference_data.build_dataset.sources.base import Frame, SourceEpisode
from robomme_interference_data.build_dataset.sources.columns import (
    ColumnMap,
    image_size,
    resolve_columns,
)
from robomme_interference_data.build_dataset.sources.demonstrations import (
    check_start,
    marked_start,
    read_marks,
)
from robomme_interference_data.build_dataset.sources.exactness import info_is_exact
from robomme_interference_data.build_dataset.sources.families import (
    BLOCK_EPISODES,
    BLOCK_FAMILIES,
    ids_by_block,
    ids_by_columns,
    ids_by_file,
)
from robomme_interference_data.build_dataset.sources.goals import families_for_goal, goal_fits
from robomme_interference_data.build_dataset.sources.images import check_size, is_png
from robomme_interference_data.build_dataset.sources.lerobot_layout import (
    EpisodePlace,
    Layout,
    read_layout,
)
from robomme_interference_data.build_dataset.sources.lerobot_read import (
    episode_rows,
    iter_images,
    naming,
)
from robomme_interference_data.build_dataset.sources.tables import RowSpan
from robomme_interference_data.constants import SPLITS
from robomme_interference_data.errors import InvalidOptionError, SourceError, nearest
from robomme_interference_data.files import LocalFiles
from robomme_interference_data.hub import HubFiles, is_repo_id
from robomme_interference_data.ids import EpisodeId

__all__ = ["LeRobotSource"]

_ROBOMME_REPOS = ("lerobot/robomme", "Yinpei/robomme_data_lerobot")
_MEND_FAMILIES = (
    "Name the family of every episode in a file: --families-file families.csv, with the line "
    "episode_index,family first."
)


@dataclass(frozen=True)
class _Key:
    """Where an episode lies, and the state of its files."""

    place: EpisodePlace
    files: tuple[Any, ...]


class LeRobotSource:
    """Episodes of a LeRobot dataset.

    Args:
        location: A folder, or a dataset repository on the Hub, `namespace/name`.
        split: Split of episodes that do not say it themselves.
        columns: Logical name (`front`, `wrist`, `state`, `action`, `is_demo`, `exec_start_idx`)
            to the dataset's column, where that is not named as usual.
        families_file: File that names the family of every episode, see `docs/sources.md`.
        revision: Branch, tag or commit on the Hub; None for the main branch.

    Raises:
        InvalidOptionError: The location is neither, the split is unknown, or a revision is given
            for a folder.
    """

    kind = "lerobot"

    def __init__(
        self,
        location: str,
        *,
        split: str = "train",
        columns: dict[str, str] | None = None,
        families_file: Path | None = None,
        revision: str | None = None,
    ):
        folder = Path(location).expanduser()
        self._files: LocalFiles | HubFiles
        if folder.is_dir():
            if revision is not None:
                raise InvalidOptionError(
                    f"revision {revision!r} is given for the folder {location}; only a repository "
                    "on the Hub has revisions"
                )
            self._files = LocalFiles(folder)
        elif is_repo_id(location):
            self._files = HubFiles(location, revision)
        else:
            raise InvalidOptionError(
                f"{location!r} is neither a folder nor a dataset repository on the Hub",
                "Give an existing folder, or namespace/name.",
            )
        if split not in SPLITS:
            raise InvalidOptionError(
                f"{split!r} is not a split; expected one of {', '.join(SPLITS)}",
                nearest(split, SPLITS),
            )
        self._split = split
        self._given_columns = columns
        self._families_file = families_file

    @cached_property
    def provenance(self) -> dict[str, Any]:
        """Kind and, for the Hub, repository and commit; see `Source`."""
        if isinstance(self._files, HubFiles):
            hub = {"repo": self._files.repo_id, "revision": self._files.commit}
            return {"kind": self.kind, **hub}
        return {"kind": self.kind}

    def episodes(self) -> list[SourceEpisode]:
        """List all episodes; see `Source.episodes`.

        Only `meta/` is read, but for one row with images stored in parquet (are they PNG?), and
        the demonstration column where the statistics in `meta/` do not tell its content.

        Raises:
            MissingFileError, HubError: A file in `meta/` is missing, or a file cannot be fetched.
            FormatError: A file in `meta/` cannot be read.
            UnknownNameError, InvalidOptionError: The column map does not fit.
            SourceError: The dataset cannot be used; says which episode, why and what to do.
        """
        layout, columns, place = self._layout, self._columns, self._files.describe()
        ids, by_block = self._ids()
        exact = self._exact()
        starts = self._demonstration_lengths()
        cameras = {
            camera: image_size(column, layout.features[column], place)
            for camera, column in columns.cameras.items()
        }
        found = []
        for index, where in layout.places.items():
            row = layout.rows[index]
            simulator, said = self._simulator(row, by_block), row.get("exact")
            goals = tuple(row.get("goals") or row["tasks"])
            if simulator in (None, "robomme"):
                self._check_goals(index, ids[index], goals)
            found.append(
                SourceEpisode(
                    id=ids[index],
                    goals=goals,
                    raw_length=where.length,
                    demonstration_length=starts.get(index),
                    seed=row.get("seed"),
                    difficulty=row.get("difficulty"),
                    simulator=simulator,
                    exact=exact if said is None else bool(said),
                    cameras=cameras,
                    key=_Key(where, self._file_states(where)),
                    state_size=layout.features[columns.state]["shape"][0],
                    action_size=layout.features[columns.action]["shape"][0],
                )
            )
        return sorted(found, key=lambda episode: episode.id)

    def read(self, episode: SourceEpisode) -> Generator[Frame, None, None]:
        """Stream the frames of an episode; see `Source.read`.

        Raises:
            SourceError: A file is missing, or the recording breaks off or does not fit what
                `episodes` said of it.
            HubError: A file cannot be fetched.
        """
        where: EpisodePlace = episode.key.place
        columns = self._columns
        with naming(episode.id), ExitStack() as stack:
            rows = episode_rows(self._files, where)
            states, actions = rows.vectors(columns.state), rows.vectors(columns.action)
            start = episode.demonstration_length
            check_start(read_marks(rows, columns), start)
            for name, values, size in (
                (columns.state, states, episode.state_size),
                (columns.action, actions, episode.action_size),
            ):
                if values.shape[1] != size:
                    raise SourceError(
                        f"column {name!r} holds vectors of {values.shape[1]} values; info.json "
                        f"says {size}"
                    )
            fps, images = self._layout.fps, {}
            for camera in episode.cameras:
                column = columns.cameras[camera]
                stream = iter_images(self._files, where, column, rows, fps, episode.exact)
                images[camera] = stack.enter_context(closing(stream))
            for number in range(where.length):
                found = {camera: next(stream) for camera, stream in images.items()}
                for camera, image in found.items():
                    check_size(image, episode.cameras[camera], camera, number, "info.json")
                yield Frame(
                    images=found,
                    state=states[number],
                    action=actions[number],
                    is_demonstration=None if start is None else number < start,
                )

    @cached_property
    def _layout(self) -> Layout:
        wanted = (self._given_columns or {}).get("exec_start_idx", "exec_start_idx")
        return read_layout(self._files, wanted)

    @cached_property
    def _columns(self) -> ColumnMap:
        return resolve_columns(self._layout.features, self._given_columns, self._files.describe())

    def _ids(self) -> tuple[dict[int, EpisodeId], bool]:
        """Return the id of every episode, and whether it comes from the block of 100."""
        layout, place = self._layout, self._files.describe()
        indices = list(layout.places)
        if self._families_file is not None:
            return ids_by_file(self._families_file, indices, self._split), False
        named = ids_by_columns(layout.rows, self._split, place)
        if named is not None:
            return named, False
        total = len(BLOCK_FAMILIES) * BLOCK_EPISODES
        if indices == list(range(total)):
            return ids_by_block(indices, self._split), True
        raise SourceError(
            f"{place} does not say of what family its {len(indices)} episodes are: it has no "
            f"per-episode column episode_id or family, and is not one of RoboMME's with {total}",
            _MEND_FAMILIES,
        )

    def _simulator(self, row: dict[str, Any], by_block: bool) -> str | None:
        known = isinstance(self._files, HubFiles) and self._files.repo_id in _ROBOMME_REPOS
        if by_block or known:
            return "robomme"
        layout = self._layout
        found = row.get("simulator") or layout.identity.get("simulator")
        return found or layout.info.get("simulator")

    def _check_goals(self, index: int, name: EpisodeId, goals: tuple[str, ...]) -> None:
        for goal in goals:
            if not goal_fits(name.family, goal):
                others = families_for_goal(goal)
                raise SourceError(
                    f"{self._files.describe()}: episode {index} would be {name}, but its goal "
                    f"{goal!r} cannot be one of {name.family}; it fits "
                    f"{' and '.join(others) or 'no family of RoboMME'}",
                    _MEND_FAMILIES,
                )

    def _exact(self) -> bool:
        """Tell whether all images are exact, by codec and by the first one stored in parquet."""
        layout = self._layout
        first = next(iter(layout.places.values()), None)
        for column in self._columns.cameras.values():
            feature = layout.features[column]
            if feature["dtype"] == "video":
                info = {**(feature.get("video_info") or {}), **(feature.get("info") or {})}
                if not info_is_exact(info):
                    return False
            elif first is not None:
                with naming(f"episode {first.index}"):
                    if not is_png(next(episode_rows(self._files, first).images(column))):
                        return False
        return True

    def _demonstration_lengths(self) -> dict[int, int]:
        """Return episode index to demonstration length, of episodes that have a marked one."""
        layout, columns = self._layout, self._columns
        if all("exec_start_idx" in row for row in layout.rows.values()):
            found = {index: row["exec_start_idx"] for index, row in layout.rows.items()}
            return {index: start for index, start in found.items() if start is not None}
        if columns.is_demo is None and columns.exec_start_idx is None:
            return {}
        starts = dict(layout.starts) if columns.exec_start_idx is not None else {}
        unknown: dict[str, list[int]] = {}
        for index, where in layout.places.items():
            if index not in starts:
                unknown.setdefault(where.data, []).append(index)
        for data, indices in unknown.items():
            with naming(self._files.describe()):
                rows = RowSpan(self._files.path(data))
                marks, numbers = read_marks(rows, columns), rows.scalars("episode_index")
            for index in indices:
                with naming(f"episode {index}"):
                    starts[index] = marked_start(marks.of(numbers == index))
        return starts

    def _file_states(self, where: EpisodePlace) -> tuple[Any, ...]:
        """Return what changes when the episode's files do: the commit, or times and sizes."""
        if isinstance(self._files, HubFiles):
            return (self._files.commit,)
        states: list[Any] = []
        cameras = self._columns.cameras.values()
        for relative in (where.data, *(where.videos[c][0] for c in cameras if c in where.videos)):
            path = self._files.root / relative
            # A part of a dataset may be here only; what is missing is missed when it is read.
            status = path.stat() if path.is_file() else None
            states.append(status and (status.st_mtime_ns, status.st_size))
        return tuple(states)
