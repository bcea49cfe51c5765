"""The evidence in demonstrations, and the answers that agree with a part of it."""

from collections.abc import Iterable
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from support.families import families
from support.messages import raises

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.simulators.tabletop.episodes import difficulty_of, seed_of
from robomme_interference_data.simulators.tabletop.families import draw_episode
from robomme_interference_data.simulators.tabletop.simulator import TabletopSimulator


def drawn(family: str, index: int, split: str = "test") -> Any:
    seed = seed_of(EpisodeId(family, split, index))
    return draw_episode(family, seed, difficulty_of(seed))


def seen(scene: Any, answer: Any, known: Iterable[int]) -> dict[int, str]:
    return {part: scene.parts(answer)[part] for part in known}


@pytest.mark.parametrize("family", families("VideoUnmaskSwap", "RouteStick"))
def test_the_more_is_known_the_fewer_answers_agree(family: str) -> None:
    """With no part all answers agree, with every part one, and the right one always does."""
    for index in range(6):
        scene = drawn(family, index)
        answer = scene.answers[7 * index % len(scene.answers)]
        parts = range(len(scene.parts(answer)))
        assert parts
        assert scene.agreeing({}) == list(scene.answers)
        assert scene.agreeing(seen(scene, answer, parts)) == [answer]
        agreeing = {
            frozenset(known): set(scene.agreeing(seen(scene, answer, known)))
            for count in range(len(parts) + 1)
            for known in combinations(parts, count)
        }
        for known, found in agreeing.items():
            assert answer in found
            for more in parts:
                assert agreeing[known | {more}] <= found


@pytest.mark.parametrize(
    ("family", "index", "known", "left"),
    [
        ("VideoRepick", 0, {0}, 1),
        ("VideoRepick", 2, {0}, 4),  # each of five cubes ends at another place
        ("VideoRepick", 2, {1, 2, 3}, 5),  # the swaps are known, but not which cube was lifted
        ("VideoPlaceButton", 1, {0}, 3),  # of four targets; the goal asks for the other visit
        ("MoveCube", 0, set(), 3),
        ("InsertPeg", 0, {1, 2}, 2),
        ("RouteStick", 0, {1, 2}, 1),  # the first turn implies the start
    ],
)
def test_what_is_left_to_guess(family: str, index: int, known: set[int], left: int) -> None:
    """Counted by hand; `index` of the first easy, medium and hard test episode is 0, 1 and 2."""
    scene = drawn(family, index)
    for answer in scene.answers[:5]:
        if family != "RouteStick" or len(set(answer[0])) == len(answer[0]):
            assert len(scene.agreeing(seen(scene, answer, known))) == left


def test_of_contradicting_parts_the_first_take_precedence() -> None:
    scene = drawn("InsertPeg", 0)  # (peg, end, side)
    one, other = (scene.parts(answer) for answer in ((0, 1, 1), (1, -1, -1)))
    assert scene.agreeing({0: one[0], 1: other[1], 2: other[2]}) == [(0, -1, -1)]
    path = drawn("PatternLock", 0)
    apart = {0: "goes to button 0", 1: "goes to button 15"}  # no path has both
    assert {found[0] for found in path.agreeing(apart)} == {0}
    assert {found[1] for found in path.agreeing(dict(reversed(apart.items())))} == {15}


def test_recall_draws_among_what_is_left() -> None:
    """Of 600 draws 600 / 4 are right, within four standard deviations; more evidence helps."""
    right = fuller = 0
    for seed in range(600):
        scene = drawn("InsertPeg", 0)  # two pegs, two ends, two sides
        answer = scene.answers[seed % 8]
        fewer, more = (scene.recalled(seen(scene, answer, known), seed) for known in ([0], [0, 1]))
        assert fewer[0] == answer[0] and more[:2] == answer[:2]
        right += fewer == answer
        fuller += more == answer
        assert more == answer or fewer != answer
        assert scene.recalled(seen(scene, answer, range(3)), seed) == answer
    assert abs(right - 150) < 4 * (600 * 3 / 16) ** 0.5
    assert abs(fuller - 300) < 4 * (600 / 4) ** 0.5


