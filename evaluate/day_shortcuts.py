"""Shortcuts in days: what reveals a query's answer, or the ability that it needs, without a memory.

Policies receive the length of the history and the first live observation, and may count the tasks
in the history. One that guesses from these looks like one that remembers. Here each query's answer
is guessed to be that of a query of another day: the one of the same family and difficulty that is
nearest by a single cue. Its ability is guessed alike, among queries of families with the same
abilities. Permuting the answers, or abilities, among the same queries shows how many guesses would
be right if the cue had nothing to do with them. Queries of one day are never compared: no two
lessons are at the same moment of it, so where one query is asked tells about the others.
"""

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import ABILITIES, DAYS
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.query import Query
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.retrieval.encoders.thumbnail import Thumbnail
from robomme_interference_data.retrieval.grade import ALL
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.schema.days import IN_PIECES
from robomme_interference_data.schema.manifest import BufferManifest
from robomme_interference_data.schema.records import Day, DaySpan
from robomme_interference_data.simulators.registry import recorded_scene
from robomme_interference_data.stats.bootstrap import generator_of
from robomme_interference_data.stats.significance import holm
from robomme_interference_data.viz.tables import Columns, Table

CUES = ("length", "clock", "task", "delay", "view")
"""What guesses are based on; see `DayCues`."""

PERMUTATIONS = 1999
"""So that the smallest p-value is 1 / 2000."""


@dataclass(frozen=True)
class DayCues:
    """What a policy must know about a query of a day, and what it sees without a memory.

    Attributes:
        condition: Name of the condition.
        day: The day.
        family, difficulty: Those of the query episode.
        ability: What the query needs of a memory.
        answer: Number of the right answer among those that the scene allows; None if unknown.
        length: Frames of the history.
        clock: Frames from the beginning of the day to the end of the history.
        task: Number of the task, from 0, after which the query can be asked: its last lesson.
        delay: Frames of the history after that task.
        view: The first live image of the first camera, `(H, W, 3) uint8` RGB; None without images.
    """

    condition: str
    day: EpisodeId
    family: str
    difficulty: str | None
    ability: str
    answer: int | None
    length: int
    clock: int
    task: int
    delay: int
    view: NDArray[np.uint8] | None = field(default=None, compare=False)


@dataclass(frozen=True)
class DayShortcut:
    """How often guesses by one cue are right, for the queries that need one ability.

    Attributes:
        condition: Name of the condition.
        target: What is guessed: `answer` or `ability`.
        ability: The ability, or `ALL`.
        cue: One of `CUES`.
        queries: Number of queries with others, of other days, to guess from.
        right: Right guesses.
        expected: Mean of right guesses over the permutations.
        p: Share of permutations, the observed order among them, with as many right guesses or more.
    """

    condition: str
    target: str
    ability: str
    cue: str
    queries: int
    right: int
    expected: float
    p: float


def day_cues(buffer_set: BufferSet) -> list[DayCues]:
    """Return the cues of all queries of days, under each condition `day-k<n>` and `day-cut-k<n>`.

    Of a buffer set without days the list is empty.
    """
    days = buffer_set.datasets.get(DAYS)
    if days is None:
        return []
    asked = {
        query.episode: (record.episode_id, record.day, query.task)
        for record in days.records()
        if record.day is not None
        for query in record.day.queries
    }
    queries = {
        episode: _Asked.of(buffer_set.query(episode), *asked[episode])
        for episode in buffer_set.episode_ids
        if episode in asked
    }
    return [
        queries[manifest.episode_id].cues(manifest)
        for manifest in buffer_set.manifests()
        if manifest.episode_id in queries and _is_stream(manifest)
    ]


def _is_stream(manifest: BufferManifest) -> bool:
    """Return whether a buffer is a day up to a moment, with or without its transitions."""
    kind = parse_condition(manifest.condition).kind
    return DAYS in kind.needs and kind.counted


