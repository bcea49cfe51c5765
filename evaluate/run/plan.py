"""The plan of a run: which rollouts or questions, and in which order."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

from robomme_interference_data.errors import InvalidOptionError, UnknownNameError, named
from robomme_interference_data.evaluate.systems import SystemFacts
from robomme_interference_data.ids import EpisodeId, count_numbers, format_numbers, parse_numbers
from robomme_interference_data.schema.conditions import NO_HISTORY, in_order, parse_condition
from robomme_interference_data.schema.rollouts import RolloutKey
from robomme_interference_data.schema.shard import Shard, shuffle_key
from robomme_interference_data.storage.text import canonical_json

if TYPE_CHECKING:  # readers of rows need neither
    from robomme_interference_data.data.buffer_set import BufferSet

    from .config import WorkConfig


@dataclass(frozen=True)
class WorkItem:
    """One rollout or question: the key of its row within a run; sorts by episode and condition."""

    condition: str
    episode: EpisodeId

    def __post_init__(self) -> None:
        parse_condition(self.condition)

    @classmethod
    def of(cls, row: RolloutKey) -> Self:
        """Return the work item of a row."""
        return cls(row.condition, row.episode_id)

    def __str__(self) -> str:
        return f"{self.episode} under {self.condition}"

    @property
    def key(self) -> str:
        """Its text in columns and files, such as `MoveCube/test/3 k7`."""
        return f"{self.episode} {self.condition}"

    @property
    def file_name(self) -> str:
        """Stem of the names of its own files, such as `MoveCube_test_3_k7`."""
        return f"{str(self.episode).replace('/', '_')}_{self.condition}"

    @property
    def clip(self) -> str:
        """Path of its clip inside the run's folder."""
        return f"videos/{self.file_name}.mp4"

    @property
    def page(self) -> str:
        """Path of the page of its buffer, beside the clip."""
        return f"videos/{self.file_name}.html"

    def transcript(self, folder: str, lines: Iterable[Mapping[str, Any]]) -> tuple[str, bytes]:
        """Return path and bytes of what models were asked and answered."""
        text = "".join(canonical_json(dict(line)) + "\n" for line in lines)
        return f"{folder}/{self.file_name}.jsonl", text.encode("utf-8", "backslashreplace")

    def __lt__(self, other: "WorkItem") -> bool:
        first, second = (
            (item.episode.sort_key, parse_condition(item.condition).sort_key)
            for item in (self, other)
        )
        return first < second


@dataclass(frozen=True)
class RunPlan:
    """The planned rollouts, as `run.json` has them.

    Attributes:
        episodes: Family and split of the query episodes, such as `MoveCube/test`, to their
            numbers, such as `0-49`.
        conditions: Names of the conditions.
        shard: The part to run: `2/8` is the second of eight.
    """

    episodes: dict[str, str]
    conditions: tuple[str, ...]
    shard: str = "1/1"

    def __post_init__(self) -> None:
        # Without listing the rollouts: a file may have plans of millions.
        Shard.parse(self.shard)
        in_order(self.conditions)
        for group, numbers in self.episodes.items():
            EpisodeId.parse(f"{group}/0")
            count_numbers(numbers)

    @property
    def most(self) -> int:
        """Upper bound of the rollouts of all shards; exact unless a number occurs twice."""
        return len(self.conditions) * sum(map(count_numbers, self.episodes.values()))

    def items(self) -> tuple[WorkItem, ...]:
        """Return the rollouts of the shard in canonical order: by episode and condition."""
        known = [
            EpisodeId.parse(f"{group}/{index}")
            for group, numbers in self.episodes.items()
            for index in parse_numbers(numbers)
        ]
        episodes = sorted(Shard.parse(self.shard).share(known, lambda episode: episode))
        names = [condition.name for condition in in_order(self.conditions)]
        return tuple(WorkItem(name, episode) for episode in episodes for name in names)


