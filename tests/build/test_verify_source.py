"""Recordings that are checked before a build: everything that is wrong, by episode and frame."""

import json
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.lerobot_layouts import write_lerobot
from support.messages import raises
from support.recordings import (
    EPISODES,
    Episode,
    Rows,
    make_episode,
    rows_of,
    write_frames,
    write_images,
    write_table,
)

from robomme_interference_data.build_dataset.dataset.plan import PlannedEpisode
from robomme_interference_data.build_dataset.sources import open_source
from robomme_interference_data.build_dataset.verify.source import (
    CheckTask,
    SourceReport,
    check_sources,
)
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.runtime.executor import Serial

Run = Callable[..., tuple[int, str, str]]


def check(*names: str, cameras: tuple[str, ...] | None = None) -> SourceReport:
    """Check all episodes of sources in this process."""
    sources = tuple(open_source(name) for name in names)
    episodes = [
        PlannedEpisode(number, episode)
        for number, source in enumerate(sources)
        for episode in source.episodes()
    ]
    return check_sources(names, CheckTask(sources, cameras, None), episodes, Serial())


def found(report: SourceReport) -> list[tuple[str | None, int | None]]:
    return [(problem.episode, problem.frame) for problem in report.problems]


def write(folder: Path, episodes: dict[str, Episode]) -> Path:
    """Write a frames folder with images."""
    rows: Rows = []
    for name, episode in episodes.items():
        rows += rows_of(name, episode, fps=10.0)
        for camera, images in episode.images.items():
            write_images(folder / f"images/{camera}/{name}", images)
    write_table(folder, rows)
    return folder


@pytest.mark.parametrize("kind", ["frames", "lerobot"])
def test_recordings_without_a_problem(tmp_path: Path, kind: str) -> None:
    if kind == "frames":
        write_frames(tmp_path, EPISODES)
    else:
        write_lerobot(tmp_path)
    report = check(f"{kind}:{tmp_path}")
    assert report.problems == []
    # 12 + 7 + 9 frames; only the first has both a demonstration and live frames.
    assert (report.episodes, report.frames) == (3, 28)
    assert (report.with_demonstration, report.exact) == (1, 3)
    [(look, count)] = report.looks
    assert count == 3
    assert look.features == {
        "observation.images.front": (16, 24, 3),
        "observation.images.wrist": (16, 24, 3),
        "observation.state": (8,),
        "action": (8,),
    }


def test_every_problem_is_found_with_its_frame(tmp_path: Path) -> None:
    good = make_episode(0, 5, cameras=("front",))
    state = good.state.copy()
    state[2, 1] = np.nan
    state[4, 0] = np.inf
    action = good.action.copy() if good.action is not None else None
    assert action is not None
    action[3, 0] = np.nan
    episodes = {f"Push/train/{number}": good for number in range(6)}
    episodes["Push/train/1"] = replace(good, state=state, action=action)
    write(tmp_path, episodes)
    images = tmp_path / "images/front/Push/train"
    wide = make_episode(1, 1, cameras=("front",), size=(16, 32)).images["front"]
    (images / "2/000003.png").unlink()
    write_images(tmp_path / "wide", wide)
    (tmp_path / "wide/000000.png").rename(images / "2/000003.png")
    data = (images / "3/000001.png").read_bytes()
    (images / "3/000001.png").write_bytes(data[:40])
    (images / "5/000004.png").unlink()
    report = check(f"frames:{tmp_path}")
    assert found(report) == [
        ("Push/train/1", 2),  # two frames of the state
        ("Push/train/1", 3),  # one of the action
        ("Push/train/2", 3),
        ("Push/train/3", 1),
        ("Push/train/5", None),  # an image is missing
    ]
    assert "observation.state of frame 2" in report.problems[0].what
    assert "1 further frame" in report.problems[0].what
    assert "32×16 pixels" in report.problems[2].what
    assert all(problem.source == f"frames:{tmp_path}" for problem in report.problems)
    assert all(problem.hint for problem in report.problems[:3])
    assert report.frames == 5 + 5 + 5 + 1 + 5 + 0


def test_episodes_that_the_list_shows_to_be_wrong(tmp_path: Path) -> None:
    """The others are read all the same."""
    episode = make_episode(0, 3, cameras=("front",))
    write(tmp_path, {f"Push/train/{number}": episode for number in range(3)})
    rows = [
        row for number in range(3) for row in rows_of(f"Push/train/{number}", episode, fps=10.0)
    ]
    rows[4]["goal"] = "another"
    rows[7]["frame_index"] = 5
    write_table(tmp_path, rows)
    report = check(f"frames:{tmp_path}")
    assert found(report) == [("Push/train/1", None), ("Push/train/2", None)]
    assert (report.episodes, report.frames, report.exact) == (3, 3, 1)


