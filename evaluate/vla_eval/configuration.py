"""The configuration with which `vla-eval run` plays this benchmark."""

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import yaml

from robomme_interference_data.constants import DEMONSTRATIONS, STATE
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.loading import load_buffer_set
from robomme_interference_data.errors import InvalidOptionError, named
from robomme_interference_data.evaluate.run.plan import plan_work
from robomme_interference_data.evaluate.systems import name_system
from robomme_interference_data.ids import count_numbers
from robomme_interference_data.simulators.episode import ACTION_SIZE
from robomme_interference_data.simulators.registry import simulator_class

BENCHMARK = f"{__package__}.benchmark:RoboMMEInterference"

_ANSWER_S = 600.0
"""Seconds for an answer: the first one comes after the whole history was sent and taken in."""


def check_label(system: str) -> None:
    """Check that a system is a name, and not one of the paper's."""
    if name_system(system).paper:
        raise InvalidOptionError(
            f"a server of vla-eval is not the paper's system {system}",
            f"Set {named('system')} to a name of your own; docs/how-to/connect-a-policy.md lists "
            "what differs.",
        )


def check_robot(buffer_set: BufferSet, simulator: str) -> None:
    """Check that the robot has the states that servers read, and the actions that they return."""
    (state,) = buffer_set.datasets[DEMONSTRATIONS].features[STATE]
    action = simulator_class(simulator).action_size
    if {state, action} != {ACTION_SIZE}:
        raise InvalidOptionError(
            f"vla-eval's servers get {ACTION_SIZE} state values and return {ACTION_SIZE} action "
            f"values here, 7 joints and a gripper; this robot has {state} and {action}",
            "Use the command evaluate, with a policy for this robot: python:module:factory.",
        )


def configuration(
    buffer_set: str,
    system: str,
    *,
    conditions: Sequence[str] = (),
    families: Sequence[str] = (),
    episodes: str | None = None,
    simulator: str = "tabletop",
    url: str = "ws://localhost:8000",
    output_dir: str = "results",
) -> str:
    """Return it as YAML, for all query episodes of the split `test` or the chosen ones.

    vla-eval runs the same number of episodes of each task: families with different numbers are
    different entries.

    Raises:
        UnknownNameError: The buffer set lacks a family, condition or episode.
        InvalidIdError: `system` is not a name.
        InvalidOptionError: It is a system of the paper, or the robot has other actions or states.
    """
    check_label(system)
    opened = load_buffer_set(buffer_set)
    check_robot(opened, simulator)
    plan = plan_work(
        opened.episodes_under(conditions or opened.conditions),
        conditions=conditions or opened.conditions,
        families=families,
        episodes=episodes,
    )
    groups = defaultdict[int, list[str]](list)
    for group, numbers in plan.episodes.items():
        groups[count_numbers(numbers)].append(group.partition("/")[0])
    params: dict[str, Any] = {
        "buffer_set": opened.location,
        "system": system,
        "simulator": simulator,
        "conditions": [*plan.conditions],
    }
    if episodes is not None:
        params["episodes"] = episodes
    entries = []
    for count, names in groups.items():
        entry: dict[str, Any] = {"benchmark": BENCHMARK}
        if len(groups) > 1:  # entries of one benchmark need different names
            entry["subname"] = f"{count}-episodes"
        entry["episodes_per_task"] = count
        entry["params"] = params | {"families": names}
        entries.append(entry)
    whole = {
        "server": {"url": url, "timeout": _ANSWER_S},
        "output_dir": output_dir,
        "benchmarks": entries,
    }
    return str(yaml.safe_dump(whole, sort_keys=False)).rstrip()
