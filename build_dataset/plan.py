"""Choose what a dataset holds of its sources' episodes: pure.

A demonstration is every raw frame of the demonstration section and then the first live
observation. A distractor unit is the first 256 raw frames of an episode subsampled at stride 8:
32 frames, raw indices 0, 8, …, 248 (paper, section "The history buffer", footnote).
"""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from robomme_interference_data.build_dataset.sources.base import SourceEpisode
from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    SPLITS,
    UNIT_FRAMES,
    UNIT_MIN_RAW_FRAMES,
    UNIT_STRIDE,
)
from robomme_interference_data.errors import InvalidOptionError, SourceError, nearest

__all__ = ["Plan", "PlannedEpisode", "Skipped", "parse_ranges", "plan_dataset", "select"]


@dataclass(frozen=True)
class PlannedEpisode:
    """An episode to be stored.

    Attributes:
        source: Number of its source, in the order given.
        episode: The episode as its source lists it.
        indices: Raw frames that are stored, in order.
        exec_start_idx: Position of the query frame among them, which is the last; None in a unit.
    """

    source: int
    episode: SourceEpisode
    indices: range
    exec_start_idx: int | None


@dataclass(frozen=True)
class Skipped:
    """An episode that yields nothing, and why."""

    episode_id: str
    raw_length: int
    reason: str


@dataclass(frozen=True)
class Plan:
    """What a dataset will hold, in canonical order, and what was left out."""

    kind: str
    episodes: tuple[PlannedEpisode, ...]
    skipped: tuple[Skipped, ...]


def parse_ranges(text: str) -> frozenset[int]:
    """Read episode numbers such as `0-49` or `0,3,10-12` (ends included).

    Raises:
        InvalidOptionError: The text is not of that form.
    """
    numbers: set[int] = set()
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        if (
            not first.isdecimal()
            or (dash and not last.isdecimal())
            or (dash and int(last) < int(first))
        ):
            raise InvalidOptionError(
                f"{text!r} is not a list of episode numbers", "Expected such as 0-49 or 0,3,10-12."
            )
        numbers.update(range(int(first), int(last or first) + 1))
    return frozenset(numbers)


def select(
    listed: Sequence[SourceEpisode],
    *,
    families: Iterable[str] | None = None,
    split: str | None = None,
    numbers: frozenset[int] | None = None,
) -> list[SourceEpisode]:
    """Keep the episodes that pass all given filters.

    Raises:
        InvalidOptionError: A family or split is unknown to the listed episodes.
    """
    known = {episode.id.family for episode in listed}
    wanted = set(families) if families is not None else known
    for family in sorted(wanted - known):
        raise InvalidOptionError(
            f"--families {family}: the sources hold no such family", nearest(family, known)
        )
    if split is not None and split not in SPLITS:
        raise InvalidOptionError(f"--split {split!r} is none of {', '.join(SPLITS)}")
    return [
        episode
        for episode in listed
        if episode.id.family in wanted
        and split in (None, episode.id.split)
        and (numbers is None or episode.id.index in numbers)
    ]


def plan_dataset(kind: str, sources: Sequence[Sequence[SourceEpisode]]) -> Plan:
    """Plan a dataset.

    Args:
        kind: `demonstrations` or `distractors`.
        sources: Selected episodes of each source.

    Returns:
        The plan; the same for every order of sources' episodes.

    Raises:
        SourceError: Two sources hold the same episode, or demonstrations are wanted of a source
            that does not mark them, or the episodes differ in cameras, sizes or vectors.
    """
    ordered = sorted(
        ((number, episode) for number, listed in enumerate(sources) for episode in listed),
        key=lambda item: item[1].id.sort_key,
    )
    for (first, one), (second, other) in itertools.pairwise(ordered):
        if one.id == other.id:
            raise SourceError(
                f"{one.id} is recorded twice (in source {first + 1} and source {second + 1})",
                "Leave one out: --families, --split, --episodes, or fewer --source.",
            )
    planned: list[PlannedEpisode] = []
    skipped: list[Skipped] = []
    for number, episode in ordered:
        chosen = _demonstration(episode) if kind == DEMONSTRATIONS else _unit(episode)
        if isinstance(chosen, str):
            skipped.append(Skipped(str(episode.id), episode.raw_length, chosen))
        else:
            exec_start_idx = len(chosen) - 1 if kind == DEMONSTRATIONS else None
            planned.append(PlannedEpisode(number, episode, chosen, exec_start_idx))
    _check_alike([item.episode for item in planned])
    return Plan(kind, tuple(planned), tuple(skipped))


def _demonstration(episode: SourceEpisode) -> range | str:
    length = episode.demonstration_length
    if length is None:
        raise SourceError(
            f"{episode.id}: the source does not mark which frames are the demonstration",
            "Demonstrations need an is_demo flag or an exec_start_idx column (give its name with "
            "--columns is_demo=NAME); distractor units can be built without: "
            "robomme-interference build distractors",
        )
    if length == 0:
        return "no demonstration frame"
    if length >= episode.raw_length:
        return "no live observation after the demonstration"
    return range(length + 1)


def _unit(episode: SourceEpisode) -> range | str:
    if episode.raw_length < UNIT_MIN_RAW_FRAMES:
        return f"{episode.raw_length} raw frames; a unit needs {UNIT_MIN_RAW_FRAMES}"
    return range(0, UNIT_FRAMES * UNIT_STRIDE, UNIT_STRIDE)


def _check_alike(episodes: Sequence[SourceEpisode]) -> None:
    for episode in episodes:
        first = episodes[0]
        for what, one, other in (
            ("cameras", first.cameras, episode.cameras),
            ("state values", first.state_size, episode.state_size),
            ("action values", first.action_size, episode.action_size),
        ):
            if one != other:
                raise SourceError(
                    f"{first.id} and {episode.id} cannot be in one dataset: their {what} differ "
                    f"({one} and {other})",
                    "Choose cameras that all have with --cameras, or build the sources apart.",
                )
