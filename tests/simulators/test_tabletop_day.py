"""The embedded suite at one table: its days are streams without a cut, and exact."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from support.messages import raises

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.errors import SimulatorCrashError, UnknownNameError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.days import DayPlan, PlannedTask, day_id
from robomme_interference_data.schema.records import DaySpan
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.simulators.registry import simulator_class

pytest.importorskip("mani_skill", reason="needs the extra sim")

from robomme_interference_data.simulators import base
from robomme_interference_data.simulators.tabletop import day_simulator
from robomme_interference_data.simulators.tabletop.day import cut_of
from robomme_interference_data.simulators.tabletop.day_simulator import TabletopDaySimulator
from robomme_interference_data.simulators.tabletop.simulator import TabletopSimulator

UNMASK, LOCK = "VideoUnmask/test/0", "PatternLock/test/0"
ABSENT, PRESENT, ORDER = UNMASK, "VideoUnmask/test/1", "VideoUnmask/test/5"
PIECES = "PatternLock/test/2", "RouteStick/test/0"

TASKS = (
    (UNMASK, "lesson", "none", 10),
    (LOCK, "first", "none", 12),
    (None, "idle", "none", 11),
    (LOCK, "second", "light:2", 10),
)


def planned(*tasks: tuple[str | None, str, str, int]) -> DayPlan:
    return DayPlan(
        day_id(8, "test", 0),
        tuple(
            PlannedTask(EpisodeId.parse(episode) if episode else None, part, shift, transition)
            for episode, part, shift, transition in tasks
        ),
        (),
    )


@dataclass
class Played:
    """A day as arrays: images of a camera, `(T, 256, 256, 3)`; states and actions, `(T, 8)`."""

    spans: list[DaySpan]
    images: dict[str, NDArray[np.uint8]]
    states: NDArray[np.float32]
    actions: NDArray[np.float32]


def play(simulator: TabletopDaySimulator, plan: DayPlan) -> Played:
    day = simulator.play_day(plan)
    seen, actions = zip(*day.frames(), strict=True)
    images = {name: np.stack([frame.images[name] for frame in seen]) for name in seen[0].images}
    return Played(day.spans, images, np.stack([frame.state for frame in seen]), np.stack(actions))


@pytest.fixture(scope="module")
def simulator(tabletop: TabletopSimulator) -> Iterator[TabletopDaySimulator]:
    """The simulator; skips where nothing can be drawn."""
    with TabletopDaySimulator() as made:
        yield made


@pytest.fixture
def blind(simulator: TabletopDaySimulator) -> Iterator[TabletopDaySimulator]:
    """It without drawing, which is several times as fast."""
    simulator.env.drawing = False
    yield simulator
    simulator.env.drawing = True


@pytest.fixture(scope="module")
def played(simulator: TabletopDaySimulator) -> Played:
    return play(simulator, planned(*TASKS))


# --- the stream ---------------------------------------------------------------------------------


def test_a_day_is_its_tasks_and_the_transitions_before_them(played: Played) -> None:
    spans = played.spans
    assert [span.start for span in spans] == [0, *(span.stop for span in spans[:-1])]
    assert spans[-1].stop == len(played.states) == len(played.actions)
    assert [span.stop - span.start for span in spans[::2]] == [10, 12, 11, 10]
    assert {(str(span.source), span.part) for span in spans[::2]} == {("Day8/test/0", "transition")}
    assert [(str(span.source), span.part) for span in spans[1::2]] == [
        (UNMASK, "lesson"),
        (LOCK, "first"),
        ("Day8/test/0", "idle"),
        (LOCK, "second"),
    ]
    assert [span.shift for span in spans] == [*["none"] * 6, *["light:2"] * 2]
    assert spans[5].stop - spans[5].start == 32


@pytest.mark.parametrize(("number", "episode"), [(1, UNMASK), (3, LOCK)])
def test_a_task_equals_its_demonstration_bit_for_bit(
    simulator: TabletopDaySimulator, played: Played, number: int, episode: str
) -> None:
    """Of a first piece, all frames until the arm goes home."""
    span = played.spans[number]
    whole = span.part == "lesson"
    lesson, _, _ = simulator.reset(episode, demonstration=whole)
    # Of PatternLock's pieces, the first ends between two buttons: 10 + 57 + 8 frames, then 26 each.
    frames = len(lesson) if whole else 10 + 65 + 26
    at = slice(span.start, span.start + frames)
    assert np.array_equal(played.states[at], lesson.states[:frames])
    assert np.array_equal(played.actions[at], lesson.actions[:frames])
    if whole:
        for name in ("front", "wrist"):
            assert np.array_equal(played.images[name][at], lesson.images[name])
        assert lesson.evidence is not None
        assert [(seen.part, seen.text, seen.start, seen.stop) for seen in span.evidence] == [
            (seen.part, seen.text, span.start + seen.start, span.start + seen.stop)
            for seen in lesson.evidence
        ]


def test_a_look_comes_gradually_while_the_objects_do(played: Played) -> None:
    transition = played.spans[6]
    corner = played.images["front"][transition.start - 1 : transition.stop + 1, 0, 0].astype(int)
    changes = np.diff(corner.sum(axis=1))
    assert abs(changes.sum()) > 30
    assert np.all(changes * np.sign(changes.sum()) >= 0)
    assert abs(changes).max() < 0.4 * abs(changes.sum())


def test_nothing_jumps(simulator: TabletopDaySimulator, played: Played) -> None:
    """Where a transition is slow, the two frames at each of its ends are the same picture."""
    slow = 150
    plan = planned(*((episode, part, "none", slow) for episode, part, _, _ in TASKS))
    tasks = [span.stop - span.start for span in played.spans[1::2]]
    borders = np.cumsum([length for task in tasks for length in (slow, task)])[:-1]
    near = {int(border) + side for border in borders for side in (-1, 0)}
    seen = {}
    for number, (frame, _) in enumerate(simulator.play_day(plan).frames()):
        if number in near:
            seen[number] = {name: image.astype(np.int16) for name, image in frame.images.items()}
        simulator.env.drawing = number + 1 in near
    simulator.env.drawing = True
    for border in borders:
        for name in ("front", "wrist"):
            change = np.abs(seen[border][name] - seen[border - 1][name])
            assert change.mean() < 0.1, (border, name)  # of 255


def test_the_arm_does_not_jump(played: Played) -> None:
    """Neither from frame to frame nor, in a transition, from an action to the next state."""
    assert np.abs(np.diff(played.states, axis=0)).max() < 0.15  # rad
    for span in played.spans[::2]:
        commanded, reached = played.actions[span.start : span.stop], played.states[span.start + 1 :]
        assert np.abs(commanded[:, :7] - reached[: len(commanded), :7]).max() < 1e-5


def test_idle_time_is_an_empty_table(played: Played) -> None:
    span = played.spans[5]
    for frames in played.images.values():
        idle = frames[span.start : span.stop]
        assert (idle == idle[0]).all()
        # The day begins as empty: the first things are not yet in view.
        assert np.abs(frames[0].astype(np.int16) - idle[0]).mean() < 0.1


def test_both_pieces_together_show_every_part(played: Played) -> None:
    first, second = (
        {seen.part: seen.text for seen in played.spans[number].evidence} for number in (3, 7)
    )
    assert len(first | second) == 4
    assert set(first) - set(second) and set(second) - set(first)


def test_the_same_plan_gives_the_same_bytes_after_anything_else(
    simulator: TabletopDaySimulator, played: Played
) -> None:
    """Also after a day that was given up, and an episode."""
    for _ in range(2):
        frames = simulator.play_day(planned(*TASKS)).frames()
        for number, (frame, action) in zip(range(30), frames, strict=False):
            assert np.array_equal(frame.state, played.states[number])
            assert np.array_equal(action, played.actions[number])
            for name, images in played.images.items():
                assert np.array_equal(frame.images[name], images[number])
        frames.close()
        simulator.reset(PRESENT, demonstration=False)


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_tasks_of_all_families_equal_their_demonstrations(
    blind: TabletopDaySimulator, family: str
) -> None:
    episode = f"{family}/test/0"
    day = play(blind, planned((episode, "lesson", "none", 10)))
    lesson, _, _ = blind.reset(episode)
    assert np.array_equal(day.states[10:], lesson.states)
    assert np.array_equal(day.actions[10:], lesson.actions)


@pytest.mark.slow
@pytest.mark.parametrize("episode", PIECES)
def test_pieces_of_all_families_show_every_part(blind: TabletopDaySimulator, episode: str) -> None:
    pieces = [(episode, "second", "none", 10), (episode, "first", "none", 10)]
    day = play(blind, planned(*pieces))
    lesson, _, _ = blind.reset(episode)
    second, first = (
        {seen.part: seen.text for seen in day.spans[number].evidence} for number in (1, 3)
    )
    assert first | second == {seen.part: seen.text for seen in lesson.evidence or ()}
    assert set(second) - set(first) and set(first) - set(second)
    assert max(np.abs(after - before).max() for before, after in pairwise(day.states)) < 0.2


def test_a_demonstration_is_cut_between_two_parts() -> None:
    """Parts 1 and 2 begin in frames 3 and 8."""
    shown = [(), (0,), (0,), (0, 1), (1,), (1,), (1,), (1,), (1, 2), (2,)]
    assert cut_of(shown) == 3  # nearer to the middle, 5, than 8
    assert cut_of(shown[:8]) == 3
    assert cut_of([(0,), *shown[1:], *[(2,)] * 4]) == 8  # the middle is 7


# --- queries ----------------------------------------------------------------------------------


@pytest.fixture
def short(blind: TabletopDaySimulator, monkeypatch: pytest.MonkeyPatch) -> TabletopDaySimulator:
    """A rollout ends after six steps."""
    for module in (base, day_simulator):
        monkeypatch.setattr(module, "MAX_STEPS", 6)
    return blind


def roll_out(
    simulator: TabletopDaySimulator, episode: str, policy: str, known: dict[int, str] | None = None
) -> Status:
    simulator.reset(episode, demonstration=False)
    status = Status.ONGOING
    while status is Status.ONGOING:
        _, status = simulator.step(simulator.act(policy, known), observe=False)
    return status


def test_where_nothing_was_shown_holding_still_is_right(short: TabletopDaySimulator) -> None:
    assert roll_out(short, ABSENT, "recall") is Status.SUCCESS
    assert roll_out(short, PRESENT, "recall") is Status.TIMEOUT
    short.reset(ABSENT, demonstration=False)
    home = np.append(short.env.arm.home_qpos[:7], 1.0).astype(np.float32)
    assert np.array_equal(short.follow_subgoal(short.subgoal()), home)
    statuses = []
    for _ in range(6):
        action = short.act("oracle")
        assert np.array_equal(action, home)
        statuses.append(short.step(action, observe=False)[1])
    assert statuses == [*[Status.ONGOING] * 5, Status.SUCCESS]


def test_where_nothing_was_shown_any_answer_is_wrong(blind: TabletopDaySimulator) -> None:
    assert roll_out(blind, ABSENT, "guess") is Status.FAIL
    scene, right = blind.env.episode, blind.env.answer
    assert roll_out(blind, ABSENT, "recall", dict(enumerate(scene.parts(right)))) is Status.FAIL


def test_the_goal_says_which_lesson_counts_if_the_order_matters(
    blind: TabletopDaySimulator,
) -> None:
    goals = [blind.reset(episode, demonstration=False)[2].goal for episode in (PRESENT, ORDER)]
    assert not goals[0].endswith("time")
    assert goals[1].endswith(", as it was shown the last time")


def test_it_records_the_versions_of_both() -> None:
    day, tabletop = (simulator_class(name).versions() for name in ("tabletop-day", "tabletop"))
    assert day.items() > tabletop.items()
    assert day.keys() - tabletop.keys() == {"tabletop-day"}


def test_what_cannot_be_played(blind: TabletopDaySimulator) -> None:
    with raises(UnknownNameError):
        blind.reset("Day8/test/0")
    with raises(UnknownNameError):
        blind.play_day(planned(("BinFill/test/0", "lesson", "none", 10)))
    with raises(UnknownNameError):
        blind.play_day(planned(("MoveCube/test/50", "lesson", "none", 10)))
    blind.play_day(planned((UNMASK, "lesson", "none", 10)))
    with raises(SimulatorCrashError):
        blind.act("oracle")
