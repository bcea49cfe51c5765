"""The embedded suite's scenes, all 1,800 of them, as they are drawn: nothing is simulated."""

import math
from collections import Counter
from itertools import product
from typing import Any

import numpy as np
import pytest
from numpy.random import RandomState

from robomme_interference_data.constants import FAMILIES, SPLITS

pytest.importorskip("mani_skill", reason="needs the extra sim")

from robomme_interference_data.simulators.tabletop.episodes import (
    DIFFICULTIES,
    difficulty_of,
    episode_ids,
    guess_of,
    seed_of,
    turn_of,
)
from robomme_interference_data.simulators.tabletop.families import family_class
from robomme_interference_data.simulators.tabletop.families.video_place_button import RADIUS
from robomme_interference_data.simulators.tabletop.kit import CUBE, SIDE
from robomme_interference_data.simulators.tabletop.stage import Spot, exchanges, lanes


def scenes(family: str, split: str | None = None, difficulty: str | None = None) -> list[Any]:
    """Families drawn for episodes, each with `right`, its hidden answer."""
    made: list[Any] = []
    for seed in map(seed_of, episode_ids(family, split, difficulty)):
        scene: Any = family_class(family)(difficulty_of(seed), RandomState(seed))
        scene.right = scene.answers[turn_of(seed, len(scene.answers))]
        made.append(scene)
    return made


# --- answers --------------------------------------------------------------------------------


@pytest.mark.parametrize("family", FAMILIES)
def test_each_answer_occurs_equally_often_to_within_one(family: str) -> None:
    for split, difficulty in product(SPLITS, DIFFICULTIES):
        drawn = scenes(family, split, difficulty)
        counts = Counter(scene.right for scene in drawn)
        each = [counts[answer] for answer in drawn[0].answers]
        assert max(each) - min(each) <= 1
        assert sum(each) == len(drawn)


def test_answers_are_these() -> None:
    """MoveCube's first twelve easy test episodes: fixed, in blocks of three."""
    seeds = [seed_of(e) for e in episode_ids("MoveCube", "test", "easy")][:12]
    turns = [turn_of(seed, 3) for seed in seeds]
    assert turns == [0, 2, 1, 1, 0, 2, 2, 1, 0, 1, 0, 2]
    assert all(sorted(turns[block : block + 3]) == [0, 1, 2] for block in range(0, 12, 3))


@pytest.mark.parametrize("count", [3, 4, 5, 12])
def test_a_guess_tells_nothing_of_the_answer(count: int) -> None:
    """Of 1,800 guesses 1,800 / count are right, give or take four standard deviations."""
    seeds = [seed_of(episode) for episode in episode_ids()]
    assert len(seeds) == 1800
    right = sum(guess_of(seed, count) == turn_of(seed, count) for seed in seeds)
    sigma = math.sqrt(1800 * (count - 1)) / count
    assert abs(right - 1800 / count) < 4 * sigma
    guessed = Counter(guess_of(seed, count) for seed in seeds)
    assert all(abs(guessed[answer] - 1800 / count) < 4 * sigma for answer in range(count))


# --- VideoUnmask -------------------------------------------------------------------------------


@pytest.mark.parametrize("family", ["VideoUnmask", "VideoUnmaskSwap"])
@pytest.mark.parametrize("difficulty", ["medium", "hard"])
@pytest.mark.parametrize("split", SPLITS)
def test_which_containers_hide_a_cube_does_not_tell_which_is_asked_for(
    family: str, difficulty: str, split: str
) -> None:
    """Rules that see all but colours: the first, second and third container that hides a cube."""
    drawn = scenes(family, split, difficulty)
    right: Counter[int] = Counter()
    for scene in drawn:
        covered = scene.covered(scene.right)
        assert len(set(covered)) == len(scene.colours) == 3
        assert covered[: len(scene.right)] == list(scene.right)
        right[sorted(covered).index(scene.right[0])] += 1
    sigma = math.sqrt(len(drawn) * 2) / 3
    for rank in range(3):
        assert abs(right[rank] - len(drawn) / 3) < 3 * sigma, right


@pytest.mark.parametrize("family", ["VideoUnmask", "VideoUnmaskSwap"])
@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_cubes_not_asked_for_lie_under_every_container(family: str, difficulty: str) -> None:
    """Equally often, give or take four standard deviations of a draw of one in `count`."""
    drawn = scenes(family, None, difficulty)
    count = len(drawn[0].spots)
    under = Counter(n for scene in drawn for n in scene.covered(scene.right)[len(scene.right) :])
    total = sum(under.values())
    sigma = math.sqrt(total * (count - 1)) / count
    assert all(abs(under[number] - total / count) < 4 * sigma for number in range(count)), under


