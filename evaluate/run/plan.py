"""What a run has to do: pure, without files or processes."""

import hashlib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Self

from robomme_interference_data.errors import InvalidOptionError, UnknownNameError
from robomme_interference_data.ids import EpisodeId, count_numbers, format_numbers, parse_numbers
from robomme_interference_data.schema.conditions import in_order, parse_condition
from robomme_interference_data.schema.rollouts import Rollout

_SHARD = re.compile(r"(\d{1,6})/(\d{1,6})")


@dataclass(frozen=True)
class WorkItem:
    """One rollout: within a run, the key of its row.

    They sort in the canonical order, by episode and condition.
    """

    condition: str
    episode: EpisodeId

    def __post_init__(self) -> None:
        parse_condition(self.condition)

    @classmethod
    def of(cls, row: Rollout) -> Self:
        """Return the rollout that a row is of."""
        return cls(row.condition, row.episode_id)

    def __str__(self) -> str:
        return f"{self.episode} under {self.condition}"

    def __lt__(self, other: "WorkItem") -> bool:
        mine, others = (
            (item.episode.sort_key, parse_condition(item.condition).sort_key)
            for item in (self, other)
        )
        return mine < others


@dataclass(frozen=True)
class Plan:
    """Rollouts that were asked for, as `run.json` has them.

    Attributes:
        episodes: Family and split of the query episodes, such as `MoveCube/test`, to their
            numbers, such as `0-49`.
        conditions: Names.
        shard: The part of them that is run: `2/8` is the second of eight.
    """

    episodes: dict[str, str]
    conditions: tuple[str, ...]
    shard: str = "1/1"

    def __post_init__(self) -> None:
        # Without a list of the rollouts: in a file, there may be plans of millions.
        _read_shard(self.shard)
        in_order(self.conditions)
        for group, numbers in self.episodes.items():
            EpisodeId.parse(f"{group}/0")
            count_numbers(numbers)

    @property
    def most(self) -> int:
        """Rollouts of all shards; more, where a number of an episode comes twice."""
        return len(self.conditions) * sum(map(count_numbers, self.episodes.values()))

    def items(self) -> tuple[WorkItem, ...]:
        """Return the rollouts of the shard in canonical order: by episode and condition.

        An episode's conditions follow each other, so that even a run that is cut off compares
        conditions over the same episodes. Shards take episodes in turn from the shuffled order:
        no two have one in common, together they are the plan, and they differ by one at most.
        """
        number, of = _read_shard(self.shard)
        known = [
            EpisodeId.parse(f"{group}/{index}")
            for group, numbers in self.episodes.items()
            for index in parse_numbers(numbers)
        ]
        mine = sorted(sorted(known, key=_lot)[number - 1 :: of])
        names = [one.name for one in in_order(self.conditions)]
        return tuple(WorkItem(name, episode) for episode in mine for name in names)


def _read_shard(text: str) -> tuple[int, int]:
    shard = _SHARD.fullmatch(text)
    if shard is None or not 1 <= int(shard[1]) <= int(shard[2]):
        raise InvalidOptionError.expected(
            "shard", text, "NUMBER/OF, such as 2/8 for the second of eight"
        )
    return int(shard[1]), int(shard[2])


def plan_work(
    known: Iterable[EpisodeId],
    *,
    conditions: Iterable[str],
    families: Sequence[str] = (),
    episodes: str | None = None,
    split: str = "test",
    shard: str = "1/1",
) -> Plan:
    """Return the plan of a run over the query episodes of a buffer set: `known`; see `RunConfig`."""
    there = sorted(known)
    here: dict[str, list[int]] = {episode.family: [] for episode in there}
    for episode in there:
        if episode.split == split:
            here[episode.family].append(episode.index)
    for family in families:
        if family not in here:
            raise UnknownNameError.among("family", family, "the buffer set", here)
    asked = None if episodes is None else parse_numbers(episodes)
    chosen = {}
    for family in [name for name in here if not families or name in families]:
        numbers, group = here[family], f"{family}/{split}"
        missing = sorted(set(asked or ()) - set(numbers))
        if missing or (families and not numbers):
            raise UnknownNameError(
                f"the buffer set has no query episode {group}/{(missing or [0])[0]}"
                + (f" and {len(missing) - 1} more" if len(missing) > 1 else ""),
                f"It has episodes {format_numbers(numbers)} of {group}; `split` asks for others."
                if numbers
                else f"It has none of {group}: see `split`.",
            )
        if numbers:
            chosen[group] = format_numbers(asked or numbers)
    names = tuple(one.name for one in in_order(conditions))
    if not chosen:
        splits = sorted({one.split for one in there})
        raise InvalidOptionError(
            f"there is nothing to run: the buffer set has no {split} episode",
            f"Set `split`; there are {', '.join(splits)}.",
        )
    return Plan(chosen, names, shard)


def shuffle_work(items: Iterable[WorkItem]) -> tuple[WorkItem, ...]:
    """Return rollouts in the order in which they are run: episodes shuffled by a fixed seed.

    However early a run is cut off, it has seen all families and difficulties alike. The order of
    two episodes is always the same, whatever else is planned; an episode's conditions stay
    together.
    """
    return tuple(sorted(items, key=lambda item: _lot(item.episode)))


def _lot(episode: EpisodeId) -> bytes:
    return hashlib.sha256(str(episode).encode()).digest()
