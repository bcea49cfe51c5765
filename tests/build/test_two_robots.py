"""From recordings of two robots to buffers, by the command line, with all that reads them.

Lessons are of a frames folder: 24x16 pixels, states of 8 values. Units are of a LeRobot dataset of
another robot: 32x24 pixels, states of 3 values, two units of a recording.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.made_up import MadeUpSource
from support.messages import raises
from support.recordings import make_episode, rows_of, write_table, write_video

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.dataset.build import build_dataset
from robomme_interference_data.build_dataset.dataset.plan import DatasetPlan, PlannedEpisode
from robomme_interference_data.build_dataset.dataset.resize import Resize
from robomme_interference_data.build_dataset.sources import Frame
from robomme_interference_data.constants import DEMONSTRATIONS, DISTRACTORS, Unit
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.runtime.executor import Serial

QUERIES = ("Lift/test/0", "Stack/test/0")
UNITS = ["--unit", "4x2", "--set", "units_per_episode=2", "--resize", "24x16:pad"]


def picture(recording: int, number: int) -> Any:
    """A frame of the other robot, `(24, 32, 3) uint8`: it is brighter from left to right."""
    columns = np.arange(32)[None, :, None] * 4 + np.arange(3) + number + 50 * recording
    return np.broadcast_to(columns, (24, 32, 3)).astype(np.uint8)


class OtherRobot(MadeUpSource):
    """A robot with larger images."""

    def frame(self, name: str, number: int, *rest: Any) -> Frame:
        made = super().frame(name, number, *rest)
        images = dict.fromkeys(made.images, picture(int(name[-1]), number))
        return Frame(images, made.state, made.action, None)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The sources of lessons and of units."""
    lessons = tmp_path_factory.mktemp("lessons")
    rows = []
    for seed, name in enumerate(QUERIES):
        episode = make_episode(seed, 12, f"do {name}", 5, cameras=("front",))
        write_video(lessons / f"videos/front/{name}.mkv", episode.images["front"])
        rows += rows_of(name, episode, is_demo=[step < 5 for step in range(12)], seed=seed)
    write_table(lessons, rows)
    other = tmp_path_factory.mktemp("other") / "robot"
    source = OtherRobot({f"Pour/train/{number}": (20, None) for number in range(2)}, values=3)
    episodes = tuple(PlannedEpisode(0, episode) for episode in source.episodes())
    whole = DatasetPlan(DISTRACTORS, (source,), episodes, unit=Unit(20, 1))
    build_dataset(whole, other, Serial(), WorkProgress(quiet=True))
    return {"lessons": f"frames:{lessons}", "units": f"lerobot:{other}"}


def build(recordings: dict[str, str], root: Path, run: Any) -> None:
    for part in (DEMONSTRATIONS, "executions"):
        done = run("build", root, "--only", part, "--source", recordings["lessons"], "--workers", 1)
        assert done[0] == 0, done[2]
    units = ["build", root, "--only", DISTRACTORS, "--source", recordings["units"]]
    code, _, err = run(*units, *UNITS[:-2], "--workers", 1)
    assert code == 1 and "--resize" in err  # another size than that of the demonstrations
    code, _, err = run(*units, *UNITS, "--workers", 1)
    assert code == 0 and "4 episodes, 16 frames" in err, err
    again = run(*units, *UNITS, "--workers", 1)
    assert again[0] == 0 and "nothing to add" in again[2], again[2]
    planned = run("build", root, "--only", "manifests", "--conditions", "no-history,k0,k1,k3")
    assert planned[0] == 0, planned[2]


@pytest.mark.slow
def test_buffers_of_two_robots(recordings: dict[str, str], tmp_path: Path, run: Any) -> None:
    buffers = tmp_path / "set"
    build(recordings, buffers, run)
    code, out, err = run("verify", buffers, "--audit")
    assert code == 0, out + err
    opened = load_buffer_set(buffers)
    source = {"kind": "lerobot", "resize": "24x16:pad"}
    assert [one | source for one in opened.datasets[DISTRACTORS].identity.sources] == [
        *opened.datasets[DISTRACTORS].identity.sources
    ]
    assert opened.datasets[DEMONSTRATIONS].identity.exact
    assert not opened.datasets[DISTRACTORS].identity.exact
    # 20 frames leave room for starts 0 to 13: two units at 0 and 13.
    buffer = opened.load(QUERIES[0], "k3", verify=True)
    assert {str(session.source) for session in buffer.sessions[1:]} < {
        *("Pour/train/0", "Pour/train/0@13", "Pour/train/1", "Pour/train/1@13")
    }
    assert not buffer.manifest.exact and len(buffer) == 5 + 3 * 4
    frames = buffer.frames()
    for session in buffer.sessions[1:]:
        steps = [session.source.start + step for step in (0, 2, 4, 6)]
        expected = [
            Resize(24, 16, "pad").apply(picture(session.source.index, step)) for step in steps
        ]
        np.testing.assert_array_equal(frames[session.start : session.stop], expected)
        number = buffer.sessions.index(session)
        assert buffer.session_states(number).tolist() == [[step] * 3 for step in steps]
    with raises(InvalidOptionError):
        _ = buffer.states
    assert buffer.states_by("pad").shape == (17, 8)
    use(buffers, tmp_path, run)


def use(buffers: Path, tmp_path: Path, run: Any) -> None:
    """Show, index, retrieve and evaluate."""
    strip = tmp_path / "strip.png"
    code, out, err = run("show", buffers, QUERIES[0], "k3", "--out", strip)
    assert code == 0 and strip.is_file() and "Pour/train/" in out, err
    code, out, err = run("show", buffers, QUERIES[0], "k3", "--html", tmp_path / "page.html")
    assert code == 0, err
    assert run("index", buffers)[0] == 0
    code, out, err = run("retrieve", buffers, QUERIES[0], "k3", "--json")
    assert code == 0 and json.loads(out), err
    evaluate = ["evaluate", buffers, "--offline", "--conditions", "k0,k3", "--workers", 1]
    own = ["--policy", "python:support.own_policies:OfTwoRobots", "--system", "mine"]
    code, _, err = run(*evaluate, *own, "--out", tmp_path / "refused")
    assert code == 1 and "--policy-option other_states=" in err
    pad = ["--policy-option", "other_states=pad", "--out", tmp_path / "run"]
    code, _, err = run(*evaluate, *own, *pad)
    assert code == 0, err
    rows = [json.loads(line) for line in (tmp_path / "run/rollouts.jsonl").open()]
    assert {row["status"] for row in rows} == {"measured"} and len(rows) == 4
    baseline = run(
        *evaluate[:3],
        "--conditions",
        "no-history",
        "--workers",
        1,
        "--policy",
        "hold",
        "--out",
        tmp_path / "hold",
    )
    assert baseline[0] == 0, baseline[2]