# --- things that change places -------------------------------------------------------------------

HALF = {"VideoUnmaskSwap": SIDE, "VideoRepick": CUBE / 2, "VideoPlaceOrder": RADIUS}
HALF["VideoPlaceButton"] = RADIUS


def spots_of(scene: Any) -> list[Spot]:
    return list(scene.spots if hasattr(scene, "spots") else scene.target_spots)


def ends_of(scene: Any) -> list[int]:
    """For each thing, the number of the place where it ends."""
    at = list(range(len(spots_of(scene))))
    for one, other in scene.swaps:
        at[one], at[other] = at[other], at[one]
    return at


@pytest.mark.parametrize("family", ["VideoRepick", "VideoPlaceOrder", "VideoPlaceButton"])
def test_when_hard_everything_that_could_be_asked_for_ends_elsewhere(family: str) -> None:
    for difficulty in ("easy", "medium"):
        assert not any(scene.swaps for scene in scenes(family, None, difficulty))
    for scene in scenes(family, None, "hard"):
        assert all(end != start for start, end in enumerate(ends_of(scene)))


def test_containers_that_change_places_do_not_change_back() -> None:
    for level, difficulty in enumerate(DIFFICULTIES):
        for scene in scenes("VideoUnmaskSwap", None, difficulty):
            assert len(scene.swaps) == level + 1
            stay = [n for n, end in enumerate(ends_of(scene)) if n == end]
            assert len(stay) == (1 if difficulty == "easy" else 0)


def test_of_three_containers_the_one_asked_for_stays_in_a_third_of_the_episodes() -> None:
    """The train split's 34 easy ones: 34 / 3, give or take two standard deviations of 2.7."""
    drawn = scenes("VideoUnmaskSwap", "train", "easy")
    stay = sum(scene.right[0] not in scene.swaps[0] for scene in drawn)
    assert len(drawn) == 34
    assert abs(stay - 34 / 3) < 2 * 2.75


def test_every_thing_can_be_any_of_an_exchange() -> None:
    """Two and two of four; two, and three in a ring, of five."""
    assert exchanges(RandomState(1), 3) == [(0, 2)]
    assert exchanges(RandomState(1), 4) == [(3, 2), (0, 1)]
    assert exchanges(RandomState(1), 5) == [(2, 1), (4, 0), (4, 3)]


def test_a_way_leads_along_its_lane() -> None:
    """Two things 0.2 m apart, a third one 0.01 m further from the arm, lanes 0.1 m off."""
    to, back = lanes([(0.0, -0.1), (0.0, 0.1), (0.01, 0.0)], (0, 1), 0.1)
    assert len(to) == len(back) == 30
    assert to[-1] == (0.0, 0.1)
    assert back[-1] == (0.0, -0.1)
    # Half the time, half the way: 0.11 out of 0.42 m, or 0.1 of 0.4, then along to the middle.
    assert to[14] == pytest.approx((0.11, 0.0))
    assert back[14] == pytest.approx((-0.1, 0.0))


@pytest.mark.parametrize("family", HALF)
def test_nothing_that_moves_comes_within_5_mm_of_anything_else(family: str) -> None:
    """Discs and boxes alike as squares along the table, so rather too wide than too narrow."""
    half = HALF[family]
    for scene in scenes(family):
        now = spots_of(scene)
        others = [(spot, CUBE / 2) for spot in getattr(scene, "cube_spots", [])]
        if hasattr(scene, "button_at"):
            others.append((scene.button_at, 0.035))
        for pair in scene.swaps:
            ways = lanes(now, pair, scene.gap)
            resting = [(s, half) for n, s in enumerate(now) if n not in pair]
            for a, b in zip(*ways, strict=True):
                for mover, (spot, wide) in product((a, b), [*resting, *others]):
                    assert apart(mover, spot) > half + wide + 0.0005, (scene.swaps, pair)
                assert apart(a, b) > 2 * half + 0.005
            for number, way in zip(pair, ways, strict=True):
                now[number] = way[-1]


def apart(one: Spot, other: Spot) -> float:
    return float(np.abs(np.subtract(one, other)).max())