@dataclass(frozen=True)
class _Asked:
    """A query of a day, with what does not depend on the condition."""

    query: Query
    day: EpisodeId
    spans: Sequence[DaySpan]
    task: int
    answer: int | None
    view: NDArray[np.uint8] | None

    @classmethod
    def of(cls, query: Query, name: EpisodeId, day: Day, task: int) -> "_Asked":
        view = query.frame() if query.dataset.cameras else None
        return cls(query, name, day.spans, task, _answer(query), view)

    def cues(self, manifest: BufferManifest) -> DayCues:
        """Return the cues under a condition."""
        record, sessions = self.query.record, manifest.sessions
        tasks = [span for span in self.spans if span.part != "transition"]
        asked = tasks[self.task].stop
        return DayCues(
            manifest.condition,
            self.day,
            record.episode_id.family,
            record.difficulty,
            str(record.ability),
            self.answer,
            length=manifest.history_frames,
            clock=sessions[-1].stop,
            task=self.task,
            delay=sum(entry.num_frames for entry in sessions if entry.start >= asked),
            view=self.view,
        )


def _answer(query: Query) -> int | None:
    """Return the number of the right answer among those that the scene allows."""
    scene, spans = recorded_scene(query), query.record.evidence
    if scene is None or spans is None:
        return None
    agreeing = scene.agreeing({span.part: span.text for span in spans})
    return [*scene.answers].index(agreeing[0]) if len(agreeing) == 1 else None


def day_shortcuts(cues: Sequence[DayCues]) -> Iterator[DayShortcut]:
    """Yield what each cue reveals: of the answers, and of the abilities.

    Nothing has to be answered where no lesson was shown, so answers of such queries do not count.
    """
    for condition in dict.fromkeys(asked.condition for asked in cues):
        queries = [asked for asked in cues if asked.condition == condition]
        answered = [
            asked for asked in queries if asked.answer is not None and asked.ability != "absent"
        ]
        scenes = [(asked.family, asked.difficulty) for asked in answered]
        answers = [asked.answer for asked in answered]
        yield from _measure(condition, "answer", answered, scenes, answers)
        in_pieces = [asked.family in IN_PIECES for asked in queries]
        abilities = [asked.ability for asked in queries]
        yield from _measure(condition, "ability", queries, in_pieces, abilities)


def _measure(
    condition: str,
    target: str,
    queries: Sequence[DayCues],
    groups: Sequence[Hashable],
    values: Sequence[Hashable],
) -> Iterator[DayShortcut]:
    """Yield what each cue reveals of values, which are guessed within groups."""
    days_of: dict[Hashable, set[EpisodeId]] = {}
    for asked, group_of in zip(queries, groups, strict=True):
        days_of.setdefault(group_of, set()).add(asked.day)
    compared = [at for at, group_of in enumerate(groups) if len(days_of[group_of]) > 1]
    if not compared:
        return
    queries = [queries[at] for at in compared]
    day = _numbers([asked.day for asked in queries])
    group = _numbers([groups[at] for at in compared])
    value = _numbers([values[at] for at in compared])
    permuted = _permuted(value, group, f"shortcuts {condition} {target}")
    ability = _numbers([asked.ability for asked in queries])
    # Permuted abilities are of other queries.
    permuted_ability = permuted if target == "ability" else ability
    numbers = {asked.ability: number for asked, number in zip(queries, ability, strict=True)}
    known = [name for name in ABILITIES if name in numbers]

    def needing(name: str, abilities: NDArray[np.int64]) -> NDArray[np.bool_]:
        return abilities == numbers[name] if name in numbers else np.ones(abilities.shape, bool)

    for cue in CUES:
        features = _features(queries, cue)
        if features is None:
            continue
        guessed_from = nearest(features, group, day)
        right = value[guessed_from] == value
        by_chance = permuted[:, guessed_from] == permuted
        for name in (*known, ALL):
            part = needing(name, ability)
            count = int((right & part).sum())
            counts = (by_chance & needing(name, permuted_ability)).sum(axis=1)
            p = (1 + int((counts >= count).sum())) / (1 + PERMUTATIONS)
            yield DayShortcut(
                condition, target, name, cue, int(part.sum()), count, float(counts.mean()), p
            )


