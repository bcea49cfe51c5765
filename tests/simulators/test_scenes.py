"""The layout of all 1,800 scenes of the suite; nothing is simulated or rendered."""

import math
import re
from collections import Counter
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from robomme_interference_data.constants import DIFFICULTIES, FAMILIES
from robomme_interference_data.ids import EpisodeId

pytest.importorskip("mani_skill", reason="needs the extra sim")

from robomme_interference_data.simulators.tabletop.bodies import CUBE, SIDE
from robomme_interference_data.simulators.tabletop.camera import to_pixels
from robomme_interference_data.simulators.tabletop.episodes import (
    EPISODES,
    difficulty_of,
    episode_ids,
    further_ids,
    seed_of,
    turn_of,
)
from robomme_interference_data.simulators.tabletop.families import draw_episode
from robomme_interference_data.simulators.tabletop.families.video_place import RADIUS
from robomme_interference_data.simulators.tabletop.family import TablePoint
from robomme_interference_data.simulators.tabletop.swaps import lanes

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "tabletop.md"


def seeds_of(family: str, split: str | None, difficulty: str | None) -> list[int]:
    episodes = [e for e in episode_ids() if e.family == family and split in (None, e.split)]
    seeds = [seed_of(episode) for episode in episodes]
    return [seed for seed in seeds if difficulty in (None, difficulty_of(seed))]


@cache
def scenes(family: str, split: str | None = None, difficulty: str | None = None) -> list[Any]:
    """Scenes of episodes, each with its hidden answer as `right`."""
    made: list[Any] = []
    for seed in seeds_of(family, split, difficulty):
        scene: Any = draw_episode(family, seed, difficulty_of(seed))
        scene.right = scene.answers[turn_of(seed, len(scene.answers))]
        made.append(scene)
    return made


def test_every_episode_has_a_seed_of_its_own() -> None:
    seeds = [seed_of(episode) for episode in (*episode_ids(), *further_ids())]
    assert len(seeds) == len(set(seeds)) == 9 * (900 + 50 + 50)
    for family in FAMILIES:
        counts = [len(seeds_of(family, "test", difficulty)) for difficulty in DIFFICULTIES]
        assert counts == [17, 17, 16]


def test_seeds_and_difficulties_are_fixed() -> None:
    for text, seed, difficulty in (
        ("VideoRepick/train/99", 3099, "easy"),
        ("VideoRepick/train/899", 3899, "hard"),
        ("VideoRepick/val/1", 3901, "medium"),
        ("RouteStick/test/49", 28849, "medium"),
    ):
        assert seed_of(EpisodeId.parse(text)) == seed
        assert difficulty_of(seed) == difficulty


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_each_answer_occurs_equally_often_to_within_one(family: str) -> None:
    for split, difficulty in product(EPISODES, DIFFICULTIES):
        drawn = scenes(family, split, difficulty)
        counts = Counter(scene.right for scene in drawn)
        each = [counts[answer] for answer in drawn[0].answers]
        assert max(each) - min(each) <= 1
        assert sum(each) == len(drawn)


def test_answers_are_these() -> None:
    """MoveCube's first twelve easy test episodes: fixed, in blocks of three."""
    turns = [turn_of(seed, 3) for seed in seeds_of("MoveCube", "test", "easy")[:12]]
    assert turns == [0, 2, 1, 1, 0, 2, 2, 1, 0, 1, 0, 2]
    assert all(sorted(turns[block : block + 3]) == [0, 1, 2] for block in range(0, 12, 3))


@pytest.mark.slow
@pytest.mark.parametrize("count", [3, 12])
def test_guess_is_independent_of_the_answer(count: int) -> None:
    """Of 1,800 guesses 1,800 / count are right, give or take four standard deviations."""
    seeds = [seed_of(episode) for episode in episode_ids()]
    right = sum(turn_of(seed, count, stream=1) == turn_of(seed, count) for seed in seeds)
    sigma = math.sqrt(1800 * (count - 1)) / count
    assert abs(right - 1800 / count) < 4 * sigma
    guessed = Counter(turn_of(seed, count, stream=1) for seed in seeds)
    assert all(abs(guessed[answer] - 1800 / count) < 4 * sigma for answer in range(count))


