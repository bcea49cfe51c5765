"""Which episodes and frames a dataset holds."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from recordings import listed

from robomme_interference_data.build_dataset.plan import parse_ranges, plan_dataset, select
from robomme_interference_data.errors import InvalidOptionError, SourceError


def ids(items) -> list[str]:
    return [str(item.episode.id) for item in items]


# --- frames ------------------------------------------------------------------------------------


@pytest.mark.parametrize("length", [249, 250, 256, 257, 1000])
def test_unit_is_every_eighth_of_the_first_256_frames(length: int) -> None:
    plan = plan_dataset("distractors", [[listed("MoveCube/train/0", length=length)]])
    (unit,) = plan.episodes
    # fmt: off
    assert list(unit.indices) == [
        0, 8, 16, 24, 32, 40, 48, 56, 64, 72, 80, 88, 96, 104, 112, 120,
        128, 136, 144, 152, 160, 168, 176, 184, 192, 200, 208, 216, 224, 232, 240, 248,
    ]
    # fmt: on
    assert unit.exec_start_idx is None
    assert plan.skipped == ()


@pytest.mark.parametrize("length", [1, 248])
def test_too_short_for_a_unit(length: int) -> None:
    plan = plan_dataset("distractors", [[listed("MoveCube/train/0", length=length)]])
    assert plan.episodes == ()
    (skipped,) = plan.skipped
    assert (skipped.episode_id, skipped.raw_length) == ("MoveCube/train/0", length)
    assert skipped.reason == f"{length} raw frames; a unit needs 249"


@pytest.mark.parametrize("lesson", [None, 0, 300])
def test_a_unit_does_not_ask_for_a_demonstration(lesson: int | None) -> None:
    plan = plan_dataset("distractors", [[listed("MoveCube/train/0", length=300, lesson=lesson)]])
    assert len(plan.episodes) == 1


def test_demonstration_ends_with_the_first_live_observation() -> None:
    plan = plan_dataset("demonstrations", [[listed("MoveCube/test/0", length=100, lesson=3)]])
    (item,) = plan.episodes
    assert list(item.indices) == [0, 1, 2, 3]
    assert item.exec_start_idx == 3


def test_demonstration_before_the_last_frame_is_the_longest() -> None:
    plan = plan_dataset("demonstrations", [[listed("MoveCube/test/0", length=100, lesson=99)]])
    assert plan.episodes[0].indices == range(100)


@pytest.mark.parametrize(
    ("length", "lesson", "reason"),
    [
        (100, 0, "no demonstration frame"),
        (100, 100, "no live observation after the demonstration"),
        (100, 101, "no live observation after the demonstration"),
    ],
)
def test_demonstration_that_cannot_be_used(length: int, lesson: int, reason: str) -> None:
    plan = plan_dataset(
        "demonstrations", [[listed("MoveCube/test/0", length=length, lesson=lesson)]]
    )
    assert plan.episodes == ()
    assert plan.skipped[0].reason == reason


def test_unmarked_demonstrations_are_refused() -> None:
    with pytest.raises(SourceError, match="MoveCube/test/0: the source does not mark") as raised:
        plan_dataset("demonstrations", [[listed("MoveCube/test/0", lesson=None)]])
    assert "build distractors" in str(raised.value)


@given(length=st.integers(1, 2000), lesson=st.integers(0, 2000))
def test_spans_lie_inside_the_recording(length: int, lesson: int) -> None:
    episode = listed("MoveCube/train/0", length=length, lesson=lesson)
    for kind, frames in (("distractors", 32), ("demonstrations", lesson + 1)):
        plan = plan_dataset(kind, [[episode]])
        assert len(plan.episodes) + len(plan.skipped) == 1
        for item in plan.episodes:
            assert len(item.indices) == frames
            assert item.indices[0] == 0
            assert item.indices[-1] < length
            assert item.exec_start_idx in (None, len(item.indices) - 1)


# --- several episodes and sources ----------------------------------------------------------------


def test_canonical_order_and_source_numbers() -> None:
    one = [listed("PatternLock/train/2"), listed("MoveCube/train/10"), listed("Aaa/train/0")]
    two = [listed("MoveCube/train/9"), listed("MoveCube/test/0"), listed("MoveCube/val/3")]
    plan = plan_dataset("distractors", [one, two])
    assert ids(plan.episodes) == [
        "MoveCube/train/9",
        "MoveCube/train/10",
        "MoveCube/val/3",
        "MoveCube/test/0",
        "PatternLock/train/2",
        "Aaa/train/0",
    ]
    assert [item.source for item in plan.episodes] == [1, 0, 1, 1, 0, 0]


@given(
    names=st.sets(
        st.builds(
            "{}/{}/{}".format,
            st.sampled_from(["MoveCube", "InsertPeg", "Zzz"]),
            st.sampled_from(["train", "val", "test"]),
            st.integers(0, 30),
        ),
        min_size=1,
    ),
    data=st.data(),
)
def test_order_of_episodes_and_sources_does_not_matter(names: set[str], data) -> None:
    episodes = [listed(name, length=240 + len(name)) for name in sorted(names)]
    shuffled = data.draw(st.permutations(episodes))
    cut = data.draw(st.integers(0, len(shuffled)))
    plan = plan_dataset("distractors", [episodes])
    other = plan_dataset("distractors", [shuffled[:cut], shuffled[cut:]])
    swapped = plan_dataset("distractors", [shuffled[cut:], shuffled[:cut]])
    assert ids(other.episodes) == ids(swapped.episodes) == ids(plan.episodes)
    assert other.skipped == swapped.skipped == plan.skipped
    for item in other.episodes:
        assert item.episode in (shuffled[:cut], shuffled[cut:])[item.source]


def test_the_same_episode_in_two_sources() -> None:
    episodes = [listed("MoveCube/train/0"), listed("MoveCube/train/1")]
    with pytest.raises(SourceError, match=r"MoveCube/train/1 is recorded twice .*1.*2") as raised:
        plan_dataset("distractors", [episodes, [listed("MoveCube/train/1", length=300)]])
    assert "--source" in str(raised.value)


def test_the_same_episode_twice_in_a_source() -> None:
    with pytest.raises(SourceError, match="recorded twice"):
        plan_dataset("distractors", [[listed("MoveCube/train/0")] * 2])


@pytest.mark.parametrize(
    ("what", "values"),
    [
        ("cameras", {"cameras": ("front",)}),
        ("cameras", {"size": (48, 48)}),
        ("state values", {"state_size": 7}),
        ("action values", {"action_size": None}),
        ("action values", {"action_size": 7}),
    ],
)
def test_episodes_that_differ_are_refused(what: str, values: dict) -> None:
    with pytest.raises(SourceError, match=f"their {what} differ") as raised:
        plan_dataset(
            "distractors", [[listed("MoveCube/train/0")], [listed("MoveCube/train/1", **values)]]
        )
    assert "MoveCube/train/0 and MoveCube/train/1" in str(raised.value)


def test_episodes_that_are_left_out_may_differ() -> None:
    short = listed("MoveCube/train/1", length=10, cameras=("front",))
    plan = plan_dataset("distractors", [[listed("MoveCube/train/0"), short]])
    assert (len(plan.episodes), len(plan.skipped)) == (1, 1)


def test_order_of_cameras_does_not_matter() -> None:
    one = listed("MoveCube/train/0", cameras=("front", "wrist"))
    other = listed("MoveCube/train/1", cameras=("wrist", "front"))
    assert len(plan_dataset("distractors", [[one, other]]).episodes) == 2


# --- filters ------------------------------------------------------------------------------------

POOL = [
    listed("MoveCube/train/0"),
    listed("MoveCube/train/1"),
    listed("MoveCube/test/0"),
    listed("InsertPeg/train/0"),
    listed("InsertPeg/val/7"),
]


@pytest.mark.parametrize(
    ("filters", "kept"),
    [
        ({}, [0, 1, 2, 3, 4]),
        ({"families": ["MoveCube"]}, [0, 1, 2]),
        ({"families": ["InsertPeg", "MoveCube"]}, [0, 1, 2, 3, 4]),
        ({"split": "train"}, [0, 1, 3]),
        ({"split": "val"}, [4]),
        ({"numbers": frozenset({0, 7})}, [0, 2, 3, 4]),
        ({"numbers": frozenset()}, []),
        ({"families": ["MoveCube"], "split": "train", "numbers": frozenset({1})}, [1]),
        ({"families": ["MoveCube"], "split": "val"}, []),
    ],
)
def test_filters(filters: dict, kept: list[int]) -> None:
    assert select(POOL, **filters) == [POOL[i] for i in kept]


def test_unknown_family() -> None:
    with pytest.raises(InvalidOptionError, match="--families MoveCub: ") as raised:
        select(POOL, families=["MoveCub"])
    assert "Did you mean 'MoveCube'?" in str(raised.value)


def test_unknown_split() -> None:
    with pytest.raises(InvalidOptionError, match="--split 'dev' is none of train, val, test"):
        select(POOL, split="dev")


@pytest.mark.parametrize(
    ("text", "numbers"),
    [
        ("0", {0}),
        ("0-3", {0, 1, 2, 3}),
        ("5-5", {5}),
        ("0,3,10-12", {0, 3, 10, 11, 12}),
        (" 1 , 2-3 ", {1, 2, 3}),
        ("2,1-3,2", {1, 2, 3}),
        ("007", {7}),
    ],
)
def test_ranges(text: str, numbers: set[int]) -> None:
    assert parse_ranges(text) == numbers


@pytest.mark.parametrize(
    "text", ["", " ", "a", "1,", ",1", "-1", "1-", "3-1", "1-2-3", "1.5", "1 2", "²", "1-²", "0x3"]
)
def test_ranges_that_are_none(text: str) -> None:
    with pytest.raises(InvalidOptionError, match="not a list of episode numbers"):
        parse_ranges(text)


@given(st.text(alphabet="0123456789,- ²٣a", max_size=8))
def test_any_text_is_ranges_or_one_clear_error(text: str) -> None:
    try:
        numbers = parse_ranges(text)
    except InvalidOptionError:
        return
    assert numbers
    assert min(numbers) >= 0


@given(st.sets(st.integers(0, 500), min_size=1))
def test_ranges_round_trip(numbers: set[int]) -> None:
    assert parse_ranges(",".join(map(str, numbers))) == numbers
