"""The possible answers of RoboMME's own episodes, as two episodes of each family recorded them."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.messages import raises

from robomme_interference_data.build_dataset.questions import planned_questions
from robomme_interference_data.constants import DEMONSTRATIONS
from robomme_interference_data.errors import FormatError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.simulators.robomme.recorded_scene import read_scene
from robomme_interference_data.simulators.robomme.scenes import OfficialScene

# What RoboMME 0.1.0 (commit 598e3b4) recorded; `moments` are runs of equal tasks: first step,
# number of frames, task, whether hidden things are visible.
_GOLDEN = Path(__file__).parents[1] / "golden" / "robomme" / "scenes.json"
RECORDED = {one["episode"]: one for one in json.loads(_GOLDEN.read_text())}
ALL = pytest.mark.parametrize("episode", RECORDED)


def scene_of(episode: str) -> OfficialScene:
    recorded = RECORDED[episode]
    text = json.dumps(recorded["scene"])
    return read_scene(episode.partition("/")[0], text, recorded["difficulty"])


def evidence(episode: str) -> list[tuple[Any, ...]]:
    rows = [
        (first + n, task, revealed)
        for first, count, task, revealed in RECORDED[episode]["moments"]
        for n in range(count)
    ]
    spans = scene_of(episode).evidence(np.array(rows, np.int64))
    return [(span.part, span.text, span.start, span.stop) for span in spans]


@pytest.mark.parametrize(
    ("episode", "answer", "count"),
    [
        ("VideoUnmask/test/0", (0,), 3),
        ("VideoUnmask/test/3", (0, 1), 5 * 4),  # two of the five containers, in order
        ("VideoUnmaskSwap/test/0", (1, 0), 3 * 2),
        ("VideoUnmaskSwap/test/3", (2, 0), 4 * 3),
        ("VideoRepick/test/0", 2, 3),
        ("VideoRepick/test/3", 12, 15),
        ("VideoPlaceButton/test/3", 0, 4),
        ("VideoPlaceOrder/test/0", 2, 4),
        ("MoveCube/test/0", "grasp_putdown", 3),
        ("InsertPeg/test/0", (0, "near", "left"), 3 * 2 * 2),
        # Three moves on nine buttons from the middle of an edge: 9 by way of each corner beside
        # it, 13 by each other edge, 16 by the middle.
        ("PatternLock/test/0", (5, 4, 6, 7), 2 * 9 + 2 * 13 + 16),
        # Easy routes do not turn back but at the ends: 2-1-0-1 and 2-3-4-3, each move either way.
        ("RouteStick/test/0", None, 2 * 2**3),
    ],
)
def test_answers(episode: str, answer: Any, count: int) -> None:
    scene = scene_of(episode)
    assert answer in (None, scene.own_answer(0))
    assert len(scene.answers) == len(set(scene.answers)) == count


def test_evidence_is_where_the_lesson_shows_the_answer() -> None:
    # Containers cover the cubes after 32 steps, and swap from step 64 for 50 steps each.
    assert evidence("VideoUnmaskSwap/test/3") == [
        (0, "shows the green cube at place 2 and the blue cube at place 0", 0, 32),
        (1, "those at places 0 and 3 change places", 64, 114),
        (2, "those at places 2 and 3 change places", 114, 164),
        (3, "those at places 0 and 3 change places", 164, 214),
    ]
    # From the way to the target until the cube is picked up again; then two targets swap.
    assert evidence("VideoPlaceButton/test/3") == [
        (0, "puts the cube on target 0 before the button is pressed", 112, 282),
        (1, "puts the cube on target 1 after the button is pressed", 371, 475),
        (2, "those at places 0 and 2 change places", 682, 732),
    ]
    # The way to the first button is not recorded: the lesson begins with the first move.
    assert evidence("PatternLock/test/0") == [
        (0, "moves right", 0, 24),
        (1, "moves forward-right", 24, 62),
        (2, "moves left", 62, 86),
    ]
    assert evidence("MoveCube/test/0") == [(0, "grasps the cube", 0, 186)]  # then it rests


@ALL
def test_all_parts_together_tell_the_answer(episode: str) -> None:
    scene, spans = scene_of(episode), evidence(episode)
    known = {part: text for part, text, _, _ in spans}
    own = scene.own_answer(0)
    assert tuple(known[part] for part in sorted(known)) == scene.parts(own)
    assert scene.agreeing(known) == [own]
    assert scene.agreeing({}) == list(scene.answers)
    assert scene.option(scene.choice(own)).words or scene.option(scene.choice(own)).marks


@given(episode=st.sampled_from(list(RECORDED)), data=st.data())
def test_more_known_parts_never_allow_more_answers(episode: str, data: st.DataObject) -> None:
    scene = scene_of(episode)
    parts = dict(enumerate(scene.parts(scene.own_answer(0))))
    more = data.draw(st.sets(st.sampled_from(sorted(parts))))
    fewer = data.draw(st.sets(st.sampled_from(sorted(more)))) if more else set()
    left = [set(scene.agreeing({part: parts[part] for part in one})) for one in (fewer, more)]
    assert scene.own_answer(0) in left[1] and left[1] <= left[0]


def test_moves_are_in_robommes_words() -> None:
    for episode in ("PatternLock/test/0", "PatternLock/test/3"):
        scene = scene_of(episode)
        names = [name for name, shown in scene.facts["tasks"] if shown and name != "NO RECORD"]
        texts = scene.answer_texts(scene.own_answer(0))
        assert [text.replace("moves", "move", 1) for text in texts] == names


def test_a_swap_that_was_missed_leaves_other_places() -> None:
    # Three cubes; cube 2 was lifted, then those at 0 and 2 change places: it ends at place 0.
    scene = scene_of("VideoRepick/test/0")
    assert scene.choice(2) == 0
    # Without the swap it may have stayed at 2 (0 and 1 swapped), or be at 0 or 1.
    assert scene.agreeing({0: "lifts cube 2"}) == [0, 1, 2]
    # With the swap alone, nothing is known of the cube.
    assert scene.agreeing({1: "those at places 0 and 2 change places"}) == [0, 1, 2]


def test_some_parts_leave_some_answers() -> None:
    peg = scene_of("InsertPeg/test/0")
    assert len(peg.agreeing({0: "picks up peg 0 by the near end"})) == 2
    assert len(peg.agreeing({1: "inserts it from the left side"})) == 6
    # Two placements on four targets, 3 and then 1; those at places 2 and 3 swap afterwards.
    order = scene_of("VideoPlaceOrder/test/3")
    parts = dict(enumerate(order.parts(order.own_answer(0))))
    assert len(parts) == 3
    del parts[order.facts["asked"]]
    assert len(order.agreeing(parts)) == 3  # not on the target of the other placement


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[:-1],
        lambda text: text.replace('"answer"', '"answers"'),
        lambda text: text.replace('"answer": 2', '"answer": 7'),
        lambda text: "[]",
        lambda text: "[" * 60_000,
    ],
)
def test_a_damaged_scene_is_an_error(damage: Any) -> None:
    text = json.dumps(RECORDED["VideoRepick/test/0"]["scene"])
    with raises(FormatError):
        read_scene("VideoRepick", damage(text), "easy")
    with raises(FormatError):
        read_scene("StopCube", text, "easy")


@pytest.mark.parametrize(
    ("family", "facts"),
    [
        # Orders of 60 containers, paths over 25 buttons, 4^24 routes, and 300^3 series of swaps.
        ("VideoUnmask", {"answer": [0], "colors": "r" * 60}),
        ("PatternLock", {"answer": list(range(25))}),
        ("RouteStick", {"answer": [[n % 2 for n in range(25)], ["clockwise"] * 24]}),
        ("VideoRepick", {"answer": 3, "swaps": [[0, 1, 2, 3]] * 3}),
    ],
)
def test_a_scene_with_endless_answers_is_an_error(family: str, facts: dict[str, Any]) -> None:
    text = json.dumps({"points": [[1, 2]] * 25, "tasks": [], "swaps": []} | facts)
    with raises(FormatError):
        read_scene(family, text, "hard")


def test_questions_about_official_lessons() -> None:
    def query(episode: EpisodeId) -> Any:
        one = RECORDED[str(episode)]
        record = SimpleNamespace(scene=json.dumps(one["scene"]), ability=None)
        metadata = {"simulator": "robomme", "seed": 7, "difficulty": one["difficulty"]}
        return SimpleNamespace(episode_id=episode, record=record, **metadata)

    episodes = [EpisodeId.parse(name) for name in RECORDED]
    datasets = {DEMONSTRATIONS: SimpleNamespace(identity=SimpleNamespace(revision="r"))}
    queries = SimpleNamespace(episode_ids=episodes, query=query, datasets=datasets)
    made = [question for question, _ in planned_questions(queries)]  # type: ignore[arg-type]
    assert {str(one.episode_id) for one in made} == set(RECORDED)
    for question in made:
        scene = scene_of(str(question.episode_id))
        choices = [scene.choice(scene.answers[number]) for number in question.answers]
        assert 3 <= len(set(choices)) == len(choices) <= 5
        assert choices[question.right] == scene.choice(scene.own_answer(0))
        options = list(zip(question.options, question.points, strict=True))
        assert len(set(options)) == len(options)  # words and places distinguish them
        for points in question.pixels:
            assert all(0 <= y < 256 and 0 <= x < 256 for y, x in points)
