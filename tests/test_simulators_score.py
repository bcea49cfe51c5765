"""Outcomes, their table, the episodes' seeds and the command line: all without a simulator."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from robomme_interference_data.cli import app
from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.errors import (
    InvalidIdError,
    InvalidOptionError,
    MissingExtraError,
    UnknownNameError,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.simulators import SIMULATORS, Status, make_simulator
from robomme_interference_data.simulators.base import action_array, camera_names
from robomme_interference_data.simulators.registry import own_simulator
from robomme_interference_data.simulators.score import Outcome, markdown_table, play_all
from robomme_interference_data.simulators.tabletop.episodes import (
    difficulty_of,
    episode_ids,
    seed_of,
)


def test_every_episode_has_a_seed_of_its_own() -> None:
    seeds = [seed_of(episode) for episode in episode_ids()]
    assert len(seeds) == 9 * 200
    assert len(set(seeds)) == len(seeds)


@pytest.mark.parametrize(
    ("text", "seed", "difficulty"),
    [
        ("VideoRepick/train/0", 3000, "easy"),
        ("VideoRepick/train/99", 3099, "easy"),
        ("VideoRepick/val/1", 3901, "medium"),
        ("MoveCube/test/3", 19803, "easy"),
        ("RouteStick/test/49", 28849, "medium"),
    ],
)
def test_seeds_and_difficulties_are_fixed(text: str, seed: int, difficulty: str) -> None:
    assert seed_of(EpisodeId.parse(text)) == seed
    assert difficulty_of(seed) == difficulty


def test_a_test_split_has_17_easy_17_medium_and_16_hard_episodes() -> None:
    for family in FAMILIES:
        counts = [len(episode_ids(family, "test", d)) for d in ("easy", "medium", "hard")]
        assert counts == [17, 17, 16]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("MoveCub/test/3", "Did you mean 'MoveCube'"),
        ("MoveCube/test/50", "has the episodes 0 to 49"),
        ("MoveCube/train/100", "has the episodes 0 to 99"),
    ],
)
def test_unknown_episodes_are_named(text: str, message: str) -> None:
    with pytest.raises(UnknownNameError, match=message):
        seed_of(EpisodeId.parse(text))


def test_unknown_split_is_refused() -> None:
    with pytest.raises(InvalidIdError, match="not a split"):
        episode_ids("MoveCube", "tests")


def test_an_unknown_simulator_is_named() -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'tabletop'"):
        make_simulator("tabeltop")
    with pytest.raises(UnknownNameError, match="no_such_module"):
        make_simulator("no_such_module:make")


def test_a_missing_extra_names_the_line_to_type(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    for name in [name for name in sys.modules if ".tabletop." in name and "episodes" not in name]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "sapien", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'robomme-interference-data\[sim\]'"):
        SIMULATORS["tabletop"]()


def outcome(family: str, difficulty: str, status: Status, chance: float, steps: int) -> Outcome:
    return Outcome(EpisodeId(family, "test", 0), difficulty, status, 100, steps, chance)


def test_the_table_counts_by_difficulty_and_leaves_errors_out() -> None:
    table = markdown_table(
        [
            outcome("MoveCube", "easy", Status.SUCCESS, 0.5, 10),
            outcome("MoveCube", "easy", Status.FAIL, 0.5, 20),
            outcome("MoveCube", "hard", Status.TIMEOUT, 0.2, 30),
            outcome("MoveCube", "", Status.ERROR, 0.0, 0),
        ]
    ).splitlines()
    # one of three; chance (0.5 + 0.5 + 0.2)/3
    expected = "| MoveCube | 1/2 | 0/0 | 0/1 | 1/3 | 6.1% – 79.2% | 40.0% | 1 |"
    assert table[2] == expected
    assert table[3] == expected.replace("MoveCube", "all")
    assert len(table) == 4


def double(index: int) -> EpisodeId:
    return EpisodeId("MoveCube", "test", index)


def test_play_all_reports_a_broken_simulator_as_error() -> None:
    outcomes = play_all("oracle", [double(0), double(1)], "simulator_doubles:make")
    good, bad = sorted(outcomes, key=lambda outcome: outcome.episode)
    assert good == Outcome(double(0), "easy", Status.SUCCESS, lesson=5, steps=3, chance=0.25)
    why = "the worker process died (exit code 7)"
    assert bad == Outcome(double(1), "", Status.ERROR, 0, 0, 0.0, why)


def test_play_all_plays_an_episode_again_in_a_fresh_worker(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DOUBLE_MARKS", str(tmp_path))
    episodes = [double(index) for index in (0, 1, 2, 5)]  # 1 dies and 2 hangs, once each
    outcomes = play_all("oracle", episodes, "simulator_doubles:make_once", 2, time_limit=20)
    assert {o.episode: o.status for o in outcomes} == dict.fromkeys(episodes, Status.SUCCESS)


def test_play_all_stops_where_the_simulator_refuses_an_episode() -> None:
    with pytest.raises(UnknownNameError, match="no such episode"):
        list(play_all("oracle", [double(3), double(0)], "simulator_doubles:make"))


def test_a_process_keeps_one_simulator_of_a_name_and_options() -> None:
    kept = own_simulator("simulator_doubles:make")
    assert own_simulator("simulator_doubles:make") is kept
    assert own_simulator("simulator_doubles:make", render=False) is not kept
    front = own_simulator("simulator_doubles:make", cameras=["front"])
    assert own_simulator("simulator_doubles:make", cameras=("front",)) is front


def test_an_option_that_a_simulator_does_not_have_is_named() -> None:
    with pytest.raises(InvalidOptionError, match="robomme simulator has no option 'camera'") as e:
        make_simulator("robomme", camera=("front",))
    assert e.value.hint == "Did you mean 'cameras'?"


def test_cameras_are_a_list_of_known_names() -> None:
    assert camera_names("tabletop", ["wrist", "front"]) == ("front", "wrist")
    assert camera_names("tabletop", ()) == ()
    with pytest.raises(InvalidOptionError, match="cameras 'front'; expected a list of names"):
        camera_names("tabletop", "front")
    with pytest.raises(UnknownNameError, match="tabletop simulator has no camera 'fornt'") as e:
        camera_names("tabletop", ["fornt"])
    assert e.value.hint == "Did you mean 'front'?"


@pytest.mark.parametrize(
    "action", [["a"] * 8, [[1.0], [1.0, 2.0]], None, [0.0] * 7, [0.0] * 7 + [float("nan")]]
)
def test_an_action_is_eight_finite_numbers(action: object) -> None:
    with pytest.raises(InvalidOptionError, match="an action is 8 finite numbers, not ") as e:
        action_array(action)
    assert e.value.hint is not None
    assert e.value.hint.startswith("Expected 7 absolute joint targets in rad")
    assert action_array([1] * 8).dtype == "float32"


def test_simulate_prints_what_came_of_it_as_json() -> None:
    given = ["simulate", "--family", "MoveCube", "--episode", "4", "--json"]
    done = CliRunner().invoke(app, [*given, "--simulator", "simulator_doubles:make"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout) == {
        "episode": "MoveCube/test/4",
        "simulator": "double",
        "goal": "goal",
        "difficulty": "easy",
        "seed": 4,
        "policy": "oracle",
        "status": "success",
        "lesson_frames": 5,
        "steps": 3,
    }


@pytest.mark.parametrize("command", ["simulate", "simulate-score"])
def test_an_unknown_policy_is_refused_at_once(command: str) -> None:
    given = [command, "--policy", "orakle", "--family", "MoveCube"]
    done = CliRunner().invoke(app, given)
    assert isinstance(done.exception, UnknownNameError)
    assert "Did you mean 'oracle'" in str(done.exception)


@pytest.mark.parametrize(
    ("made", "given", "why"),
    [
        ("a", "a/out.mp4", "File exists"),  # `a` is a file
        ("out.mp4/", "out.mp4", "it is a folder"),
    ],
)
def test_a_video_that_cannot_be_written_is_refused_before_playing(
    tmp_path: Path, made: str, given: str, why: str
) -> None:
    if made.endswith("/"):
        (tmp_path / made).mkdir()
    else:
        (tmp_path / made).touch()
    words = ["simulate", "--family", "MoveCube", "--episode", "3", "--video", str(tmp_path / given)]
    done = CliRunner().invoke(app, [*words, "--simulator", "simulator_doubles:make"])
    assert isinstance(done.exception, InvalidOptionError)  # playing would refuse the episode
    assert why in str(done.exception)
    assert "where you may write" in str(done.exception)


def test_a_video_that_can_be_written_leaves_no_trace_of_the_check(tmp_path: Path) -> None:
    given = ["simulate", "--family", "MoveCube", "--video", str(tmp_path / "new" / "out.mp4")]
    done = CliRunner().invoke(
        app, [*given, "--episode", "3", "--simulator", "simulator_doubles:make"]
    )
    assert isinstance(done.exception, UnknownNameError)  # the double has no episode 3
    assert list(tmp_path.rglob("*")) == [tmp_path / "new"]


def test_a_video_must_be_an_mp4(tmp_path) -> None:
    given = ["simulate", "--family", "MoveCube", "--video", str(tmp_path / "out.avi")]
    done = CliRunner().invoke(app, given)
    assert isinstance(done.exception, InvalidOptionError)