def _numbers(values: Sequence[Hashable]) -> NDArray[np.int64]:
    """Return a number for each value, equal ones for equal values."""
    known = {value: number for number, value in enumerate(dict.fromkeys(values))}
    return np.array([known[value] for value in values])


def _permuted(values: NDArray[np.int64], groups: NDArray[np.int64], key: str) -> NDArray[np.int64]:
    """Return the values permuted within groups, `(PERMUTATIONS, N) int64`."""
    generator = generator_of(key)
    permuted = np.tile(values, (PERMUTATIONS, 1))
    for group in np.unique(groups):
        members = groups == group
        permuted[:, members] = generator.permuted(permuted[:, members], axis=1)
    return permuted


def _features(queries: Sequence[DayCues], cue: str) -> NDArray[Any] | None:
    """Return the features of a cue, `(N, D)`; None without images."""
    if cue != "view":
        return np.array([[getattr(asked, cue)] for asked in queries], np.float64)
    views = [asked.view for asked in queries if asked.view is not None]
    return Thumbnail().prepare(np.stack(views)) if len(views) == len(queries) else None


def nearest(
    features: NDArray[Any], groups: NDArray[np.int64], days: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return the nearest one of the same group and another day for each of N.

    Of equally near ones it is the first.

    Args:
        features: `(N, D)`; distances are Euclidean.
        groups: `(N,)`, each with several days.
        days: `(N,)`.
    """
    found = []
    for at, feature in enumerate(features):
        others = np.flatnonzero((groups == groups[at]) & (days != days[at]))
        distances = ((features[others] - feature) ** 2).sum(axis=1, dtype=np.float64)
        found.append(others[np.argmin(distances)])
    return np.array(found)


def day_shortcut_table(measured: Sequence[DayShortcut], title: str) -> Table:
    """Return the table for the terminal: a row for all cues, which have the same queries."""
    columns: Columns = {"condition": "text", "guessed": "text", "ability": "text"}
    columns |= {"queries": "count", "by_chance": "number"}
    columns |= {cue: "count" for cue in CUES}
    columns["p"] = "p"
    rows: dict[tuple[str, str, str], dict[str, DayShortcut]] = {}
    for shortcut in measured:
        names = shortcut.condition, shortcut.target, shortcut.ability
        rows.setdefault(names, {})[shortcut.cue] = shortcut
    adjusted = _adjusted(measured)
    return Table(
        "day-shortcuts",
        title,
        columns,
        [
            (
                *names,
                cues["length"].queries,
                float(np.mean([shortcut.expected for shortcut in cues.values()])),
                *(cues[cue].right if cue in cues else None for cue in CUES),
                min(adjusted[shortcut] for shortcut in cues.values()),
            )
            for names, cues in rows.items()
        ],
        "right guesses of the answer, or of the ability, without the history's frames: that of the "
        "query nearest in length of the history, frames since the day began, task after which it "
        "can be asked, frames after that task, or first live observation, among those of other "
        "days and the same family and difficulty (abilities: families with the same abilities). By "
        "chance: the mean over permutations of the answers; p: the smallest of the cues' one-sided "
        "p-values, after Holm's correction for all cues and abilities of a condition; in the row "
        "of all abilities, for the cues.",
    )


def _adjusted(measured: Sequence[DayShortcut]) -> dict[DayShortcut, float]:
    """Return the p-values after Holm's correction: for all abilities together, and for `ALL`."""
    families: dict[tuple[str, str, bool], list[DayShortcut]] = {}
    for shortcut in measured:
        family = shortcut.condition, shortcut.target, shortcut.ability == ALL
        families.setdefault(family, []).append(shortcut)
    adjusted: dict[DayShortcut, float] = {}
    for tests in families.values():
        values = holm([shortcut.p for shortcut in tests])
        adjusted |= dict(zip(tests, values, strict=True))
    return adjusted
