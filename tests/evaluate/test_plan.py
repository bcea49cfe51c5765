"""The work of a run: in canonical order, in shards, and shuffled."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.messages import raises

from robomme_interference_data.errors import (
    FormatError,
    InvalidIdError,
    InvalidOptionError,
    UnknownNameError,
)
from robomme_interference_data.evaluate.run.plan import RunPlan, WorkItem, plan_work, shuffle_work
from robomme_interference_data.evaluate.run.record import RunHeader
from robomme_interference_data.ids import EpisodeId

KNOWN = [EpisodeId(f, "test", i) for f in ("MoveCube", "RouteStick") for i in (0, 1, 2, 5)]
KNOWN += [EpisodeId("RouteStick", "val", 7)]


def test_a_plan_is_in_canonical_order_and_keeps_an_episodes_conditions_together() -> None:
    plan = plan_work(
        KNOWN, families=["MoveCube"], episodes="5,0", conditions=("k7", "no-history", "k0")
    )
    assert plan == RunPlan({"MoveCube/test": "0,5"}, ("no-history", "k0", "k7"), "1/1")
    episodes = EpisodeId("MoveCube", "test", 0), EpisodeId("MoveCube", "test", 5)
    assert plan.items() == tuple(
        WorkItem(condition, episode)
        for episode in episodes
        for condition in ("no-history", "k0", "k7")
    )
    assert str(plan.items()[2]) == "MoveCube/test/0 under k7"


@given(st.permutations(KNOWN), st.permutations(["k0", "k3", "no-history"]))
def test_the_order_of_input_does_not_matter(known: list[EpisodeId], names: list[str]) -> None:
    assert plan_work(known, conditions=names, episodes="0,2") == plan_work(
        KNOWN, conditions=["no-history", "k0", "k3"], episodes="0,2"
    )


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"episodes": "0,3-4"}, UnknownNameError, "test/3 and 1 more\nIts episodes of MoveCube"),
        ({"split": "val", "families": ["MoveCube"]}, UnknownNameError, "MoveCube/val are none"),
        ({"families": ["MoveCub"]}, UnknownNameError, "Did you mean 'MoveCube'?"),
        ({"split": "train"}, InvalidOptionError, "no train episode"),
        ({"episodes": "3-1"}, InvalidOptionError, "the range 3-1 ends before it begins"),
        ({"conditions": ["k0", "k64"]}, InvalidIdError, "'k64' is not a condition"),
        ({"conditions": ["k0", "k0"]}, InvalidOptionError, "each once"),
        ({"shard": "9/8"}, InvalidOptionError, "shard '9/8'"),
    ],
)
def test_invalid_plans_are_errors(
    changes: dict[str, Any], error: type[Exception], words: str
) -> None:
    with pytest.raises(error) as raised:
        plan_work(KNOWN, **{"conditions": ["k0"]} | changes)
    assert words in str(raised.value)


@pytest.mark.parametrize("text", ["", "0/8", "2/8/1", "a/b"])
def test_invalid_shards_are_errors(text: str) -> None:
    with raises(InvalidOptionError):
        RunPlan({"MoveCube/test": "0"}, ("k0",), text)


def whole(episodes: int, shard: str = "1/1") -> RunPlan:
    names = ("no-history", "k0", "k7")
    return RunPlan({"MoveCube/test": f"0-{episodes - 1}"}, names, shard)


@given(episodes=st.integers(1, 50), of=st.integers(1, 12))
def test_shards_are_even_and_together_the_plan(episodes: int, of: int) -> None:
    plan = whole(episodes).items()
    shards = [whole(episodes, f"{number}/{of}").items() for number in range(1, of + 1)]
    assert sorted((item for shard in shards for item in shard), key=plan.index) == list(plan)
    sizes = [len({item.episode for item in shard}) for shard in shards]
    assert max(sizes) - min(sizes) <= 1
    # An episode's conditions are never apart, and a shard is in the order of the plan.
    assert all(len(shard) == 3 * size for shard, size in zip(shards, sizes, strict=True))
    assert all(list(shard) == sorted(shard) for shard in shards)


@given(st.permutations(range(12)))
def test_the_shuffle_depends_only_on_the_episodes(order: list[int]) -> None:
    plan = RunPlan({"MoveCube/test": "0-11"}, ("k0",)).items()
    shuffled = shuffle_work([plan[index] for index in order])
    assert shuffled == shuffle_work(plan)
    # By the sha256 of "MoveCube/test/0" and so on, worked out apart.
    assert [item.episode.index for item in shuffled] == [1, 9, 5, 0, 8, 10, 6, 3, 2, 7, 11, 4]
    kept = [item for item in shuffled if item.episode.index % 3]
    assert list(shuffle_work(kept)) == kept  # the order of two never depends on a third


def test_the_size_of_plans_is_limited() -> None:
    conditions = tuple(f"k{k}" for k in range(64))
    plans = tuple(RunPlan({"MoveCube/test": f"0-{16_000 + n}"}, conditions) for n in range(2))
    assert plans[0].most == 64 * 16_001
    assert RunHeader(1, {}, "buffer_set", plans[:1]).plans == plans[:1]
    with raises(FormatError):
        RunHeader(1, {}, "buffer_set", plans)
