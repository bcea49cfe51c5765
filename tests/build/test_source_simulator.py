"""A simulator is a source like any other: its episodes are played while they are read."""

import pickle
import sys
from importlib.metadata import version
from typing import Any

import pytest
from support.messages import raises
from support.simulator_doubles import Double

from robomme_interference_data.build_dataset.dataset.frame_selection import (
    select_demonstration,
    select_frames,
)
from robomme_interference_data.build_dataset.plan.episodes import choose_episodes
from robomme_interference_data.build_dataset.sources import Recording, open_source, simulator
from robomme_interference_data.constants import DEMONSTRATIONS, FAMILIES
from robomme_interference_data.errors import (
    InvalidOptionError,
    MissingFileError,
    SimulatorError,
    SourceError,
    UnknownNameError,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.simulators.registry import simulator_renderer
from robomme_interference_data.simulators.tabletop import SUITE_VERSION


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[Double]:
    """The simulators that are made; RoboMME's provides no actions."""
    found: list[Double] = []

    def make(name: str, **options: Any) -> Double:
        found.append(Double(name=name, actions=name == "tabletop", **options))
        return found[-1]

    monkeypatch.setattr(simulator, "make_simulator", make)
    return found


def read(source: Any, cameras: tuple[str, ...] | None = None) -> Recording:
    wanted = EpisodeId("MoveCube", "train", 9)
    (episode,) = (one for one in source.episodes() if one.id == wanted)
    return source.read(episode, cameras)


def test_an_episode_of_the_tabletop(made: list[Double]) -> None:
    source = open_source("tabletop")
    assert source.provenance == {
        "kind": "tabletop",
        "versions": {
            "tabletop": str(SUITE_VERSION),
            "mani-skill": version("mani-skill"),
            "sapien": version("sapien"),
        },
        "renderer": simulator_renderer("tabletop"),
    }
    assert source.time_limit_s == 300  # seconds
    recording = read(source)
    metadata = (recording.seed, recording.difficulty, recording.simulator, recording.exact)
    assert (recording.goals, metadata) == (("goal", "other"), (9, "easy", "tabletop", True))
    frames = list(recording.frames)
    # 5 frames of the lesson, then one before each of the 3 steps; none after the end.
    assert [frame.is_demonstration for frame in frames] == [True] * 5 + [False] * 3
    assert [float(frame.state[0]) for frame in frames] == [0, 1, 2, 3, 4, 10, 11, 12]
    # Each with the action that was taken after it was seen.
    actions = [float(frame.action[0]) for frame in frames if frame.action is not None]
    assert actions == [1, 1, 1, 1, 1, 0, 1, 2]
    assert all((frame.images["front"] == 9).all() for frame in frames)
    assert all((frame.images["wrist"] == 99).all() for frame in frames)
    lesson = list(select_demonstration(read(source).frames))
    assert [float(frame.state[0]) for frame in lesson] == [0, 1, 2, 3, 4, 10]
    assert made[0].executed == 3  # cut without a step


def test_only_every_third_frame_is_drawn(made: list[Double]) -> None:
    frames = list(read(open_source("tabletop", every=3)).frames)
    whole = list(read(open_source("tabletop")).frames)
    assert [sorted(frame.images) for frame in frames] == [
        ["front", "wrist"] if number % 3 == 0 else [] for number in range(8)
    ]
    for one, other in zip(frames, whole, strict=True):
        assert (one.state == other.state).all() and one.is_demonstration == other.is_demonstration
        assert all((one.images[name] == other.images[name]).all() for name in one.images)


@pytest.fixture
def some_robomme_python(monkeypatch: pytest.MonkeyPatch) -> None:
    """An interpreter that is found, and never starts RoboMME."""
    monkeypatch.setenv("ROBOMME_PYTHON", sys.executable)


@pytest.mark.usefixtures("some_robomme_python")
def test_robomme_provides_demonstrations_without_actions(made: list[Double]) -> None:
    source = open_source("robomme")
    assert source.time_limit_s == 1800
    frames = list(read(source).frames)
    assert [frame.is_demonstration for frame in frames] == [True] * 5 + [False] * 3
    assert [frame.action is None for frame in frames] == [True] * 5 + [False] * 3
    lesson = list(select_frames(DEMONSTRATIONS, read(source)))
    assert [frame.action for frame in lesson] == [None] * 6
    assert made[0].options["subgoals"] is False


def test_the_tabletop_under_shifts(made: list[Double]) -> None:
    source = open_source("tabletop", shifted=True)
    assert source.provenance == open_source("tabletop").provenance
    recording = read(source, ("front",))
    frames = list(recording.frames)
    assert (recording.goals, recording.seed) == (("goal", "other"), 9)
    assert [int(frame.images["front"][0, 0, 0]) for frame in frames] == list(range(10, 22))
    assert {(frame.is_demonstration, frame.action, *frame.state) for frame in frames} == {
        (False, None, *[10.0] * 8)
    }
    for other in ("robomme", "sample"):
        with raises(InvalidOptionError):
            open_source(other, shifted=True)


def test_one_simulator_is_kept_for_the_same_cameras(made: list[Double]) -> None:
    source = open_source("tabletop")
    for cameras in (("front",), ("front",), None, ("wrist", "front")):
        for frame in read(source, cameras).frames:
            assert sorted(frame.images) == sorted(cameras or ("front", "wrist"))
    assert [(one.cameras, one.closed) for one in made] == [
        (("front",), True),
        (("front", "wrist"), False),
    ]
    copy = pickle.loads(pickle.dumps(source))  # without the simulator
    source.close()
    assert made[1].closed
    list(read(copy, ("front",)).frames)
    assert len(made) == 3
    with raises(InvalidOptionError):
        read(copy, ("top",))


@pytest.mark.usefixtures("some_robomme_python")
@pytest.mark.parametrize("name", ["tabletop", "robomme"])
def test_episodes(name: str) -> None:
    source = open_source(name)
    ids = [episode.id for episode in source.episodes()]
    assert ids == sorted({*ids})
    held_out = 50 if name == "robomme" else 0
    assert len(choose_episodes([source])) == len(FAMILIES) * (100 + 50 + 50 + held_out)
    named = [one.id.index for _, one in choose_episodes([source], numbers=(99, 100, 899, 900))]
    assert sorted({*named}) == ([99, 100, 899] if name == "tabletop" else [99])
    assert len(named) == len(FAMILIES) * len({*named})
    if name == "robomme":
        chosen = choose_episodes([source], split="heldout", numbers=(0, 49))
        assert [str(one.id) for _, one in chosen[:2]] == [
            "VideoRepick/heldout/0",
            "VideoRepick/heldout/49",
        ]
    else:
        with raises(SourceError):
            choose_episodes([source], split="heldout")


OWN = "support.own_simulators:"


@pytest.mark.parametrize("name", ["Listed", "make_listed"])
def test_a_simulator_of_ones_own_is_a_source(name: str) -> None:
    source = open_source(OWN + name)
    versions = {"Listed": "4"}
    assert source.provenance == {"kind": OWN + name, "versions": versions, "renderer": None}
    listed = [str(episode.id) for episode in source.episodes()]
    assert listed == ["Press/train/0", "Press/train/1", "Press/test/0", "Press/test/1"]
    recording = source.read(source.episodes()[1], None)
    assert (recording.simulator, recording.robot.fps) == ("listed", 20)
    frames = list(recording.frames)
    assert [frame.is_demonstration for frame in frames] == [True] * 5 + [False] * 3
    assert [sorted(frame.images) for frame in frames] == [["top"]] * 8
    copy = pickle.loads(pickle.dumps(source))
    assert [one.images for one in copy.read(source.episodes()[0], ()).frames] == [{}] * 8
    with raises(InvalidOptionError):
        source.read(source.episodes()[0], ("front",))
    with raises(InvalidOptionError):
        open_source(OWN + name, shifted=True)


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        (f"{OWN}make_any", SourceError, "Define the class method `episodes`"),
        (f"{OWN}Played", SourceError, "lists no episodes"),
        (f"{OWN}Blind", SimulatorError, "was to draw top; it drew no camera"),
        (f"{OWN}nothing", UnknownNameError, "'nothing' is not in module"),
        ("__main__:make", InvalidOptionError, "worker processes run another program"),
        ("no_such_module:make", InvalidOptionError, "MODULE:NAME of a simulator of your own"),
        ("frames:make", MissingFileError, "no folder make"),
    ],
)
def test_sources_that_give_no_episode(text: str, error: type[Exception], words: str) -> None:
    with pytest.raises(error) as raised:
        source = open_source(text)
        source.read(source.episodes()[0], None)
    assert words in str(raised.value) + str(getattr(raised.value, "hint", ""))
