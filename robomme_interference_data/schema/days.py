"""Plan days: which tasks a robot does one after another, and what it is asked about them.

A day is one recording without a cut. Its plan is a pure function of the day's id, such as
`Day30/test/4`, and the rule version: 30 tasks, the fifth day of the test episodes. Choices come
from SHA-256, so that they are the same on every machine.

Rule version 1, for day d of n tasks:

1. *Queries.* With m = n // 15, at least 1, the episodes d·m to d·m + m − 1 of every family are
   candidates, family by family beginning with family d. They are taken while their lessons fit into
   three quarters of the first n − n // 4 tasks.
2. *Abilities.* What a query asks for depends on its id alone (see `ability_of`). In all
   difficulties of a family an ability has the same share, so that no first view tells which one it
   is.
3. *Order.* The lessons are put at random places of the first n − n // 4 tasks; several lessons of a
   query are in the order that its ability needs. Other tasks fill the rest, so that every query can
   be asked after up to n // 4 further tasks. Every fifth of them is idle time. A query without a
   lesson is asked where the last lesson of another one might be.
4. *Other tasks* are episodes that no buffer set has by default, each family equally often.
5. *Appearance.* One of every three days looks different until half of its tasks are done: other
   light, other cameras, clutter or other colors, in turn, of strength 2.
"""

import hashlib
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

from robomme_interference_data.constants import DIFFICULTIES, FAMILIES
from robomme_interference_data.errors import InvalidIdError
from robomme_interference_data.ids import EpisodeId

from .records import DayQuery
from .shifts import KINDS, NO_SHIFT, Shift

DAY_RULE_VERSION = 1
"""Version of this rule, and of `tabletop-day`: to be raised if days change."""

TASKS = range(8, 61)
"""Possible numbers of tasks of a day."""

DEFAULT_TASKS = 30

_CYCLE = ("recall", "update", "order", "absent", "recall", "update")
_CYCLE_IN_PIECES = ("several", "recall", "several", "absent", "several", "order")
IN_PIECES = ("PatternLock", "RouteStick")
"""Families of which neither piece of a lesson shows the whole answer."""

LEAST_FRAMES = {"lesson": 150, "first": 50, "second": 50, "idle": 32}
"""Fewest frames of a task by its part, on the embedded simulator: others do not play days."""

_LESSONS = {"recall": 1, "several": 2, "update": 2, "order-first": 2, "order-last": 2, "absent": 0}
"""Tasks that are played for a query."""

_WORDS = {
    "order-first": ", as it was shown the first time",
    "order-last": ", as it was shown the last time",
}
_STRENGTH = 2
_PER_QUERY_EPISODES = 15  # tasks for each query episode of a family
_TRANSITION = range(10, 31)  # frames: 1 to 3 s
_FAMILY = re.compile(r"Day([1-9][0-9]*)")


@dataclass(frozen=True)
class PlannedTask:
    """A task of a day.

    Attributes:
        episode: The episode whose demonstration is played; None for idle time.
        part: `lesson` for the whole demonstration, `first` or `second` for a piece of it, `idle`.
        shift: How the table looks meanwhile: a shift, or `none`.
        transition: Frames of the transition that brings in its objects.
    """

    episode: EpisodeId | None
    part: str
    shift: str
    transition: int


@dataclass(frozen=True)
class DayPlan:
    """The tasks of a day in order, and its queries in canonical order.

    A query can be asked first after its last lesson; one without a lesson after any task.
    """

    day: EpisodeId
    tasks: tuple[PlannedTask, ...]
    queries: tuple[DayQuery, ...]


def day_id(tasks: int, split: str, index: int) -> EpisodeId:
    """Return the id of a day."""
    return EpisodeId(f"Day{tasks}", split, index)


