"""Offline evaluation as a kind of run: a policy's actions beside recorded ones, no simulator."""

import dataclasses
from collections.abc import Sequence

from robomme_interference_data.constants import EXECUTIONS
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.loading import open_dataset
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.evaluate.rollout.kind import Rollouts
from robomme_interference_data.evaluate.run.config import RunConfig, check_unused
from robomme_interference_data.evaluate.run.plan import Plan, WorkItem
from robomme_interference_data.evaluate.subgoals.writer import ORACLE
from robomme_interference_data.simulators.registry import RECORDINGS

_UNUSED = ("simulator", "shift", "check_lesson", "videos")
"""Settings of simulators."""


class Offline(Rollouts):
    """Rollouts along recorded executions: the policy acts, and the recording goes on."""

    def __init__(self, config: RunConfig, buffer_set: BufferSet):
        check_unused(config, _UNUSED, "an offline evaluation", "Leave it out.")
        if config.subgoals == ORACLE:
            raise InvalidOptionError(
                f"subgoals of {ORACLE} need a simulator", "Set a model, or leave out `offline`."
            )
        super().__init__(dataclasses.replace(config, simulator=RECORDINGS), buffer_set)

    def check(self, plan: Plan, items: Sequence[WorkItem]) -> None:
        """Check every item, and that its episode has an execution."""
        super().check(plan, items)
        executions = open_dataset(self.buffer_set, EXECUTIONS)
        for episode in dict.fromkeys(item.episode for item in items):
            executions.index_of(episode)  # raises