def plan_run(config: "WorkConfig", facts: SystemFacts, buffer_set: "BufferSet") -> RunPlan:
    """Return the plan of a run of a system, and check the tables of its conditions.

    Raises:
        UnknownNameError, InvalidOptionError: Settings name episodes that do not exist, or a
            condition that does not apply to the system.
        HashMismatchError: A table of the buffer set does not have its recorded hash.
    """
    conditions = config.conditions or tuple(
        name for name in buffer_set.conditions if facts.applies(name)
    )
    if not conditions:  # no planned one applies; raises
        _check_condition(facts, buffer_set.conditions[0], buffer_set)
    plan = _plan(config, buffer_set, conditions)
    for condition in plan.conditions:
        _check_condition(facts, condition, buffer_set)
    buffer_set.check_tables(plan.conditions)
    return plan


def check_episodes(config: "WorkConfig", buffer_set: "BufferSet") -> None:
    """Check that the episodes and conditions of a run exist, whatever its system is."""
    _plan(config, buffer_set, config.conditions or tuple(buffer_set.conditions))


def _plan(config: "WorkConfig", buffer_set: "BufferSet", conditions: tuple[str, ...]) -> RunPlan:
    return plan_work(
        buffer_set.episodes_under(conditions),
        conditions=conditions,
        families=config.families,
        episodes=config.episodes,
        split=config.split,
        shard=config.shard,
    )


def nothing_to_retrieve(hint: str) -> InvalidOptionError:
    """Return the error for a retrieval step without a history."""
    return InvalidOptionError(
        f"a retrieval step has nothing to retrieve from under {NO_HISTORY}", hint
    )


def _check_condition(facts: SystemFacts, condition: str, buffer_set: "BufferSet") -> None:
    """Reject a condition that does not apply to a system."""
    if facts.applies(condition):
        return
    if condition == NO_HISTORY:
        raise nothing_to_retrieve(
            f"Leave {NO_HISTORY} out of {named('conditions')}: without history, the system is the "
            "one without a retrieval step."
        )
    fault = f"the system takes no history, so {condition} has no effect"
    if NO_HISTORY in buffer_set.conditions:
        raise InvalidOptionError(fault, f"Set {named('conditions')} to {NO_HISTORY}.")
    raise InvalidOptionError(
        fault,
        f"It runs under {NO_HISTORY}, which is not planned yet.",
        buffer_set.planning(NO_HISTORY),
        "conditions",
    )


def plan_work(
    known: Iterable[EpisodeId],
    *,
    conditions: Iterable[str],
    families: Sequence[str] = (),
    episodes: str | None = None,
    split: str = "test",
    shard: str = "1/1",
) -> RunPlan:
    """Return the plan of a run over a buffer set's query episodes, `known`; see `RunConfig`."""
    episode_ids = sorted(known)
    available: dict[str, list[int]] = {episode.family: [] for episode in episode_ids}
    for episode in episode_ids:
        if episode.split == split:
            available[episode.family].append(episode.index)
    for family in families:
        if family not in available:
            raise UnknownNameError.among("family", family, "the buffer set", available)
    selected = None if episodes is None else parse_numbers(episodes)
    planned = {}
    for family in [name for name in available if not families or name in families]:
        numbers, group = available[family], f"{family}/{split}"
        missing = sorted(set(selected or ()) - set(numbers))
        if missing or (families and not numbers):
            raise UnknownNameError(
                f"the buffer set has no query episode {group}/{(missing or [0])[0]}"
                + (f" and {len(missing) - 1} more" if len(missing) > 1 else ""),
                f"Its episodes of {group} are {format_numbers(numbers) or 'none'}; see "
                f"{named('split')}.",
            )
        if numbers:
            planned[group] = format_numbers(selected or numbers)
    names = tuple(condition.name for condition in in_order(conditions))
    if not planned:
        splits = sorted({episode.split for episode in episode_ids})
        raise InvalidOptionError(
            f"the buffer set has no {split} episode to run",
            f"Set {named('split')} to one of {', '.join(splits)}.",
        )
    return RunPlan(planned, names, shard)


def shuffle_work(items: Iterable[WorkItem]) -> tuple[WorkItem, ...]:
    """Return rollouts in the order in which they run: shuffled by episode, always the same order.

    A run that stops early has covered all families and difficulties evenly, and each episode under
    all of its conditions.
    """
    return tuple(sorted(items, key=lambda item: shuffle_key(item.episode)))
