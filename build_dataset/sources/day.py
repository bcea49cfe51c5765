"""The source `tabletop-day`: days of the embedded simulator, and the queries about them."""

from collections.abc import Generator
from contextlib import closing
from dataclasses import replace
from typing import Any, override

from robomme_interference_data.constants import DAYS, EXECUTIONS, UNITS
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.days import TASKS, ability_of, day_id, plan_day, queries_of
from robomme_interference_data.schema.records import Day

from .base import Frame, Recording, SourceEpisode
from .simulator import SimulatorSource

STILL_FRAMES = 150
"""Most live frames of a query without a lesson, whose execution is to hold still.

Other executions of the embedded simulator have 146 on average, and 122 in the median (72 train
episodes). All 1300 time steps of a rollout would outweigh eight of them when a policy is trained.
"""


class DaySource(SimulatorSource):
    """Days of one length; the number of a day chooses it and its queries.

    Args:
        kind: Name of the dataset that is built: of `days` the episodes are the days, of units train
            episodes, of others the queries. Executions of queries without a lesson end after
            `STILL_FRAMES`.
        tasks: Number of tasks of a day.
        every, shifted: See `SimulatorSource`.
    """

    def __init__(self, name: str, kind: str, tasks: str, every: int = 1, shifted: bool = False):
        super().__init__(name, every, shifted)
        self._kind, self._tasks = kind, int(tasks)
        if self._tasks not in TASKS:
            raise InvalidOptionError.expected(
                "source", f"{name}:{tasks}", f"{TASKS[0]} to {TASKS[-1]} tasks, such as {name}:30"
            )
        if kind == DAYS:
            self.time_limit_s *= self._tasks

    @override
    def episodes(self) -> list[SourceEpisode]:
        if self._kind in UNITS:
            return super().episodes()
        days = self._days()
        if self._kind == DAYS:
            return [SourceEpisode(day) for day in days]
        return sorted(
            (
                SourceEpisode(query, day=day, ability=ability_of(query))
                for day in days
                for query in queries_of(day)
            ),
            key=lambda episode: episode.id,
        )

    @override
    def read(self, episode: SourceEpisode, cameras: tuple[str, ...] | None) -> Recording:
        if self._kind != DAYS:
            recording = super().read(episode, cameras)
            if self._kind == EXECUTIONS and ability_of(episode.id) == "absent":
                recording = replace(recording, frames=_until(recording.frames, STILL_FRAMES))
            return recording
        simulator: Any = self._open(self._chosen(cameras))
        plan = plan_day(episode.id, self._class.extra_episodes(), self._class.other_answer)
        played = simulator.play_day(plan)
        return Recording(
            goals=(f"do the {len(plan.tasks)} tasks of the day",),
            seed=None,
            difficulty=None,
            simulator=self.name,
            exact=True,
            frames=_frames(played),
            robot=self._robot(),
            day=lambda: Day(tuple(played.spans), plan.queries),
        )

    def _days(self) -> list[EpisodeId]:
        """Return all days whose queries are among the episodes of the simulator, in order."""
        found, known = [], {*self._class.episodes()}
        for split in sorted({episode.split for episode in known}):
            day = day_id(self._tasks, split, 0)
            while {*queries_of(day)} <= known:
                found.append(day)
                day = day_id(self._tasks, split, day.index + 1)
        return sorted(found)


def _until(frames: Generator[Frame], most: int) -> Generator[Frame]:
    """Yield the frames of a recording with at most so many live ones."""
    live = 0
    with closing(frames):
        for frame in frames:
            yield frame
            live += not frame.is_demonstration
            if live == most:
                return


def _frames(played: Any) -> Generator[Frame]:
    for seen, action in played.frames():
        yield Frame(seen.images, seen.state, action, None)