@pytest.mark.parametrize("index", [0, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "family", ["VideoUnmask", *(pytest.param(one, marks=pytest.mark.slow) for one in FAMILIES)]
)
def test_played_as_computed(blind: TabletopSimulator, family: str, index: int) -> None:
    """With all parts it succeeds; without any, only if the drawn answer is right."""
    env = blind.env
    for known_parts in (True, False):
        blind.reset(f"{family}/test/{index}", demonstration=False)
        scene, answer = env.episode, env.answer
        known = dict(enumerate(scene.parts(answer))) if known_parts else {}
        expected = Status.SUCCESS
        if scene.recalled(known, env.number) != answer:
            expected = Status.FAIL
        assert known_parts <= (expected is Status.SUCCESS)
        status = Status.ONGOING
        while status is Status.ONGOING:
            _, status = blind.step(blind.act("recall", known), observe=False)
        assert status is expected


@pytest.mark.slow
@pytest.mark.parametrize(
    "family", ["VideoUnmask", *(pytest.param(one, marks=pytest.mark.slow) for one in FAMILIES)]
)
def test_a_given_answer_is_carried_out(blind: TabletopSimulator, family: str) -> None:
    """The right one succeeds as the oracle does, step by step; the next one fails."""
    env, ends = blind.env, {}
    for policy, offset in (("oracle", 0), ("answer", 0), ("answer", 1)):
        blind.reset(f"{family}/test/0", demonstration=False)
        answers = env.episode.answers
        number, steps, status = (answers.index(env.answer) + offset) % len(answers), 0, None
        while status in (None, Status.ONGOING):
            _, status = blind.step(blind.act(policy, answer=number), observe=False)
            steps += 1
        ends[policy, offset] = steps, status
    assert ends["answer", 0] == ends["oracle", 0] and ends["oracle", 0][1] is Status.SUCCESS
    assert ends["answer", 1][1] is Status.FAIL


@pytest.mark.slow
def test_only_answers_of_the_scene_are_carried_out(blind: TabletopSimulator) -> None:
    blind.reset("MoveCube/test/0", demonstration=False)
    for number in (None, -1, len(blind.env.episode.answers)):
        with raises(InvalidOptionError):
            blind.act("answer", answer=number)


@pytest.mark.slow
@pytest.mark.parametrize("index", [0, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("family", families("VideoUnmaskSwap", "RouteStick"))
def test_every_part_is_shown_in_the_lesson(
    blind: TabletopSimulator, family: str, index: int
) -> None:
    lesson, _, _ = blind.reset(f"{family}/test/{index}", demonstration=False)
    parts = blind.env.episode.parts(blind.env.answer)
    assert lesson.evidence is not None
    assert {(span.part, span.text) for span in lesson.evidence} == {*enumerate(parts)}
    assert all(span.stop <= len(lesson) for span in lesson.evidence)
    for one, other in combinations(lesson.evidence, 2):  # in order
        assert one.part < other.part and one.start <= other.start


@pytest.mark.slow
@pytest.mark.parametrize("index", [0, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("family", families("VideoRepick"))
def test_a_lesson_reveals_its_answer_in_its_evidence_only(
    blind: TabletopSimulator, family: str, index: int
) -> None:
    """With any answer it is as long, shows the parts in the same frames, and is equal elsewhere."""
    seed = seed_of(EpisodeId(family, "test", index))
    count = len(drawn(family, index).answers)
    lessons = []
    for answer in sorted({0, count // 3, count // 2, count - 1}):
        blind.env.family = family
        _, info = blind.env.reset(seed=seed, options={"answer": answer})
        lessons.append(info["demonstration"])
    first, *others = lessons
    shown = np.zeros(len(first), bool)
    for span in first.evidence:
        shown[span.start : span.stop] = True
    spans = [[(one.part, one.start, one.stop) for one in lesson.evidence] for lesson in lessons]
    assert spans[1:] == spans[:-1]
    for other in others:
        assert len(other) == len(first)
        apart = np.abs(other.states - first.states).max(axis=1)
        assert apart[~shown].max() < 3e-3  # rad
        if family not in ("VideoUnmask", "VideoUnmaskSwap"):  # whose arm is still in the lesson
            assert (apart[shown] > 1e-3).mean() > 0.3