def test_episodes_that_differ_from_most_others(tmp_path: Path) -> None:
    usual = make_episode(0, 3, cameras=("front",))
    other = make_episode(1, 3, cameras=("front",), size=(20, 24))
    episodes = {f"Push/train/{number}": usual for number in range(4)}
    episodes["Push/train/0"] = other
    episodes["Push/train/2"] = replace(usual, state=usual.state[:, :7].copy())
    write(tmp_path, episodes)
    report = check(f"frames:{tmp_path}")
    assert found(report) == [("Push/train/0", None), ("Push/train/2", None)]
    assert "24×20 pixels" in report.problems[0].what
    assert "7 values" in report.problems[1].what
    assert [count for _, count in report.looks] == [2, 1, 1]


def test_a_rate_that_nothing_states(tmp_path: Path) -> None:
    """Images have none; the frames are read all the same."""
    write(tmp_path, {"Push/train/0": make_episode(0, 3, cameras=("front",))})
    write_table(tmp_path, rows_of("Push/train/0", make_episode(0, 3, cameras=("front",))))
    report = check(f"frames:{tmp_path}")
    assert found(report) == [("Push/train/0", None)]
    assert "fps" in str(report.problems[0].hint)
    assert report.frames == 3


def test_an_episode_in_two_sources(tmp_path: Path) -> None:
    write_frames(tmp_path / "a", EPISODES)
    write_lerobot(tmp_path / "b", {"MoveCube/train/1": EPISODES["MoveCube/train/1"]})
    a, b = f"frames:{tmp_path / 'a'}", f"lerobot:{tmp_path / 'b'}"
    report = check(a, b)
    twice = [problem for problem in report.problems if "twice" in problem.what]
    assert [(problem.source, problem.episode) for problem in twice] == [(b, "MoveCube/train/1")]


def test_a_camera_that_no_episode_has_is_an_error_at_once(tmp_path: Path) -> None:
    write_frames(tmp_path, EPISODES)
    with raises(InvalidOptionError):
        check(f"frames:{tmp_path}", cameras=("left",))


def test_the_command(tmp_path: Path, run: Run) -> None:
    write_frames(tmp_path / "good", EPISODES)
    good = f"frames:{tmp_path / 'good'}"
    code, out, err = run("verify", "--source", good, "--workers", "1", "--cameras", "front")
    assert (code, out) == (0, "")
    assert "robomme-interference build my-buffers --source" in err and "--cameras front" in err
    state = EPISODES["MoveCube/train/1"].state.copy()
    state[6] = np.nan
    bad = {"MoveCube/train/1": replace(EPISODES["MoveCube/train/1"], state=state)}
    write_lerobot(tmp_path / "bad", bad)
    (tmp_path / "none").mkdir()
    sources = ("--source", f"lerobot:{tmp_path / 'bad'}", "--source", f"lerobot:{tmp_path}/none")
    code, out, _ = run("verify", "my-set", *sources, "--workers", "1", "--json")
    report = json.loads(out)
    assert code == 1
    assert [(one["source"], one["episode"], one["frame"]) for one in report["problems"]] == [
        (f"lerobot:{tmp_path}/none", None, None),
        (f"lerobot:{tmp_path}/bad", "MoveCube/train/1", 6),
    ]
    assert (report["episodes"], report["frames"], report["next"]) == (1, 7, None)
    code, out, _ = run("verify", *sources, "--workers", "1")
    assert code == 1
    assert f"lerobot:{tmp_path}/bad, MoveCube/train/1, frame 6: observation.state" in out


def test_the_next_command_has_the_same_settings(tmp_path: Path, run: Run) -> None:
    folder = tmp_path / "my recordings"
    write_lerobot(folder)
    sources = ("--source", f"lerobot:{folder}")
    settings = ("--columns", "action=none", "--set", "several_tasks=joined")
    code, _, err = run("verify", "my set", *sources, *settings, "--workers", "1")
    assert code == 0
    command = err.partition("Next: ")[2]
    words = ["robomme-interference", "build", "my set", *sources, *settings]
    assert shlex.split(command) == words


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ([], "--source"),
        (["x", "--columns", "front=a"], "--columns"),
        (["--source", "frames:x", "--audit"], "--audit"),
        (["--source", "frames:x", "--no-decode"], "--no-decode"),
    ],
)
def test_options_without_effect(run: Run, given: list[str], named: str) -> None:
    code, _, err = run("verify", *given)
    assert code != 0
    assert named in err
