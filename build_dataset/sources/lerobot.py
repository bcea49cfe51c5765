"""Source `lerobot`: a LeRobot dataset, v3.0 or v2.1, in a folder or on the Hub.

Read with pyarrow and PyAV alone. `docs/sources.md` describes the column map and the families file.
"""

from collections.abc import Generator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import FormatError, SourceError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.codec import from_dict
from robomme_interference_data.schema.evidence import spans_of_texts
from robomme_interference_data.schema.records import EvidenceSpan
from robomme_interference_data.simulators.base import CAMERAS, choose_cameras
from robomme_interference_data.simulators.registry import OFFICIAL
from robomme_interference_data.storage.encode import is_png
from robomme_interference_data.storage.hub import HubFiles, locate
from robomme_interference_data.storage.lerobot import LeRobotFiles
from robomme_interference_data.storage.parquet import RowSpan

from .base import (
    Recording,
    Source,
    SourceEpisode,
    compose,
    demonstration_length,
    file_state,
)
from .columns import resolve_columns
from .families import (
    ids_by_block,
    ids_by_columns,
    ids_by_file,
)
from .images import decode_images, info_is_exact
from .robomme_families import (
    BLOCKS,
    ROBOMME,
    families_for_goal,
)

_ROBOMME_REPOS = ("lerobot/robomme", "Yinpei/robomme_data_lerobot")
_MEND = "Correct the dataset, or leave the episode out."
_MEND_FAMILIES = (
    "Name the family of every episode in a file, `families_file`, with the line "
    "episode_index,family first."
)


@dataclass(frozen=True)
class _Told:
    """What the per-episode columns of a dataset may say; None where they do not."""

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
        """All wordings of the goal."""
        return self.goals or self.tasks or ()


