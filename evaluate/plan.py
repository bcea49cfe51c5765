"""What a run has to do: pure, without files or processes."""

import hashlib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from robomme_interference_data.errors import InvalidOptionError, UnknownNameError, nearest
from robomme_interference_data.evaluate.rows import NO_HISTORY, condition_rank
from robomme_interference_data.ids import EpisodeId

__all__ = [
    "WorkItem",
    "parse_episodes",
    "parse_shard",
    "plan_work",
    "select_families",
    "shuffle_work",
    "take_shard",
]

_SPAN = re.compile(r"(\d{1,9})(?:-(\d{1,9}))?")


@dataclass(frozen=True)
class WorkItem:
    """One rollout to run.

    Attributes:
        condition: `no-history`, `k0`, `k1`, …
        episode: The query episode.
    """

    condition: str
    episode: EpisodeId

    @property
    def k(self) -> int | None:
        """Number of distractor sessions; None without history."""
        return None if self.condition == NO_HISTORY else condition_rank(self.condition)


def parse_episodes(text: str) -> tuple[int, ...]:
    """Read episode indices from text such as `0-49` or `0,3,10-12`; both ends are included.

    Returns:
        The indices, ascending, each once.

    Raises:
        InvalidOptionError: The text is something else.
    """
    numbers: set[int] = set()
    for part in text.split(","):
        match = _SPAN.fullmatch(part.strip())
        if match is None or int(match[2] or match[1]) < int(match[1]):
            raise InvalidOptionError(
                f"--episodes {text}: {part.strip()!r} is not a number or a span",
                "Expected numbers and spans with commas between them, such as 0-49 or 0,3,10-12.",
            )
        numbers.update(range(int(match[1]), int(match[2] or match[1]) + 1))
    return tuple(sorted(numbers))


def select_families(asked: Sequence[str], known: Sequence[str]) -> tuple[str, ...]:
    """Return the families that are asked for, in the order of `known`; `all` is all of them.

    Raises:
        UnknownNameError: One is not known.
    """
    if list(asked) == ["all"]:
        return tuple(known)
    for family in asked:
        if family not in known:
            raise UnknownNameError(
                f"family {family!r} is not in the split", nearest(family, [*known, "all"])
            )
    return tuple(family for family in known if family in asked)


def plan_work(
    known: Iterable[EpisodeId],
    *,
    episode_split: str,
    families: Sequence[str],
    episodes: Sequence[int],
    conditions: Sequence[str],
) -> tuple[WorkItem, ...]:
    """List the rollouts of a run in canonical order: by family, episode and condition.

    An episode's conditions follow each other, so that even a run that is cut off compares
    conditions over the same episodes.

    Args:
        known: Query episodes of the split.
        episode_split: `train`, `val` or `test`.
        families: Which families, each once.
        episodes: Which indices, each once.
        conditions: Which conditions.

    Raises:
        InvalidIdError: A condition is none.
        UnknownNameError: The split lacks an episode that is asked for.
    """
    order = sorted(set(conditions), key=condition_rank)
    present = set(known)
    items = []
    for family in families:
        asked = [EpisodeId(family, episode_split, index) for index in episodes]
        missing = [episode for episode in asked if episode not in present]
        if missing:
            has = sorted(e.index for e in present if (e.family, e.split) == (family, episode_split))
            raise UnknownNameError(
                f"the split has no query episode {missing[0]}"
                + (f" and {len(missing) - 1} more" if len(missing) > 1 else ""),
                f"It has {_spans(has)} of {family}/{episode_split}: give those to --episodes."
                if has
                else f"It has no {episode_split} episode of {family}: see --episode-split and "
                "robomme-interference list.",
            )
        items += [WorkItem(condition, episode) for episode in asked for condition in order]
    return tuple(items)


def parse_shard(text: str) -> tuple[int, int]:
    """Read a shard such as `2/8`, the second of eight.

    Raises:
        InvalidOptionError: The text is something else.
    """
    match = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text.strip())
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise InvalidOptionError(
            f"--shard {text} is not a shard",
            "Expected NUMBER/OF, such as 2/8 for the second of eight.",
        )
    return int(match[1]), int(match[2])


def shuffle_work(plan: Iterable[WorkItem]) -> tuple[WorkItem, ...]:
    """Return rollouts in the order in which they are run: episodes shuffled by a fixed seed.

    However early a run is cut off, it has seen all families and difficulties alike. The order of
    two episodes is always the same, whatever else is planned; an episode's conditions stay
    together.
    """
    return tuple(sorted(plan, key=lambda item: _lot(item.episode)))


def take_shard(plan: Sequence[WorkItem], shard: tuple[int, int]) -> tuple[WorkItem, ...]:
    """Return the rollouts of one shard, in the order of the plan.

    Shards take episodes in turn from the shuffled order, with all their conditions: no two have
    one in common, together they are the plan, and they differ by one episode at most.

    Args:
        plan: The whole plan.
        shard: Which shard, from 1, and of how many.
    """
    number, of = shard
    mine = set(sorted({item.episode for item in plan}, key=_lot)[number - 1 :: of])
    return tuple(item for item in plan if item.episode in mine)


def _lot(episode: EpisodeId) -> bytes:
    return hashlib.sha256(str(episode).encode()).digest()


def _spans(numbers: Sequence[int]) -> str:
    """Write numbers as `parse_episodes` reads them."""
    spans: list[list[int]] = []
    for number in numbers:
        if spans and spans[-1][1] == number - 1:
            spans[-1][1] = number
        else:
            spans.append([number, number])
    return ",".join(f"{a}-{b}" if a < b else str(a) for a, b in spans)
