"""One rollout on the simulator `World` of `rollout_doubles`, over the sample split."""

import dataclasses
from typing import Any

import factories
from rollout_doubles import World

from robomme_interference_data import load_split
from robomme_interference_data.evaluate.config import RunConfig
from robomme_interference_data.evaluate.plan import WorkItem
from robomme_interference_data.evaluate.rollout import run_rollout
from robomme_interference_data.evaluate.rows import Rollout
from robomme_interference_data.ids import EpisodeId

EPISODE = EpisodeId("PatternLock", "test", 1)  # a lesson of 36 frames


def config(**changes: Any) -> RunConfig:
    split = load_split(factories.split())
    made = RunConfig("mine", "cheat", None, "world", str(split.root), split.name, split.revision)
    return dataclasses.replace(made, **changes)


def roll(
    condition: str,
    policy: Any,
    episode: EpisodeId = EPISODE,
    simulator: World | None = None,
    **changes: Any,
) -> Rollout:
    settings = config(**changes)
    return run_rollout(
        settings,
        WorkItem(condition, episode),
        simulator=simulator or World(),
        policy=policy,
        split=load_split(settings.split),
    )