def day_tasks(day: EpisodeId) -> int:
    """Return the number of tasks of a day.

    Raises:
        InvalidIdError: It is not the id of a day.
    """
    match = _FAMILY.fullmatch(day.family)
    if match is None or int(match[1]) not in TASKS:
        raise InvalidIdError(
            f"{day} is not a day",
            f"Expected Day<n>/<split>/<index> with {TASKS[0]} to {TASKS[-1]} tasks, such as "
            "Day30/test/4.",
        )
    return int(match[1])


def ability_of(query: EpisodeId) -> str:
    """Return the ability that a query of a day needs: one of `ABILITIES`."""
    cycle = _cycle(query)
    # Difficulties alternate with the index: within each, the cycle goes on.
    turn, difficulty = divmod(query.index, len(DIFFICULTIES))
    ability = cycle[(FAMILIES.index(query.family) + turn + 2 * difficulty) % len(cycle)]
    if ability == "order":
        return "order-last" if _lot(query, "order") % 2 else "order-first"
    return ability


def goal_in_day(query: EpisodeId, goal: str) -> str:
    """Return the goal of a query in its day: it says which lesson counts, if the order matters."""
    return goal + _WORDS.get(ability_of(query), "")


def query_indices(day: EpisodeId) -> range:
    """Return the indices of the episodes that a day's queries are taken from, in each family."""
    per_day = max(1, day_tasks(day) // _PER_QUERY_EPISODES)
    return range(day.index * per_day, (day.index + 1) * per_day)


def queries_of(day: EpisodeId) -> list[EpisodeId]:
    """Return the query episodes of a day, in the order in which they are taken."""
    taken, room = list[EpisodeId](), _early(day) * 3 // 4
    for query in _candidates(day):
        room -= _LESSONS[ability_of(query)]
        if room < 0:
            break
        taken.append(query)
    return taken


def plan_day(
    day: EpisodeId, others: Iterable[EpisodeId], other_answer: Callable[[EpisodeId], int | None]
) -> DayPlan:
    """Plan a day; see the head of this file.

    Args:
        day: Its id.
        others: Episodes for tasks that no query asks about, in any order.
        other_answer: Returns the number of another answer of an episode; see `Simulator`.
    """
    count, placed = day_tasks(day), _places(day)
    tasks: dict[int, tuple[EpisodeId | None, str]] = {}
    for query, places in placed.items():
        tasks |= dict(zip(places, _lessons(query, other_answer), strict=True))
    queries = [DayQuery(query, _asked(day, query, places)) for query, places in placed.items()]
    asked_about = {query.episode for query in queries}
    fill = _fill(day, (episode for episode in others if episode not in asked_about))
    for place in range(count):
        if place not in tasks:
            tasks[place] = next(fill)
    return DayPlan(
        day,
        tuple(
            PlannedTask(*tasks[place], _look(day, place), _transition(day, place))
            for place in range(count)
        ),
        tuple(sorted(queries, key=lambda query: query.episode)),
    )


def least_day(day: EpisodeId, query: EpisodeId) -> tuple[int, list[tuple[str, int]]]:
    """Return what is certain about the sessions of a query's day before it is played.

    Returns:
        The number of the task after which the query can be asked, and a session for each span of
        the day in order: its role, and its least number of frames. A lesson may be a contradicting
        one.
    """
    placed = _places(day)
    parts: dict[int, str] = {}
    for known, places in placed.items():
        of_lessons = (part for _, part in _lessons(known, lambda episode: None))
        parts |= dict(zip(places, of_lessons, strict=True))
    others = [place for place in range(day_tasks(day)) if place not in parts]
    parts |= {
        place: "idle" if number % 5 == 0 else "lesson" for number, place in enumerate(others, 1)
    }
    sessions = []
    for place in range(day_tasks(day)):
        role = "lesson" if place in placed[query] else "distractor"
        sessions.append(("transition", _transition(day, place)))
        sessions.append((role, LEAST_FRAMES[parts[place]]))
    return _asked(day, query, placed[query]), sessions


def _places(day: EpisodeId) -> dict[EpisodeId, list[int]]:
    """Return the places of each query's lessons among the tasks of a day, in order."""
    drawn = iter(sorted(range(_early(day)), key=lambda place: _lot(day, "place", place)))
    return {query: sorted(islice(drawn, _LESSONS[ability_of(query)])) for query in queries_of(day)}


def _asked(day: EpisodeId, query: EpisodeId, places: Sequence[int]) -> int:
    """Return the task after which a query can be asked, given the places of its lessons."""
    return places[-1] if places else _asked_without(day, query)


def _transition(day: EpisodeId, place: int) -> int:
    """Return the frames of the transition before a task."""
    return _TRANSITION[_lot(day, "transition", place) % len(_TRANSITION)]


def _cycle(query: EpisodeId) -> tuple[str, ...]:
    return _CYCLE_IN_PIECES if query.family in IN_PIECES else _CYCLE


def _asked_without(day: EpisodeId, query: EpisodeId) -> int:
    """Return the task after which a query without a lesson is asked.

    It is distributed as the last lesson of a query of its family that has one or two, so that the
    length of the history does not tell that there is none.
    """
    others = [ability for ability in _cycle(query) if ability != "absent"]
    lessons = 1 if others[_lot(day, "as", query) % len(others)] == "recall" else 2
    return max(_lot(day, "asked", query, number) % _early(day) for number in range(lessons))


def _early(day: EpisodeId) -> int:
    """Return the number of tasks among which the lessons are."""
    return day_tasks(day) - day_tasks(day) // 4


def _candidates(day: EpisodeId) -> Iterator[EpisodeId]:
    """Yield the episodes that may be queries, in the order in which they are taken."""
    for index in query_indices(day):
        for number in range(len(FAMILIES)):
            family = FAMILIES[(day.index + number) % len(FAMILIES)]
            yield EpisodeId(family, day.split, index)


def _lessons(
    query: EpisodeId, other_answer: Callable[[EpisodeId], int | None]
) -> list[tuple[EpisodeId, str]]:
    """Return the episodes and parts that are played for a query, in order."""
    ability = ability_of(query)
    if ability == "absent":
        return []
    if ability == "recall":
        return [(query, "lesson")]
    if ability == "several":
        return [(query, "first"), (query, "second")]
    own = (query, "lesson")
    other = (EpisodeId(query.family, query.split, query.index, other_answer(query)), "lesson")
    return [own, other] if ability == "order-first" else [other, own]


def _fill(day: EpisodeId, others: Iterable[EpisodeId]) -> Iterator[tuple[EpisodeId | None, str]]:
    """Yield other tasks: rounds of one episode of every family, and idle time as every fifth."""
    families: dict[str, list[EpisodeId]] = {}
    for episode in sorted(others, key=lambda episode: _lot(day, "other", episode)):
        families.setdefault(episode.family, []).append(episode)
    number = 0
    for episodes in zip(*families.values(), strict=False):
        for episode in sorted(episodes, key=lambda episode: _lot(day, "round", episode)):
            number += 1
            if number % 5 == 0:
                yield None, "idle"
                number += 1
            yield episode, "lesson"


def _look(day: EpisodeId, place: int) -> str:
    """Return how the table looks during a task."""
    # Which of three days it is, is drawn: a fixed turn would go together with some abilities.
    block, turn = divmod(day.index, 3)
    drawn = _lot(EpisodeId(day.family, day.split, block), "look") % 3
    if turn != drawn or place >= day_tasks(day) // 2:
        return NO_SHIFT
    return str(Shift(KINDS[block % len(KINDS)], _STRENGTH))


def _lot(episode: EpisodeId, *parts: object) -> int:
    """Return a number that depends on a day or query, and the parts, alone."""
    text = "/".join(map(str, (DAY_RULE_VERSION, episode, *parts)))
    return int.from_bytes(hashlib.sha256(text.encode()).digest())