class LeRobotSource(Source):
    """Episodes of a LeRobot dataset.

    Args:
        location: A folder, or a dataset repository on the Hub, as `hub.locate` reads it.
        columns: Logical name (`front`, `wrist`, `state`, `action`, `is_demo`, `exec_start_idx`,
            `subgoal`) to the dataset's column, where that is not named as usual.
        families_file: File that names the family of every episode, see `docs/sources.md`.
    """

    def __init__(
        self,
        location: str,
        *,
        columns: dict[str, str] | None = None,
        families_file: Path | None = None,
    ):
        self._files = locate(location)
        self._given_columns = columns
        self._families_file = families_file
        self.provenance = {"kind": "lerobot"}
        if isinstance(self._files, HubFiles):
            self.provenance |= {"repo": self._files.repo_id, "revision": self._files.commit}

    def __getstate__(self) -> dict[str, Any]:
        lazy = ("_lerobot", "_columns")
        return {name: value for name, value in self.__dict__.items() if name not in lazy}

    def episodes(self) -> list[SourceEpisode]:
        """List all episodes; see `Source.episodes`. Only `meta/` is read."""
        columns = set(self._columns.values())
        rows, known = self._lerobot.table.to_pylist(), self._lerobot.tasks
        ids, simulator = self._ids(rows)
        found = []
        for index, name in ids.items():
            told = self._told(index, rows[index])
            for task in told.tasks or ():
                if task not in known:
                    raise FormatError.damaged(
                        self._where, f"episode {index}: unknown task {task!r}"
                    )
            played = simulator or told.simulator
            if played in (None, OFFICIAL):
                self._check_goals(index, name, told.wordings)
            found.append(SourceEpisode(name, (index, played, self._state(index, columns))))
        return sorted(found, key=lambda episode: episode.id)

    def read(self, episode: SourceEpisode, cameras: tuple[str, ...] | None) -> Recording:
        """Open an episode; see `Source.read`."""
        index, simulator, _ = episode.key
        columns, told = self._columns, self._told(index, self._lerobot.row(index))
        chosen = choose_cameras(cameras, tuple(name for name in CAMERAS if name in columns))
        rows = self._lerobot.rows(index)
        states = self._lerobot.vectors(index, columns["state"])
        actions = self._lerobot.vectors(index, columns["action"]) if "action" in columns else None
        lesson = _lesson(rows, columns, told.exec_start_idx)
        exact = told.exact
        if exact is None:
            exact = all(self._is_exact(rows, columns[camera]) for camera in chosen)
        evidence = told.evidence
        if evidence is None and lesson is not None and "subgoal" in columns:
            evidence = spans_of_texts(
                rows.part(rows.start, rows.start + lesson).texts(columns["subgoal"])
            )
        streams = {camera: self._images(index, rows, columns[camera], exact) for camera in chosen}
        return Recording(
            goals=told.wordings,
            seed=told.seed,
            difficulty=told.difficulty,
            simulator=simulator,
            exact=exact,
            frames=compose(streams, states, actions, lesson),
            evidence=evidence,
        )

    @cached_property
    def _lerobot(self) -> LeRobotFiles:
        return LeRobotFiles(self._files)

    @cached_property
    def _columns(self) -> dict[str, str]:
        return resolve_columns(self._lerobot.features, self._given_columns, self._where)

    @property
    def _where(self) -> str:
        return self._files.describe()

    def _told(self, index: int, row: dict[str, Any]) -> _Told:
        return from_dict(_Told, row, f"{self._where}: episode {index}")

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
        """Tell whether images are exact, by their codec or by the first one stored in parquet."""
        feature = self._lerobot.features[column]
        if feature["dtype"] != "video":
            return is_png(next(rows.images(column)))
        return info_is_exact((feature.get("video_info") or {}) | (feature.get("info") or {}))

    def _ids(self, rows: list[dict[str, Any]]) -> tuple[dict[int, EpisodeId], str | None]:
        """Return the episodes' ids, and the simulator where the dataset need not say it."""
        hub = isinstance(self._files, HubFiles) and self._files.repo_id in _ROBOMME_REPOS
        simulator = OFFICIAL if hub else None
        if self._families_file is not None:
            return ids_by_file(self._families_file, len(rows)), simulator
        named = ids_by_columns(rows, self._where)
        if named is not None:
            return named, simulator
        blocks = ids_by_block()
        if len(rows) == len(blocks):
            return blocks, OFFICIAL
        raise SourceError(
            f"{self._where} does not say of what family its {len(rows)} episodes are: it has no "
            "per-episode column episode_id or family, and is not one of RoboMME's with "
            f"{len(blocks)} of {len(BLOCKS)} families",
            _MEND_FAMILIES,
        )

    def _check_goals(self, index: int, name: EpisodeId, goals: tuple[str, ...]) -> None:
        for goal in goals:
            fits = families_for_goal(goal)
            if name.family in ROBOMME and name.family not in fits:
                others = " and ".join(fits) or "no family of RoboMME"
                raise SourceError(
                    f"{self._where}: episode {index} would be {name}, but its goal {goal!r} "
                    f"cannot be one of {name.family}; it fits {others}",
                    _MEND_FAMILIES,
                )

    def _state(self, index: int, columns: set[str]) -> tuple[Any, ...]:
        """Return what changes when the episode's files do; of the Hub's, the commit is known."""
        if isinstance(self._files, HubFiles):
            return ()
        place = self._lerobot.locate(index)
        videos = [path for name, (path, _) in place.videos.items() if name in columns]
        # A part of a dataset may be here only: what is not is missed when it is read.
        return tuple(file_state(self._files.root / path) for path in (place.data, *videos))


def _lesson(rows: RowSpan, columns: dict[str, str], said: int | None) -> int | None:
    """Return the number of demonstration frames, as columns and `said` agree; None if untold."""
    found = {} if said is None else {"meta/": said}
    if "is_demo" in columns:
        name = columns["is_demo"]
        found[name] = demonstration_length(rows.scalars(name), f"column {name!r}")
    if "exec_start_idx" in columns:
        name = columns["exec_start_idx"]
        values = np.unique(rows.scalars(name)).tolist()
        if len(values) != 1 or not 0 <= values[0] <= len(rows):
            raise SourceError(
                f"column {name!r} holds {', '.join(map(str, values[:5]))}; expected one number "
                f"from 0 to {len(rows)} in all frames",
                _MEND,
            )
        found[name] = values[0]
    if len(set(found.values())) > 1:
        told = " and ".join(f"{start} by {name}" for name, start in found.items())
        raise SourceError(f"the number of demonstration frames is not clear: {told}", _MEND)
    return next(iter(found.values()), None)
