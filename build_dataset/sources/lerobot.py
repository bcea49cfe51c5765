"""Source `lerobot`: a LeRobot dataset, v3.0 or v2.1, in a folder or on the Hub.

Read with pyarrow and PyAV alone; `docs/reference/sources.md` describes columns and families.
"""

from collections.abc import Generator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, override

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import ACTION, OFFICIAL, STATE, VALUE_NAMES
from robomme_interference_data.errors import FormatError, SourceError, named
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.codec import from_dict
from robomme_interference_data.schema.evidence import spans_of_texts
from robomme_interference_data.schema.records import EvidenceSpan
from robomme_interference_data.simulators.episode import choose_cameras
from robomme_interference_data.storage.encode import is_png
from robomme_interference_data.storage.hub import HubFiles, locate
from robomme_interference_data.storage.lerobot import LeRobotFiles
from robomme_interference_data.storage.parquet import RowSpan, is_listed

from .base import Recording, Robot, Source, SourceEpisode, compose, demonstration_length, file_state
from .columns import camera_names, find_columns, recorded_robot
from .families import ids_by_block, ids_by_columns, names_episodes, read_families, template
from .images import decode_images, info_is_exact
from .robomme_families import BLOCKS, ROBOMME, families_for_goal

_ROBOMME_REPOS = ("lerobot/robomme", "Yinpei/robomme_data_lerobot")
_CORRECT = "Correct the dataset, or leave the episode out."


@dataclass(frozen=True)
class _Metadata:
    """Per-episode columns of a dataset; None where it has none."""

    tasks: tuple[str, ...] | None
    goals: tuple[str, ...] | None
    seed: int | None
    difficulty: str | None
    simulator: str | None
    exact: bool | None
    exec_start_idx: int | None
    evidence: tuple[EvidenceSpan, ...] | None

    @property
    def wordings(self) -> tuple[str, ...]:
        return self.goals or self.tasks or ()