@pytest.mark.parametrize("family", FAMILIES)
def test_chance_is_what_the_page_says(family: str) -> None:
    """One divided by the number of possible answers, the same in all test episodes."""
    counts = [
        {len(scene.answers) for scene in scenes(family, "test", difficulty)}
        for difficulty in DIFFICULTIES
    ]
    [told] = re.findall(rf"^\| `{family}` \| .* \| (1/[\d/, ]+) \|$", PAGE.read_text("utf-8"), re.M)
    assert [{int(chance.removeprefix("1/"))} for chance in told.split(", ")] == counts


@pytest.mark.parametrize("family", ["VideoUnmask", "VideoUnmaskSwap"])
@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_containers_with_cubes_are_independent_of_the_answer(family: str, difficulty: str) -> None:
    """Give or take four standard deviations, of one in three, and of one in `count`."""
    drawn = scenes(family, None, difficulty)
    count = len(drawn[0].spots)
    rank: Counter[int] = Counter()  # of the right container among those that hide a cube
    under: Counter[int] = Counter()  # containers of cubes that are not asked for
    for scene in drawn:
        covered = scene.covered(scene.right)
        assert len(set(covered)) == len(scene.colors) == 3
        assert covered[: len(scene.right)] == list(scene.right)
        rank[sorted(covered).index(scene.right[0])] += 1
        under.update(covered[len(scene.right) :])
    for counted, places in ((rank, 3), (under, count)):
        total = sum(counted.values())
        sigma = math.sqrt(total * (places - 1)) / places
        assert all(abs(counted[n] - total / places) < 4 * sigma for n in range(places)), counted


HALF = {"VideoUnmaskSwap": SIDE, "VideoRepick": CUBE / 2, "VideoPlaceOrder": RADIUS}
HALF["VideoPlaceButton"] = RADIUS


def spots_of(scene: Any) -> list[TablePoint]:
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
    """Of three one stays, the right one in a third of the 34 easy train episodes, give or take."""
    for level, difficulty in enumerate(DIFFICULTIES):
        for scene in scenes("VideoUnmaskSwap", None, difficulty):
            assert len(scene.swaps) == level + 1
            stay = [n for n, end in enumerate(ends_of(scene)) if n == end]
            assert len(stay) == (1 if difficulty == "easy" else 0)
    drawn = scenes("VideoUnmaskSwap", "train", "easy")
    stays = sum(scene.right[0] not in scene.swaps[0] for scene in drawn)
    assert abs(stays - 34 / 3) < 2 * math.sqrt(34 * 2) / 3


def apart(one: TablePoint, other: TablePoint) -> float:
    return max(abs(one[0] - other[0]), abs(one[1] - other[1]))


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


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_everything_on_the_table_is_in_view_and_large_enough(family: str) -> None:
    """Every thing where it lies, and where it moves during swaps."""
    spots: list[Any] = []
    for scene in scenes(family):
        for name in ("spots", "posts", "target_spots", "cube_spots"):
            spots += getattr(scene, name, [])
        for name in ("button_at", "box_at", "cube_at", "target_at"):
            spots += [getattr(scene, name)] if hasattr(scene, name) else []
        for pair in getattr(scene, "swaps", []):
            spots += [spot for way in lanes(spots_of(scene), pair, scene.gap) for spot in way]
    points = [*{(float(x), float(y)) for x, y in spots}]
    beside = to_pixels([(x, y + CUBE, 0.0) for x, y in points])
    for (row, column), (_, other) in zip(
        to_pixels([(*p, 0.0) for p in points]), beside, strict=True
    ):
        assert 0 < row < 255 and 0 < column < 255 and other - column >= 10
