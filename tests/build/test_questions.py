"""Questions about the past: fair ones, the same ones every time, with marks where things are."""

import math
import statistics
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.machine import full_disk
from support.messages import raises
from support.tabletop import QUERIES, TABLETOP, copy_tabletop, scene_of

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.question_pictures import picture
from robomme_interference_data.build_dataset.questions import make_questions, planned_questions
from robomme_interference_data.constants import DEMONSTRATIONS, FAMILIES, QUESTIONS_PATH
from robomme_interference_data.data.questions import (
    NOT_SHOWN,
    Question,
    digest_questions,
    read_questions,
)
from robomme_interference_data.errors import BuildError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.simulators.tabletop.camera import SIZE
from robomme_interference_data.simulators.tabletop.episodes import difficulty_of, seed_of
from robomme_interference_data.simulators.tabletop.family import Family
from robomme_interference_data.storage.video.encode import decode_image

GRAY = np.full((SIZE, SIZE, 3), 128, np.uint8)
EPISODES = [
    EpisodeId(family, split, number)
    for family in FAMILIES
    for split in ("val", "test")
    for number in range(50)
]
MANY = ("InsertPeg", "PatternLock", "RouteStick")
"""Families of whose possible answers some are options; of the others all are."""


def buffer_set_of(
    *episodes: EpisodeId, view: Any = GRAY, ability: str | None = None, **changes: Any
) -> Any:
    """A stand-in for a buffer set, with episodes of the suite that were not recorded."""

    def query(episode: EpisodeId) -> Any:
        seed = seed_of(episode)
        known = {"simulator": "tabletop", "seed": seed, "difficulty": difficulty_of(seed)}
        record = SimpleNamespace(scene=None, ability=ability)
        values = known | {"episode_id": episode, "frame": lambda: view, "record": record} | changes
        return SimpleNamespace(**values)

    demonstrations = SimpleNamespace(identity=SimpleNamespace(revision="r"))
    datasets = {DEMONSTRATIONS: demonstrations}
    return SimpleNamespace(episode_ids=episodes, query=query, datasets=datasets)


@dataclass(frozen=True)
class Made:
    """A question, and what was marked in its view."""

    question: Question
    marks: tuple[tuple[tuple[int, int], ...], ...]


def make(*episodes: EpisodeId) -> list[Made]:
    """Make questions without their pictures."""
    return [Made(one, tuple(marks)) for one, marks in planned_questions(buffer_set_of(*episodes))]


@pytest.fixture(scope="module")
def made() -> list[Made]:
    return make(*EPISODES)


def of(made: Iterable[Made], family: str) -> list[Made]:
    return [one for one in made if one.question.episode_id.family == family]


# --- options --------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_the_right_option_is_the_scenes_answer_and_there_once(
    made: list[Made], family: str
) -> None:
    for one in of(made, family):
        question = one.question
        scene, answer = scene_of(question.episode_id)
        choices = [scene.choice(scene.answers[number]) for number in question.answers]
        assert 3 <= len(set(choices)) == len(choices) <= 5
        assert choices[question.right] == scene.choice(answer)
        assert choices.count(scene.choice(answer)) == 1
        shown = list(zip(question.options, one.marks, strict=True))
        assert len(set(shown)) == len(shown)  # text and marks distinguish the options
        assert question.text == scene.question and question.revision == "r"
        possible = {scene.choice(each) for each in scene.answers}
        assert len(choices) == (len(possible) if len(possible) <= 5 else 4)
        assert question.chance == 1 / len(choices)
        assert question.letters == "ABCDE"[: len(choices)]


@pytest.mark.parametrize("family", ["MoveCube", "PatternLock", "VideoUnmask"])
def test_questions_of_days_have_the_option_that_it_was_not_shown(family: str) -> None:
    episode = EpisodeId(family, "test", 3)
    [plain] = make(episode)

    def of_day(ability: str) -> Made:
        [(question, marks)] = planned_questions(buffer_set_of(episode, ability=ability))
        return Made(question, tuple(marks))

    shown, absent = of_day("update"), of_day("absent")
    for one in (shown, absent):
        assert one.question.options == (*plain.question.options, "it was not shown")
        assert one.question.answers == (*plain.question.answers, NOT_SHOWN)
        assert one.question.points == (*plain.question.points, "")
        assert one.marks == plain.marks  # nothing new in the picture
    assert shown.question.right == plain.question.right
    assert absent.question.right == len(plain.question.options)


