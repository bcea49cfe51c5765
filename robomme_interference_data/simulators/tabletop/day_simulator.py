"""The embedded suite at one table, where a robot spends whole days, as a `Simulator`."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import MAX_STEPS
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.days import DAY_RULE_VERSION, DayPlan, ability_of, goal_in_day
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.schema.shifts import NO_SHIFT
from robomme_interference_data.schema.subgoal import Subgoal
from robomme_interference_data.simulators.episode import CAMERAS, EpisodeStart, Observation

from .day import TABLE, PlayedDay
from .simulator import TabletopSimulator

_STILL = 0.02  # m


class TabletopDaySimulator(TabletopSimulator):
    """The episodes of `tabletop` as queries of a day; see `schema/days.py`.

    All families have the same table, and the goal says which lesson counts if the order matters.
    In an episode whose ability is `absent`, nothing was shown: an attempt that the family's judge
    decides on, either way, fails. What succeeds is to hold still: at the step limit, the arm's tip
    and all things must be within 2 cm of where they were. There,
    `oracle` holds still. In every episode, `recall` holds still if it knows no part of the answer:
    a memory that keeps the whole day then knows that nothing was shown.

    Args:
        cameras: See `TabletopSimulator`.
        shift: See `TabletopSimulator`.
    """

    name = "tabletop-day"
    about = (
        "tabletop-day, the simulator embedded in this project with all families at one table, "
        "which is not RoboMME: its results stand beside each other, not beside the paper's"
    )
    own_episodes = True
    try_out = False
    suite_version = DAY_RULE_VERSION

    def __init__(self, cameras: Sequence[str] = CAMERAS, shift: str = NO_SHIFT):
        super().__init__(cameras, shift)
        self.env.table = TABLE

    @classmethod
    def versions(cls) -> dict[str, str]:
        """Return its own version, and those of `tabletop`."""
        return TabletopSimulator.versions() | super().versions()

    def play_day(self, plan: DayPlan) -> PlayedDay:
        """Return a day, to be played frame by frame; a running episode ends.

        Until its last frame, or until it is given up, nothing else may be played.

        Raises:
            UnknownNameError: The plan has an episode that does not exist.
            SimulatorCrashError: The simulator is closed.
        """
        self._check_open()
        self._episode = None
        return PlayedDay(self.env, plan, self._cameras)

    def subgoal(self) -> Subgoal:
        """Return the next subgoal; see `Simulator.subgoal`."""
        if _absent(self._running()):
            return Subgoal("hold still")
        return super().subgoal()

    def _begin(self, episode: EpisodeId, frame_step: int) -> EpisodeStart:
        lesson, first, info = super()._begin(episode, frame_step)
        goals = tuple(goal_in_day(episode, goal) for goal in info.goals)
        self._start = self._positions()
        return lesson, first, replace(info, goals=goals)

    def _positions(self) -> NDArray[np.float64]:
        """Return where the arm's tip and all things are, `(n, 3) float64`, in m."""
        return np.stack([self.env.arm.tip, *(thing.p for thing in self.env.builder.things)])

    def _act(
        self, policy: str, known: Mapping[int, str], answer: int | None
    ) -> NDArray[np.float32]:
        knows_nothing = policy == "recall" and not known
        if knows_nothing or (policy == "oracle" and _absent(self._running())):
            return self.env.hold()
        return super()._act(policy, known, answer)

    def _execute(
        self, episode: EpisodeId, action: NDArray[np.float32], observe: bool
    ) -> tuple[Observation, Status]:
        observation, status = super()._execute(episode, action, observe)
        if not _absent(episode):
            return observation, status
        if status is not Status.ONGOING:
            return observation, Status.FAIL
        if self._steps < MAX_STEPS:
            return observation, Status.ONGOING
        moved = np.linalg.norm(self._positions() - self._start, axis=1).max()
        return observation, Status.SUCCESS if moved < _STILL else Status.FAIL


def _absent(episode: EpisodeId) -> bool:
    """Whether nothing of the answer is shown."""
    return ability_of(episode) == "absent"
