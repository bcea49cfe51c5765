"""What came of each episode under each condition, as a page shows it."""

import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from urllib.parse import quote

from robomme_interference_data.evaluate.rows import NO_HISTORY, condition_rank
from robomme_interference_data.evaluate.score.check import BITS, DIFFICULTIES, STATUSES, pack
from robomme_interference_data.evaluate.score.outcomes import (
    ERROR,
    SUCCESS,
    Outcomes,
    episode_id,
)
from robomme_interference_data.evaluate.score.rollouts import Rollouts

__all__ = ["EpisodeRow", "episode_rows", "flips"]


@dataclass(frozen=True)
class EpisodeRow:
    """One system on one episode.

    Attributes:
        simulator: Name of the simulator.
        system: Name of the system.
        episode: The episode's id.
        difficulty: `easy`, `medium`, `hard` or empty.
        outcomes: Condition to its status, or, with repeats, successes and rollouts as `2/3`.
        flips: Where the outcome changes from one condition with history to the next.
        videos: Condition to the address of a video, relative to the page.
    """

    simulator: str
    system: str
    episode: str
    difficulty: str
    outcomes: dict[str, str]
    flips: str
    videos: dict[str, str]


def flips(conditions: Sequence[str], rates: Sequence[float]) -> str:
    """Return where an outcome changes between consecutive conditions, as `k3 lost, k7 gained`.

    Args:
        conditions: Conditions with history, in order.
        rates: Mean success under each; NaN, which is left out, where nothing counts.
    """
    known = [(c, r) for c, r in zip(conditions, rates, strict=True) if not math.isnan(r)]
    return ", ".join(
        f"{condition} {'gained' if rate > before else 'lost'}"
        for (_, before), (condition, rate) in pairwise(known)
        if rate != before
    )


def episode_rows(
    outcomes: Sequence[Outcomes], rollouts: Rollouts, page_folder: Path
) -> Iterator[EpisodeRow]:
    """Yield a row for each system and episode, in the order of tables."""
    there = _videos(rollouts)
    for one in outcomes:
        histories = [i for i, c in enumerate(one.conditions) if c != NO_HISTORY]
        names = [one.conditions[i] for i in histories]
        for place, packed in enumerate(one.episodes.tolist()):
            difficulty = int(one.difficulty[place])
            found, videos = {}, {}
            for row, condition in enumerate(one.conditions):
                if text := _outcome(one.counts[row, place].tolist()):
                    found[condition] = text
                if video := there.get(_key(rollouts, one, condition, packed)):
                    videos[condition] = _link(video, page_folder)
            yield EpisodeRow(
                one.simulator,
                one.system,
                str(episode_id(packed)),
                DIFFICULTIES[difficulty] if difficulty >= 0 else "",
                found,
                flips(names, one.rates[histories, place].tolist()),
                videos,
            )


def _link(video: Path, page_folder: Path) -> str:
    return quote(Path(os.path.relpath(video, page_folder)).as_posix())


def _outcome(counts: list[int]) -> str:
    if sum(counts) == 1:
        return STATUSES[counts.index(1)]
    scored = sum(counts[:ERROR])
    if not scored:
        return STATUSES[ERROR] if counts[ERROR] else ""
    return f"{counts[SUCCESS]}/{scored}"


def _videos(rollouts: Rollouts) -> dict[int, Path]:
    """Return the videos that are there, by packed row without seed and status.

    Of repeats it is the one with the lowest model seed among those that have one.
    """
    found: dict[int, Path] = {}
    for key, video in sorted(rollouts.videos.items()):
        if key >> BITS["model_seed"] not in found and video.is_file():
            found[key >> BITS["model_seed"]] = video
    return found


def _key(rollouts: Rollouts, one: Outcomes, condition: str, packed: int) -> int:
    codes = pack(
        simulator=rollouts.simulators.index(one.simulator),
        system=rollouts.systems.index(one.system),
        condition=condition_rank(condition) + 1,
    )
    return int(codes) >> BITS["status"] + BITS["model_seed"] | packed