class LeRobotSource(Source):
    """Episodes of a LeRobot dataset, in a folder or on the Hub; see `hub.locate`.

    `columns` maps logical names (a camera, `state`, `action`, `is_demo`, `exec_start_idx`,
    `subgoal`) to columns without a usual name. `kept_families` is the families file of an earlier
    build, for a dataset that does not name its families itself.
    """

    def __init__(
        self,
        location: str,
        columns: dict[str, str] | None = None,
        families_file: Path | None = None,
        kept_families: Path | None = None,
    ):
        self._files = locate(location)
        self._given_columns = columns or {}
        self._given_families, self._kept_families = families_file, kept_families
        self.provenance = {"kind": "lerobot"}
        if isinstance(self._files, HubFiles):
            self.provenance |= {"repo": self._files.repo_id, "revision": self._files.commit}
            if self._files.folder:
                self.provenance["folder"] = self._files.folder.removesuffix("/")

    def __getstate__(self) -> dict[str, Any]:
        lazy = ("_lerobot", "_columns", "_families")
        return {name: value for name, value in self.__dict__.items() if name not in lazy}

    @override
    def episodes(self) -> list[SourceEpisode]:
        rows, tasks = self._lerobot.table.to_pylist(), self._lerobot.tasks
        ids, simulator = self._ids(rows)
        listed = []
        for index, name in ids.items():
            metadata = self._metadata(index, rows[index])
            for task in metadata.tasks or ():
                if task not in tasks:
                    what = f"episode {index}: unknown task {task!r}"
                    raise FormatError.damaged(self._where, what)
            played = simulator or metadata.simulator
            if played in (None, OFFICIAL):
                self._check_goals(index, name, metadata.wordings)
            marked = {"is_demo", "exec_start_idx"} & self._columns.keys()
            key = index, played, self._state(index)
            known = bool(marked) or metadata.exec_start_idx is not None
            listed.append(SourceEpisode(name, key, marked=known))
        return sorted(listed, key=lambda episode: episode.id)

    @override
    def read(self, episode: SourceEpisode, cameras: tuple[str, ...] | None) -> Recording:
        index, simulator, _ = episode.key
        columns, metadata = self._columns, self._metadata(index, self._lerobot.row(index))
        chosen = choose_cameras(cameras, camera_names(columns))
        rows = self._lerobot.rows(index)
        states = self._lerobot.vectors(index, columns["state"])
        actions = self._lerobot.vectors(index, columns["action"]) if "action" in columns else None
        lesson = _lesson(rows, columns, metadata.exec_start_idx)
        exact = metadata.exact
        if exact is None:
            exact = all(self._is_exact(rows, columns[camera]) for camera in chosen)
        evidence = metadata.evidence
        if evidence is None and lesson is not None and "subgoal" in columns:
            evidence = spans_of_texts(
                rows.part(rows.start, rows.start + lesson).texts(columns["subgoal"])
            )
        vectors = {STATE: "state", ACTION: "action"}
        values = {feature: columns[name] for feature, name in vectors.items() if name in columns}
        videos = self._lerobot.video_features
        for column in (columns[camera] for camera in chosen):
            if column in videos:
                self._lerobot.check_video(index, column)
        streams = {camera: self._images(index, rows, columns[camera], exact) for camera in chosen}
        return Recording(
            goals=metadata.wordings,
            seed=metadata.seed,
            difficulty=metadata.difficulty,
            simulator=simulator,
            exact=exact,
            frames=compose(streams, states, actions, lesson),
            evidence=evidence,
            robot=self._robot(values, official=simulator == OFFICIAL),
        )

    @cached_property
    def _lerobot(self) -> LeRobotFiles:
        return LeRobotFiles(self._files)

    @cached_property
    def _columns(self) -> dict[str, str]:
        return find_columns(self._lerobot.features, self._given_columns, self._where)

    @property
    def _families_file(self) -> Path | None:
        if self._given_families is None and not names_episodes(self._lerobot.table.column_names):
            return self._kept_families
        return self._given_families

    @cached_property
    def _families(self) -> list[dict[str, Any]]:
        if self._families_file is None:
            return [{}] * len(self._lerobot)
        try:
            return read_families(self._families_file, self._tasks)
        except SourceError as error:
            if self._given_families is None:
                more = f"It is of an earlier build: give another with {named('families_file')}."
                raise SourceError(error.message, f"{error.hint}\n{more}") from None
            raise

    @property
    def _tasks(self) -> list[list[str]]:
        """The tasks of each episode, as far as the dataset has them."""
        table = self._lerobot.table
        if "tasks" not in table.column_names or not is_listed(table.schema.field("tasks").type):
            return [[]] * len(table)
        return [
            [text for text in texts or () if isinstance(text, str)]
            for texts in table["tasks"].to_pylist()
        ]

    @property
    def _where(self) -> str:
        return self._files.describe()

    def _metadata(self, index: int, row: dict[str, Any]) -> _Metadata:
        row = row | self._families[index]
        return from_dict(_Metadata, row, f"{self._where}: episode {index}")

    def _robot(self, columns: dict[str, str], *, official: bool) -> Robot:
        """Return the robot; RoboMME's values have known names, also where its datasets have none.

        `columns` maps features to columns.
        """
        robot = recorded_robot(self._lerobot, columns)
        size = (len(VALUE_NAMES),)
        if not official:
            return robot
        known = {f: VALUE_NAMES for f, name in columns.items() if self._lerobot.shape(name) == size}
        return replace(robot, names=known | robot.names)

    def _images(
        self, index: int, rows: RowSpan, column: str, exact: bool
    ) -> Generator[NDArray[np.uint8]]:
        if self._lerobot.features[column]["dtype"] == "video":
            yield from self._lerobot.iter_frames(index, column, 0, len(rows))
            return
        cells = enumerate(rows.images(column))
        where = f"of column {column!r}"
        yield from decode_images(((f"frame {n} {where}", data) for n, data in cells), exact)

    def _is_exact(self, rows: RowSpan, column: str) -> bool:
        """Return whether images are exact, by their codec or by the first one in parquet."""
        feature = self._lerobot.features[column]
        if feature["dtype"] != "video":
            return is_png(next(rows.images(column)))
        return info_is_exact((feature.get("video_info") or {}) | (feature.get("info") or {}))

    def _ids(self, rows: list[dict[str, Any]]) -> tuple[dict[int, EpisodeId], str | None]:
        """Return the episodes' ids, and the simulator where it follows from the dataset."""
        hub = isinstance(self._files, HubFiles) and self._files.repo_id in _ROBOMME_REPOS
        simulator = OFFICIAL if hub else None
        from_file = self._families_file is not None
        where = f"families file {self._families_file}" if from_file else self._where
        ids = ids_by_columns(self._families if from_file else rows, where)
        if ids is not None:
            return ids, simulator
        blocks = ids_by_block()
        if len(rows) == len(blocks):
            return blocks, OFFICIAL
        raise SourceError(
            f"the families of the {len(rows)} episodes of {self._where} are unknown: it has no "
            "per-episode column episode_id or family, and is not RoboMME's with "
            f"{len(blocks):,} episodes of {len(BLOCKS)} families",
            f"Write a CSV file and give it with {named('families_file')}. Its lines, with the "
            f"names of families:\n{template(self._tasks)}",
        )

    def _check_goals(self, index: int, name: EpisodeId, goals: tuple[str, ...]) -> None:
        for goal in goals:
            fits = families_for_goal(goal)
            if name.family in ROBOMME and name.family not in fits:
                others = " and ".join(fits) or "no family of RoboMME"
                raise SourceError(
                    f"{self._where}: episode {index} would be {name}, but its goal {goal!r} "
                    f"cannot be one of {name.family}; it fits {others}",
                    f"Name the families in a CSV file, {named('families_file')}: see "
                    "docs/reference/sources.md.",
                )

    def _state(self, index: int) -> tuple[Any, ...]:
        """Return what changes when the episode's files do; on the Hub, the commit is pinned."""
        if isinstance(self._files, HubFiles):
            return ()
        paths = [self._lerobot.locate(index).data]
        used = self._columns.values()
        for name in self._lerobot.video_features:
            # Part of a dataset suffices: what cannot be read is an error only when it is read.
            if name in used:
                with suppress(FormatError):
                    paths.append(self._lerobot.locate_video(index, name).path)
        return tuple(file_state(self._files.root / path) for path in paths)


def _lesson(rows: RowSpan, columns: dict[str, str], recorded: int | None) -> int | None:
    """Return the number of demonstration frames, on which all columns must agree, if known."""
    lengths = {} if recorded is None else {"per-episode exec_start_idx": recorded}
    if "is_demo" in columns:
        name = columns["is_demo"]
        lengths[name] = demonstration_length(rows.scalars(name), f"column {name!r}")
    if "exec_start_idx" in columns:
        name = columns["exec_start_idx"]
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
