"""Shortcuts: how far something other than the lesson's frames reveals the hidden answer.

Policies receive the length of the history, the goal and the live observation. A policy that guesses
from one of them needs no memory, and looks like one that remembers. Here each episode's answer is
guessed from the other episodes of its family (leave-one-out), by a cue alone.
"""

from collections import Counter
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.retrieval.encoders.thumbnail import Thumbnail
from robomme_interference_data.schema.records import EvidenceSpan
from robomme_interference_data.viz.tables import Table

from .ceiling import queries_with_evidence

COUNT = "count"


@dataclass(frozen=True)
class Cues:
    """The answer of an episode, and what a policy sees without its lesson.

    Attributes:
        family: Its family.
        evidence: The evidence of its lesson.
        length: Number of frames of its lesson.
        goal: Its goal in words.
        view: The first live image of the first camera, `(H, W, 3) uint8` RGB; None without images.
    """

    family: str
    evidence: Sequence[EvidenceSpan]
    length: int
    goal: str
    view: NDArray[np.uint8] | None = None


@dataclass(frozen=True)
class Shortcut:
    """How often guesses are right, for one part of the answers of a family.

    Attributes:
        family: The family.
        part: Number of the part, from 0, or `count`: how many parts there are.
        queries: Number of episodes that have the part.
        most_frequent: Right guesses if the most frequent value is always guessed: no cue at all.
        length, goal, view: Right guesses by a cue: the value of the episode whose lesson is nearest
            in length, the most frequent value among episodes with the same goal, the value of the
            episode whose live observation looks most alike (encoder `thumbnail`). `view` is None if
            images are not stored.
    """

    family: str
    part: str
    queries: int
    most_frequent: int
    length: int
    goal: int
    view: int | None


def cues_of(buffer_set: BufferSet) -> list[Cues]:
    """Return the cues of all queries of a buffer set whose evidence is known.

    Raises:
        InvalidOptionError: No query has known evidence.
    """
    return [
        Cues(
            query.episode_id.family,
            query.record.evidence or (),
            query.lesson_frames,
            query.goal,
            query.frame() if query.dataset.cameras else None,
        )
        for query in queries_with_evidence(buffer_set)
    ]


def shortcuts(episodes: Sequence[Cues]) -> Iterator[Shortcut]:
    """Yield, for each family and each part of its answers, what each cue reveals."""
    for family in dict.fromkeys(episode.family for episode in episodes):
        members = [episode for episode in episodes if episode.family == family]
        texts = [{span.part: span.text for span in episode.evidence} for episode in members]
        if len({len(answer) for answer in texts}) > 1:
            yield _measure(family, COUNT, members, [len(answer) for answer in texts])
        for part in sorted({part for answer in texts for part in answer}):
            have = [at for at, answer in enumerate(texts) if part in answer]
            values = [texts[at][part] for at in have]
            if len(set(values)) > 1:
                yield _measure(family, str(part), [members[at] for at in have], values)


def _measure(
    family: str, part: str, members: Sequence[Cues], values: Sequence[Hashable]
) -> Shortcut:
    lengths = np.array([[episode.length] for episode in members], np.float64)
    views = [episode.view for episode in members if episode.view is not None]
    seen: int | None = None
    if len(views) == len(members):
        seen = by_nearest(Thumbnail().prepare(np.stack(views)), values)
    frequent = max(Counter(values).values())
    goals = by_group([episode.goal for episode in members], values)
    return Shortcut(family, part, len(values), frequent, by_nearest(lengths, values), goals, seen)


def by_nearest(features: NDArray[Any], values: Sequence[Hashable]) -> int:
    """Count the values that equal that of the nearest other one.

    Args:
        features: `(N, D)`; distances are Euclidean, and of equal ones the first counts.
        values: N values, N at least 2.
    """
    right = 0
    for at, value in enumerate(values):
        distances = ((features - features[at]) ** 2).sum(axis=1, dtype=np.float64)
        distances[at] = np.inf  # not itself
        right += values[int(np.argmin(distances))] == value
    return right


def by_group(groups: Sequence[Hashable], values: Sequence[Hashable]) -> int:
    """Count the values that equal the most frequent one of the other members of their group.

    Of equally frequent ones the first counts. A member without others is compared with the most
    frequent value of all others.
    """
    right = 0
    for at, value in enumerate(values):
        others = [*values[:at], *values[at + 1 :]]
        names = [*groups[:at], *groups[at + 1 :]]
        same = [other for other, name in zip(others, names, strict=True) if name == groups[at]]
        [(guess, _)] = Counter(same or others).most_common(1)
        right += guess == value
    return right


def shortcut_table(measured: Sequence[Shortcut], title: str) -> Table:
    """Return the table for the terminal."""
    return Table(
        "shortcuts",
        title,
        {
            "family": "text",
            "part": "text",
            "queries": "count",
            "most_frequent": "count",
            "length": "count",
            "goal": "count",
            "live_view": "count",
        },
        [
            (
                shortcut.family,
                shortcut.part,
                shortcut.queries,
                shortcut.most_frequent,
                shortcut.length,
                shortcut.goal,
                shortcut.view,
            )
            for shortcut in measured
        ],
        "right guesses of each part of the answer (count: of how many there are) without the "
        "lesson's frames: always the most frequent value; the value of the other episode nearest "
        "in lesson length; the most frequent among episodes with the same goal; the value of the "
        "episode whose first live observation looks most alike. Parts that are equal in all "
        "episodes are left out.",
    )
