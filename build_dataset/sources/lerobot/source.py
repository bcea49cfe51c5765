"""Source `lerobot`: a LeRobot dataset, v3.0, v2.1 or v2.0, in a folder or on the Hub.

Read with pyarrow and PyAV alone; `docs/reference/sources.md` describes columns and families.
"""

from collections.abc import Generator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, override

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import OFFICIAL, VALUE_NAMES
from robomme_interference_data.errors import (
    FormatError,
    InterferenceError,
    MissingFileError,
    SourceError,
    counted,
    named,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.evidence import spans_of_texts
from robomme_interference_data.simulators.episode import choose_cameras
from robomme_interference_data.storage.hub import HubFiles, locate
from robomme_interference_data.storage.lerobot.dataset import LeRobotFiles
from robomme_interference_data.storage.lerobot.info import picture_info
from robomme_interference_data.storage.parquet import RowSpan
from robomme_interference_data.storage.video.encode import is_png

from ..base import (
    Recording,
    Robot,
    Source,
    SourceEpisode,
    compose,
    demonstration_length,
    file_state,
)
from ..episode_columns import NAMING, EpisodeColumns, read_column, read_episode_columns
from ..images import decode_images, info_is_exact
from ..robomme_families import BLOCKS, ROBOMME, families_for_goal
from .columns import RecordedColumns, find_columns, recorded_robot
from .families import ids_by_block, ids_by_columns
from .families_file import TASK, template
from .goals import check_choice, goal_wordings, one_form
from .naming import EpisodeNaming, origin_of_families
from .subgoals import subgoal_texts
from .trim import Trim

_ROBOMME_REPOS = ("lerobot/robomme", "Yinpei/robomme_data_lerobot")
_CORRECT = "Correct the dataset, or leave the episode out."


class LeRobotSource(Source):
    """Episodes of a LeRobot dataset, in a folder or on the Hub; see `hub.locate`.

    `columns` maps logical names (a camera, `state`, `action`, `is_demo`, `exec_start_idx`,
    `subgoal`) to columns without a usual name: see `find_columns`. `families_from` is `task`,
    `dataset`, or the path of a families file. `several_tasks` is what the goal of an episode with
    several tasks is, see `goals.SEVERAL_TASKS`.
    """

    def __init__(
        self,
        location: str,
        columns: dict[str, str] | None = None,
        families_from: str | None = None,
        several_tasks: str | None = None,
    ):
        check_choice(several_tasks)
        self._files = locate(location)
        self._given_columns = columns or {}
        self._families_from = families_from
        self._several_tasks = several_tasks
        self.provenance = {"kind": "lerobot"}
        if columns:
            self.provenance["columns"] = dict(columns)
        if families_from is not None:
            self.provenance["families_from"] = origin_of_families(families_from)
        if isinstance(self._files, HubFiles):
            self.provenance |= {"repo": self._files.repo_id, "revision": self._files.commit}
            if self._files.folder:
                self.provenance["folder"] = self._files.folder.removesuffix("/")

    def __getstate__(self) -> dict[str, Any]:
        lazy = ("_lerobot", "_columns", "_tasks", "naming")
        return {name: value for name, value in self.__dict__.items() if name not in lazy}

    @override
    def episodes(self) -> list[SourceEpisode]:
        rows = self._lerobot.table.to_pylist()
        ids, simulator = self._ids(rows)
        listed = []
        for index, name in ids.items():
            try:
                listed.append(self._listed(index, name, rows[index], simulator))
            except InterferenceError as error:
                listed.append(SourceEpisode(name, problem=error))
        return sorted(listed, key=lambda episode: episode.id)

    def _listed(
        self, index: int, name: EpisodeId, row: dict[str, Any], simulator: str | None
    ) -> SourceEpisode:
        metadata = self._metadata(index, row)
        goals = self._goals(index, self._tasks[index], metadata)
        played = simulator or metadata.simulator
        if played in (None, OFFICIAL):
            self._check_goals(index, name, goals)
        self._trim(index)  # checks it
        marks = self._columns.is_demo, self._columns.exec_start_idx, metadata.exec_start_idx
        known = any(mark is not None for mark in marks)
        return SourceEpisode(name, (index, played, self._state(index)), marked=known)

    @override
    def read(self, episode: SourceEpisode, cameras: tuple[str, ...] | None) -> Recording:
        episode.check()
        index, simulator, _ = episode.key
        columns, metadata = self._columns, self._metadata(index, self._lerobot.row(index))
        chosen = choose_cameras(cameras, tuple(columns.cameras))
        whole, trim = self._lerobot.rows(index), self._trim(index)
        lesson = trim.lesson(_lesson(whole, columns, metadata.exec_start_idx))
        rows = whole.part(whole.start + trim.start, whole.start + trim.stop)
        states = self._vectors(index, columns.state, trim)
        actions = self._vectors(index, columns.action, trim) if columns.action else None
        exact = metadata.exact
        if exact is None:
            exact = all(self._is_exact(rows, columns.cameras[camera]) for camera in chosen)
        evidence = None if metadata.evidence is None else trim.evidence(metadata.evidence)
        if evidence is None and lesson is not None and columns.subgoal is not None:
            texts = subgoal_texts(self._lerobot, whole, columns.subgoal)
            evidence = spans_of_texts(texts[trim.start : trim.start + lesson])
        videos = self._lerobot.video_features
        for column in (columns.cameras[camera] for camera in chosen):
            if column in videos:
                self._lerobot.check_video(index, column)
        streams = {
            camera: self._images(index, rows, columns.cameras[camera], trim, exact)
            for camera in chosen
        }
        return Recording(
            goals=self._goals(index, self._tasks_of_frames(index), metadata),
            seed=metadata.seed,
            difficulty=metadata.difficulty,
            simulator=simulator,
            exact=exact,
            frames=compose(streams, states, actions, lesson),
            evidence=evidence,
            robot=self._robot(official=simulator == OFFICIAL),
        )

    @cached_property
    def _lerobot(self) -> LeRobotFiles:
        return LeRobotFiles(self._files)

    @cached_property
    def _columns(self) -> RecordedColumns:
        return find_columns(self._lerobot.features, self._given_columns, self._where)

    @cached_property
    def naming(self) -> EpisodeNaming:
        """How the episodes get their names."""
        return EpisodeNaming(
            tasks=self._tasks,
            splits=self._lerobot.info.get("splits"),
            dataset=self._name,
            families_from=self._families_from,
            dataset_where=self._where,
        )

    @property
    def _name(self) -> str:
        """The name of the dataset: of its folder, or of its repository and the folder there."""
        if isinstance(self._files, HubFiles):
            return f"{self._files.repo_id.split('/')[-1]} {self._files.folder}".strip(" /")
        return Path(self._files.location).resolve().name

    @cached_property
    def _tasks(self) -> list[tuple[str, ...]]:
        """The tasks of each episode: those that its row lists, or else those of its frames."""
        table, texts = self._lerobot.table, self._lerobot.task_texts
        given = table["tasks"].to_pylist() if "tasks" in table.column_names else [None] * len(table)
        known = {one_form(text): text for text in texts.values()}
        tasks = []
        for index, value in enumerate(given):
            where = f"{self._where}: episode {index}"
            listed = read_column("tasks", value, where) or ()
            found = [known.get(one_form(text)) for text in listed]
            if None in found:
                raise SourceError(
                    f"{where} has the task {listed[found.index(None)]!r}, which the dataset's list "
                    f"of {counted(len(texts), 'task')} does not have",
                    "LeRobot's modify_tasks changes both.",
                )
            if not found:
                with suppress(MissingFileError):  # an error when it is read
                    found = [*self._lerobot.tasks_of(index)]
            tasks.append(tuple(text for text in found if text is not None))
        return tasks

    def _tasks_of_frames(self, index: int) -> tuple[str, ...]:
        """Return the tasks of an episode in the order of its frames, then further listed ones."""
        listed, stored = self._tasks[index], self._lerobot.tasks_of(index)
        if listed and not {*stored} <= {*listed}:
            raise SourceError(
                f"its frames have the task {' and '.join(map(repr, stored))}; meta/ lists "
                f"{' and '.join(map(repr, listed))}",
                "Correct one of them: LeRobot's modify_tasks changes both.",
            )
        return (*stored, *(text for text in listed if text not in stored))

    def _goals(self, index: int, tasks: Sequence[str], metadata: EpisodeColumns) -> tuple[str, ...]:
        """Return the wordings of an episode's goal."""
        try:
            return goal_wordings(tasks, metadata.goals or (), self._several_tasks)
        except SourceError as error:
            raise error.about(f"{self._where}: episode {index}") from None

    @property
    def _where(self) -> str:
        return self._files.describe()

    def _metadata(self, index: int, row: dict[str, Any]) -> EpisodeColumns:
        row = row | self.naming.row(index)
        return read_episode_columns(row, f"{self._where}: episode {index}")

    def _trim(self, index: int) -> Trim:
        try:
            return Trim.of(self.naming.row(index), self._lerobot.row(index)["length"])
        except SourceError as error:
            raise error.about(f"{self.naming.where}: episode {index}") from None

    def _vectors(self, index: int, columns: Sequence[str], trim: Trim) -> NDArray[np.float32]:
        """Return the joined values of columns, `(T, D) float32`; D is 0 without columns."""
        empty = np.empty((trim.stop - trim.start, 0), np.float32)
        read = (self._lerobot.vectors(index, name)[trim.start : trim.stop] for name in columns)
        return np.concatenate([empty, *read], axis=1)

    def _robot(self, *, official: bool) -> Robot:
        """Return the robot; RoboMME's values have known names, also where its datasets have none.

        `official` is whether it is RoboMME's.
        """
        vectors = self._columns.vectors
        robot = recorded_robot(self._lerobot, vectors)
        if not official:
            return robot
        sizes = {
            feature: sum(self._lerobot.shape(column)[0] for column in columns)
            for feature, columns in vectors.items()
        }
        known = {f: VALUE_NAMES for f, size in sizes.items() if size == len(VALUE_NAMES)}
        return replace(robot, names=known | robot.names)

    def _images(
        self, index: int, rows: RowSpan, column: str, trim: Trim, exact: bool
    ) -> Generator[NDArray[np.uint8]]:
        if self._lerobot.features[column]["dtype"] == "video":
            yield from self._lerobot.iter_frames(index, column, trim.start, trim.stop)
            return
        cells = enumerate(rows.images(column), trim.start)
        where = f"{rows.path}: column {column!r}, frame"
        yield from decode_images(((f"{where} {n}", data) for n, data in cells), exact)

    def _is_exact(self, rows: RowSpan, column: str) -> bool:
        """Return whether images are exact, by their codec or by the first one in parquet."""
        feature = self._lerobot.features[column]
        if feature["dtype"] != "video":
            first = next(rows.images(column))
            try:
                return is_png(first)
            except FormatError as error:
                raise error.about(f"{rows.path}: column {column!r}") from None
        return info_is_exact(picture_info(feature))

    def _ids(self, rows: list[dict[str, Any]]) -> tuple[dict[int, EpisodeId], str | None]:
        """Return the episodes' ids, and the simulator where it follows from the dataset."""
        hub = isinstance(self._files, HubFiles) and self._files.repo_id in _ROBOMME_REPOS
        simulator = OFFICIAL if hub else None
        naming = self.naming.rows or [
            self._naming_columns(index, row) for index, row in enumerate(rows)
        ]
        ids = ids_by_columns(naming, self.naming.where)
        if ids is not None:
            return ids, simulator
        blocks = ids_by_block()
        if len(rows) == len(blocks):
            return blocks, OFFICIAL
        raise SourceError(
            f"the families of the {len(rows)} episodes of {self._where} are unknown: it has no "
            "per-episode column episode_id or family, and is not RoboMME's with "
            f"{len(blocks):,} episodes of {len(BLOCKS)} families",
            f"Make them from the tasks, with {named('families_from', TASK)}; or write a CSV file "
            f"and give it with {named('families_from')}. Its lines, with the names of families:\n"
            f"{template(self._tasks)}",
        )

    def _naming_columns(self, index: int, row: dict[str, Any]) -> dict[str, Any]:
        """Return those per-episode columns of an episode that name it."""
        where = f"{self._where}: episode {index}"
        columns = {name: read_column(name, row[name], where) for name in NAMING if name in row}
        if "family" in columns and "episode_id" not in columns:
            columns["split"] = columns.get("split") or self.naming.recorded_splits[index]
        return columns

    def _check_goals(self, index: int, name: EpisodeId, goals: tuple[str, ...]) -> None:
        for goal in goals:
            fits = families_for_goal(goal)
            if name.family in ROBOMME and name.family not in fits:
                others = " and ".join(fits) or "no family of RoboMME"
                raise SourceError(
                    f"{self._where}: episode {index} would be {name}, but its goal {goal!r} "
                    f"cannot be one of {name.family}; it fits {others}",
                    f"Name the families in a CSV file, {named('families_from')}: see "
                    "docs/reference/sources.md.",
                )

    def _state(self, index: int) -> tuple[Any, ...]:
        """Return what changes when an episode's files do, or what the families file says of it.

        On the Hub, the commit is pinned.
        """
        used = [self.naming.row(index).get(name) for name in ("start", "stop", "exec_start_idx")]
        if isinstance(self._files, HubFiles):
            return tuple(used)
        paths = [self._lerobot.locate(index).data]
        cameras = self._columns.cameras.values()
        for name in self._lerobot.video_features:
            # Part of a dataset suffices: what cannot be read is an error only when it is read.
            if name in cameras:
                with suppress(FormatError):
                    paths.append(self._lerobot.locate_video(index, name).path)
        states = (file_state(self._files.root / path) for path in paths)
        return (*states, *used)


def _lesson(rows: RowSpan, columns: RecordedColumns, recorded: int | None) -> int | None:
    """Return the number of demonstration frames, on which all columns must agree, if known."""
    lengths = {} if recorded is None else {"per-episode exec_start_idx": recorded}
    if columns.is_demo is not None:
        name = columns.is_demo
        flags = rows.values(name).to_pylist()
        lengths[name] = demonstration_length(flags, f"column {name!r}")
    if columns.exec_start_idx is not None:
        name = columns.exec_start_idx
        values = np.unique(rows.scalars(name)).tolist()
        if len(values) != 1 or not 0 <= values[0] <= len(rows):
            raise SourceError(
                f"column {name!r} holds {', '.join(map(str, values[:5]))}; expected one number "
                f"from 0 to {len(rows)} in all frames",
                _CORRECT,
            )
        lengths[name] = values[0]
    if len(set(lengths.values())) > 1:
        listed = " and ".join(f"{length} by {name}" for name, length in lengths.items())
        raise SourceError(f"the number of demonstration frames is not clear: {listed}", _CORRECT)
    return next(iter(lengths.values()), None)
