"""The work of a run: what is asked for, in canonical order."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data.errors import InvalidIdError, InvalidOptionError, UnknownNameError
from robomme_interference_data.evaluate.plan import (
    WorkItem,
    parse_episodes,
    parse_shard,
    plan_work,
    select_families,
    shuffle_work,
    take_shard,
)
from robomme_interference_data.ids import EpisodeId

KNOWN = [EpisodeId(f, "test", i) for f in ("MoveCube", "RouteStick") for i in (0, 1, 2, 5)]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0", (0,)),
        ("0-3", (0, 1, 2, 3)),
        ("3,0", (0, 3)),
        ("0,2-4,3,10", (0, 2, 3, 4, 10)),
        (" 1 , 2 ", (1, 2)),
        ("7-7", (7,)),
    ],
)
def test_episodes(text: str, expected: tuple[int, ...]) -> None:
    assert parse_episodes(text) == expected


@pytest.mark.parametrize("text", ["", "a", "3-1", "1-", "-1", "1,,2", "1.5", "0-49 k0"])
def test_what_is_no_episodes(text: str) -> None:
    with pytest.raises(InvalidOptionError, match="is not a number or a span"):
        parse_episodes(text)


@given(st.sets(st.integers(0, 300), min_size=1))
def test_episodes_are_read_back(numbers: set[int]) -> None:
    assert parse_episodes(",".join(str(n) for n in numbers)) == tuple(sorted(numbers))


def test_families_are_in_the_splits_order() -> None:
    known = ("VideoRepick", "MoveCube", "RouteStick")
    assert select_families(["all"], known) == known
    assert select_families(["RouteStick", "VideoRepick"], known) == ("VideoRepick", "RouteStick")
    with pytest.raises(UnknownNameError, match=r"'MoveCub' is not in the split") as raised:
        select_families(["MoveCub"], known)
    assert raised.value.hint == "Did you mean 'MoveCube'?"


def test_the_order_keeps_an_episodes_conditions_together() -> None:
    plan = plan_work(
        KNOWN,
        episode_split="test",
        families=("MoveCube",),
        episodes=(0, 5),
        conditions=("k7", "no-history", "k0", "k7"),
    )
    first, second = EpisodeId("MoveCube", "test", 0), EpisodeId("MoveCube", "test", 5)
    assert plan == tuple(
        WorkItem(condition, episode)
        for episode in (first, second)
        for condition in ("no-history", "k0", "k7")
    )
    assert [item.k for item in plan[:3]] == [None, 0, 7]


@given(st.permutations(KNOWN), st.permutations(["k0", "k3", "no-history"]))
def test_the_order_of_input_does_not_matter(known: list[EpisodeId], conditions: list[str]) -> None:
    def plan(known: list[EpisodeId], conditions: list[str]) -> tuple[WorkItem, ...]:
        return plan_work(
            known,
            episode_split="test",
            families=("MoveCube", "RouteStick"),
            episodes=(0, 2),
            conditions=conditions,
        )

    assert plan(known, conditions) == plan(KNOWN, ["no-history", "k0", "k3"])


@pytest.mark.parametrize(
    ("changes", "message", "hint"),
    [
        (
            {"episodes": (0, 3, 4)},
            "no query episode MoveCube/test/3 and 1 more",
            "It has 0-2,5 of MoveCube/test",
        ),
        ({"episodes": (6,)}, "no query episode MoveCube/test/6$", "It has 0-2,5"),
        ({"episode_split": "val"}, "no query episode MoveCube/val/0", "It has no val episode"),
    ],
)
def test_missing_episodes_are_named(changes: dict[str, object], message: str, hint: str) -> None:
    options: dict[str, object] = {"episode_split": "test", "episodes": (0,)} | changes
    with pytest.raises(UnknownNameError) as raised:
        plan_work(KNOWN, families=("MoveCube",), conditions=("k0",), **options)  # type: ignore[arg-type]
    import re

    assert re.search(message, raised.value.message)
    assert raised.value.hint is not None and hint in raised.value.hint


def test_an_unknown_condition_is_refused() -> None:
    with pytest.raises(InvalidIdError, match="'k64' is not a condition"):
        plan_work(
            KNOWN,
            episode_split="test",
            families=("MoveCube",),
            episodes=(0,),
            conditions=("k0", "k64"),
        )


# --- shards ------------------------------------------------------------------------------------


def whole(
    episodes: int, conditions: tuple[str, ...] = ("no-history", "k0", "k7")
) -> tuple[WorkItem, ...]:
    return plan_work(
        [EpisodeId("MoveCube", "test", index) for index in range(episodes)],
        episode_split="test",
        families=("MoveCube",),
        episodes=range(episodes),
        conditions=conditions,
    )


@pytest.mark.parametrize(
    ("text", "expected"), [("1/1", (1, 1)), ("2/8", (2, 8)), (" 8/8 ", (8, 8))]
)
def test_shard(text: str, expected: tuple[int, int]) -> None:
    assert parse_shard(text) == expected


@pytest.mark.parametrize("text", ["", "0/8", "9/8", "2", "2/", "/8", "-1/8", "2/8/1", "a/b"])
def test_what_is_no_shard(text: str) -> None:
    with pytest.raises(InvalidOptionError, match="is not a shard"):
        parse_shard(text)


@given(episodes=st.integers(0, 50), of=st.integers(1, 12))
def test_shards_are_even_and_together_the_plan(episodes: int, of: int) -> None:
    plan = whole(episodes)
    shards = [take_shard(plan, (number, of)) for number in range(1, of + 1)]
    assert sorted((item for shard in shards for item in shard), key=plan.index) == list(plan)
    sizes = [len({item.episode for item in shard}) for shard in shards]
    assert max(sizes) - min(sizes) <= 1
    # An episode's conditions are never apart, and a shard is in the order of the plan.
    assert all(len(shard) == 3 * size for shard, size in zip(shards, sizes, strict=True))
    assert all(list(shard) == sorted(shard, key=plan.index) for shard in shards)


SHUFFLED = [1, 9, 5, 0, 8, 10, 6, 3, 2, 7, 11, 4]


@given(st.permutations(range(12)))
def test_the_shuffle_depends_on_nothing_but_the_episodes(order: list[int]) -> None:
    plan = whole(12, ("k0",))
    shuffled = shuffle_work([plan[index] for index in order])
    assert shuffled == shuffle_work(plan)
    # By the sha256 of "MoveCube/test/0" and so on, worked out apart.
    assert [item.episode.index for item in shuffled] == SHUFFLED
    kept = [item for item in shuffled if item.episode.index % 3]
    assert list(shuffle_work(kept)) == kept  # the order of two never depends on a third