@pytest.mark.slow
def test_marks_and_their_letters_lie_inside_the_view_and_apart(made: list[Made]) -> None:
    for one in made:
        for y, x in (point for option in one.marks for point in option):
            assert 14 + 7 <= y < SIZE - 7 and 7 <= x < SIZE - 7  # letters are circles of 6.3
        if max(map(len, one.marks)) == 1:
            for [first], [second] in combinations(one.marks, 2):
                assert math.dist(first, second) > 2 * 6.3 + 1


# --- no leaks -------------------------------------------------------------------------------------


def excess(hits: Iterable[tuple[bool, float]]) -> float:
    """Return how many standard deviations above chance hits are: each with its chance."""
    found = list(hits)
    return sum(hit - chance for hit, chance in found) / math.sqrt(
        sum(chance * (1 - chance) for _, chance in found)
    )


def length(option: Any) -> float:
    return sum(math.dist(*pair) for pair in pairwise(option))


def middle(one: Made, number: int) -> float:
    """How far an option's points are from the middle of all options'."""
    if not one.marks[number]:
        return 0
    everywhere = np.mean([point for option in one.marks for point in option], 0)
    return math.dist(np.mean(one.marks[number], 0), everywhere)


def shared(one: Made, number: int) -> int:
    """How many of an option's points, and words, other options have too."""
    others = [place for place in range(len(one.marks)) if place != number]
    points = sum(point in one.marks[place] for point in one.marks[number] for place in others)
    words = one.question.options[number].split()
    return points + sum(
        word in one.question.options[place].split() for word in words for place in others
    )


