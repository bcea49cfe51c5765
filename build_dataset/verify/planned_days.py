"""Plan the days of a buffer set again, and compare them with what is recorded.

A day's tasks, looks and queries follow from its id and the simulator's lists alone, which need no
simulator that runs. Where each task begins and ends only `verify --replay` can tell.
"""

from collections.abc import Container, Iterable, Iterator, Mapping
from typing import Any

from robomme_interference_data.constants import (
    DAYS,
    DEMONSTRATIONS,
    EXECUTIONS,
    FAMILIES,
    IDENTITY_PATH,
    SHIFTED,
)
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.errors import InterferenceError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.days import DayPlan, ability_of, plan_day
from robomme_interference_data.schema.records import Day, EpisodeRecord
from robomme_interference_data.simulators.registry import SIMULATORS, simulator_class

from .dataset import Violation
from .planned_again import difference
from .replay import suite_version

_GIVES = "the plan gives"


def day_violations(datasets: Mapping[str, Dataset]) -> Iterator[Violation]:
    """Compare the days, and the abilities of all queries, with the plan.

    Args:
        datasets: Datasets of a buffer set by name, with or without days.
    """
    queries = set[EpisodeId]()
    if DAYS in datasets:
        for record in datasets[DAYS].records():
            if record.day is not None:  # otherwise a violation already
                queries |= {query.episode for query in record.day.queries}
        yield from _days(datasets[DAYS])
    for name in (DEMONSTRATIONS, EXECUTIONS, SHIFTED):
        if name in datasets:
            yield from _abilities(name, datasets[name].records(), queries)


def _days(days: Dataset) -> Iterator[Violation]:
    """Plan each day again, if it was planned by this version of its simulator."""
    simulators = {_planner(source) for source in days.identity.sources}
    if len(simulators) != 1 or None in simulators:
        what = f"sources are {[*days.identity.sources]}; days of these cannot be planned here"
        yield Violation(f"{DAYS}/{IDENTITY_PATH}", what)
        return
    [simulator] = simulators
    others = simulator.extra_episodes()
    for record in days.records():
        if record.day is None:
            continue
        where = f"{DAYS} {record.episode_id}"
        try:
            plan = plan_day(record.episode_id, others, simulator.other_answer)
        except InterferenceError as error:  # it is not the id of a day
            yield Violation(where, error.message)
        else:
            yield from (Violation(where, what) for what in _differences(record.day, plan))


def _planner(source: Mapping[str, Any]) -> Any:
    """Return the class of the simulator that a source is; None if it is of another version.

    The official simulator, which has no version of its own, plays no days.
    """
    name = str(source.get("kind"))
    # Never one that only the data names: it may be any module.
    if name not in SIMULATORS:
        return None
    simulator = simulator_class(name)
    if simulator.suite_version is None:
        return None
    recorded = suite_version(name, source)
    return simulator if recorded == str(simulator.suite_version) else None


def _differences(day: Day, plan: DayPlan) -> Iterator[str]:
    """Yield how a recorded day differs from its plan."""
    spans = [
        _span(span.source, span.part, span.shift, span.stop - span.start) for span in day.spans
    ]
    planned = []
    for task in plan.tasks:
        planned.append(_span(plan.day, "transition", task.shift, task.transition))
        planned.append(_span(task.episode or plan.day, task.part, task.shift, 0))
    if len(spans) != len(planned):
        yield f"has {len(spans)} spans; {_GIVES} {len(planned)}"
    elif spans != planned:
        yield f"a span is {difference(spans, planned, _GIVES)}"
    queries, expected = (
        [to_dict(query) for query in asked] for asked in (day.queries, plan.queries)
    )
    if queries != expected:
        yield f"queries are {difference(queries, expected, _GIVES)}"


def _span(source: EpisodeId, part: str, shift: str, frames: int) -> dict[str, Any]:
    """Return what the plan decides on: of the lengths, those of transitions."""
    span = {"source": str(source), "part": part, "shift": shift}
    return span | ({"frames": frames} if part == "transition" else {})


def _abilities(
    name: str, records: Iterable[EpisodeRecord], queries: Container[EpisodeId]
) -> Iterator[Violation]:
    for record in records:
        episode = record.episode_id
        planned = ability_of(episode) if episode.family in FAMILIES else None
        if record.ability != planned and (record.ability is not None or episode in queries):
            what = f"ability is {record.ability}; {_GIVES} {planned}"
            yield Violation(f"{name} {episode}", what)