GUESSERS: dict[str, Callable[[Made, int], Any]] = {
    "the first letter": lambda one, number: number,
    "the smallest answer": lambda one, number: one.question.answers[number],
    "the shortest words": lambda one, number: len(one.question.options[number]),
    "the first words": lambda one, number: one.question.options[number],
    "what is leftmost": lambda one, number: min((x for _, x in one.marks[number]), default=0),
    "what is nearest": lambda one, number: max((y for y, _ in one.marks[number]), default=0),
    "what is in the middle": middle,
    "the shortest path": lambda one, number: length(one.marks[number]),
    "what has most in common with others": shared,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", GUESSERS)
def test_who_sees_no_history_is_right_by_chance(made: list[Made], name: str) -> None:
    """By one rule and by its opposite, over all families and within each."""
    for least in (min, max):
        hits: dict[str, list[tuple[bool, float]]] = {"all": []}
        for one in made:
            places = range(len(one.question.options))
            best = least(GUESSERS[name](one, number) for number in places)
            equal = [number for number in places if GUESSERS[name](one, number) == best]
            if len(equal) == len(places):
                continue  # the rule says nothing
            hit = one.question.right in equal, len(equal) / len(places)
            for group in ("all", one.question.episode_id.family):
                hits.setdefault(group, []).append(hit)
        for group, found in hits.items():
            assert not found or abs(excess(found)) < 3.6, (group, least)  # of 180 one in 18


@pytest.mark.parametrize("family", sorted({*FAMILIES} - {*MANY}))
def test_with_another_answer_only_the_right_place_is_another(
    family: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For every answer of the same scene."""
    for index in range(3):
        found = []
        episode = EpisodeId(family, "test", index)
        for number in range(len(scene_of(episode)[0].answers)):
            monkeypatch.setattr(Family, "own_answer", lambda one, _, n=number: one.answers[n])
            found += make(episode)
        rights = {one.question.right for one in found}
        assert rights == set(range(len(found[0].question.options)))
        assert len({replace(one.question, right=0) for one in found}) == 1
        assert len({one.marks for one in found}) == 1


@pytest.mark.parametrize("family", MANY)
def test_of_many_answers_the_others_are_drawn_alike(family: str) -> None:
    """Every answer of an easy scene is about as often among the wrong options."""
    easy = (EpisodeId(family, "train", number) for number in range(0, 100, 3))
    questions = [one.question for one in make(*easy)]
    wrong = Counter(
        number
        for one in questions
        for place, number in enumerate(one.answers)
        if place != one.right
    )
    count = len(scene_of(questions[0].episode_id)[0].answers)
    share = statistics.fmean([number / (count - 1) for number in wrong.elements()])
    assert abs(share - 0.5) < 4 * math.sqrt(1 / 12 / wrong.total())
    assert len(wrong) > min(count, wrong.total()) * 0.75


# --- determinism and pictures ---------------------------------------------------------------------


def bare(questions: Iterable[Question]) -> list[Question]:
    return [replace(one, picture=b"") for one in questions]


@pytest.mark.slow
def test_the_golden_questions_come_out_again() -> None:
    buffer_set = load_buffer_set(TABLETOP)
    kept, again = read_questions(buffer_set), list(make_questions(buffer_set))
    assert bare(again) == bare(kept.values())
    assert tuple(kept) == QUERIES  # in canonical order
    for one in again:  # another Pillow may draw letters a little otherwise
        before, now = (decode_image(each.picture) for each in (kept[one.episode_id], one))
        assert before.shape == now.shape
        assert np.mean(np.abs(before.astype(int) - now)) < 1


def test_the_digest_is_of_all_that_is_asked() -> None:
    first, second = list(make_questions(buffer_set_of(*QUERIES[:2])))
    digest = digest_questions([first, second])
    assert digest == digest_questions([second, first])
    for changes in ({"picture": b"x"}, {"right": (first.right + 1) % 3}, {"text": "What?"}):
        assert digest_questions([replace(first, **changes), second]) != digest  # type: ignore[arg-type]


def near(image: Any, point: tuple[int, int], way: int = 21) -> Any:
    y, x = point
    return image[y - way : y + way, x - way : x + way]


def test_a_thing_has_its_letter_over_it() -> None:
    one, other = (50, 30), (50, 70)
    view = np.full((80, 100, 3), 200, np.uint8)
    found, turned = (
        picture(view, marks).copy() for marks in ([(one,), (other,)], [(other,), (one,)])
    )
    assert found.shape == (240, 300, 3)
    over = [(3 * (y - 14), 3 * x) for y, x in (one, other)]
    assert (found[150, [90, 210]] == 0).all()  # a line leads down to the thing
    # A letter is the same wherever it stands, and A is not B.
    assert np.array_equal(near(found, over[0]), near(turned, over[1]))
    assert np.array_equal(near(found, over[1]), near(turned, over[0]))
    assert not np.array_equal(near(found, over[0]), near(found, over[1]))
    for y, x in over:
        near(found, (y, x))[...] = 200
        found[y:151, x - 2 : x + 3] = 200
    assert (found == 200).all()  # and nothing else was touched
    assert (view == 200).all()


def test_letters_of_one_thing_stand_side_by_side() -> None:
    view = np.full((80, 100, 3), 200, np.uint8)
    alone = [
        picture(view, [((50, x),) for x in (10, 50, 90)])[108:109, 3 * x] for x in (10, 50, 90)
    ]
    together = picture(view, [((50, 50),)] * 3)
    assert not np.array_equal(*alone[:2])  # the letters differ in their middles
    for x, letter in zip((110, 150, 190), alone, strict=True):
        assert np.array_equal(together[108:109, x], letter)
    assert (together[150, [110, 190]] == 200).all()  # one line leads down to the thing
    assert (together[150, 150] == 0).all()


@pytest.mark.parametrize("changes", [{"simulator": "robomme"}, {"seed": -1}])
def test_only_tabletops_episodes_have_questions(changes: dict[str, Any]) -> None:
    with raises(BuildError):
        list(make_questions(buffer_set_of(EpisodeId("MoveCube", "test", 0), **changes)))


def test_views_of_another_size_are_an_error() -> None:
    wide = np.zeros((240, 320, 3), np.uint8)
    with raises(BuildError):
        list(make_questions(buffer_set_of(EpisodeId("MoveCube", "test", 0), view=wide)))


# --- the command -------------------------------------------------------------------------------


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A copy of the golden buffer set, without its questions."""
    copied = copy_tabletop(tmp_path / "buffer_set")
    (copied / QUESTIONS_PATH).unlink()
    return copied


def test_the_command_makes_them(root: Path, run: Any) -> None:
    code, out, _ = run("build", root, "--only", "questions", "--json")
    assert code == 0 and f'"questions": {len(QUERIES)}' in out
    assert bare(read_questions(load_buffer_set(root)).values()) == bare(
        read_questions(load_buffer_set(TABLETOP)).values()
    )


def test_where_there_is_no_folder(tmp_path: Path, run: Any) -> None:
    """A buffer set on the Hub is not written to, and no folder of its name is made."""
    code, _, err = run("build", tmp_path / "somebody" / "buffer_set", "--only", "questions")
    assert code == 1 and "robomme-interference fetch" in err
    assert not (tmp_path / "somebody").exists()


def test_a_full_disk_leaves_what_was_there(root: Path, run: Any) -> None:
    (root / QUESTIONS_PATH).write_bytes(b"as it was")
    with full_disk(50_000):
        code, _, err = run("build", root, "--only", "questions")
    assert code == 1 and "disk space" in err and "Traceback" not in err
    assert (root / QUESTIONS_PATH).read_bytes() == b"as it was"
    assert len(list(root.iterdir())) == 4
