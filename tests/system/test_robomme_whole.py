"""The official simulator the whole way: recorded, built, evaluated; a stand-in plays RoboMME."""

import sys
from pathlib import Path

import factories
import numpy as np
import pytest
from typer.testing import CliRunner

from robomme_interference_data import Dataset
from robomme_interference_data.build_dataset.manifests import plan_manifests, write_manifests
from robomme_interference_data.build_dataset.sample import write_sample
from robomme_interference_data.cli import app
from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    MissingExtraError,
    UnknownNameError,
)
from robomme_interference_data.evaluate import run_evaluation
from robomme_interference_data.evaluate.config import RunConfig
from robomme_interference_data.evaluate.policies.registry import make_policy
from robomme_interference_data.evaluate.worker import simulator_options
from robomme_interference_data.files import LocalFiles
from robomme_interference_data.simulators.robomme_client import EPISODES

BUILD = ["build", "demonstrations", "--source", "robomme", "--split", "test", "--workers", "1"]


def invoke(words: list[str]) -> str:
    done = CliRunner().invoke(app, words)
    if done.exception is not None:
        raise done.exception
    return " ".join(done.stderr.split())


def build(out: Path, python: Path, *more: str, episodes: str = "45-47") -> str:
    words = [*BUILD, "--families", "MoveCube", "--episodes", episodes, "--out", str(out)]
    return invoke([*words, "--robomme-python", str(python), *more])


def test_demonstrations_are_recorded_from_it(tmp_path: Path, robomme_python: Path) -> None:
    out = tmp_path / "demonstrations"
    # The stand-in's demonstrations have 2 + index % 40 frames; then comes the live observation.
    assert "built, 2 episodes, 7 frames" in build(out, robomme_python, episodes="0-1")
    assert [path.name for path in tmp_path.iterdir()] == ["demonstrations"]
    dataset = Dataset(LocalFiles(out))
    first, second = dataset.records()
    assert (str(first.id), str(second.id)) == ("MoveCube/test/0", "MoveCube/test/1")
    assert (first.simulator, first.exact, first.seed) == ("robomme", True, 640_000)
    assert (first.length, second.length) == (3, 4)
    assert "action" not in dataset.features
    assert dataset.cameras == ("observation.images.front", "observation.images.wrist")
    # Frame t of the front camera is all t, of the wrist camera all 100 + t.
    for camera, offset in zip(dataset.cameras, (0, 100), strict=True):
        frames = list(dataset.iter_frames(second.episode_index, camera, 0, 4))
        assert [np.unique(frame).tolist() for frame in frames] == [[offset + t] for t in range(4)]
    assert "was built before" in build(out, robomme_python, episodes="0-1")


def test_what_it_cannot_play_is_refused_first(tmp_path: Path, robomme_python: Path) -> None:
    python = ["--robomme-python", str(robomme_python)]
    for words in (
        ["build", "distractors", "--source", "robomme", "--out", str(tmp_path / "new")],
        ["build", "all", "--source", "robomme", "--out", str(tmp_path / "new")],
    ):
        with pytest.raises(InvalidOptionError, match="robomme plays demonstrations only") as caught:
            invoke(words)
        assert "build distractors --source robomme-h5:DIR" in str(caught.value)
    for more, error, message in (
        (["--families", "BinFill"], UnknownNameError, "no demonstrations of a family 'BinFill'"),
        (["--episodes", "50"], InvalidOptionError, "no episode of these numbers"),
        (["--cameras", "top"], UnknownNameError, "--cameras top"),
        (["--robomme-python", sys.executable], MissingExtraError, "RoboMME needs numpy < 2"),
        (["--robomme-python", ""], InvalidOptionError, "none is given"),
    ):
        with pytest.raises(InterferenceError, match=message) as refused:
            invoke([*BUILD, *python, "--out", str(tmp_path / "new"), *more])
        assert isinstance(refused.value, error)
    assert list(tmp_path.iterdir()) == []


def test_an_evaluation_on_it(tmp_path: Path, robomme_python: Path) -> None:
    build(tmp_path / "demonstrations", robomme_python, "--cameras", "front")
    families = ("VideoRepick",)
    for _ in write_sample(tmp_path / "sample", families=families, train=1, test=0, frames=249):
        pass
    cameras = ("front",)
    units = factories.build(
        "distractors", tmp_path / "sample", tmp_path / "distractors", cameras=cameras
    )
    queries = Dataset(LocalFiles(tmp_path / "demonstrations"))
    for _ in write_manifests(plan_manifests(queries, units, (0, 1), 0), tmp_path / "manifests"):
        pass
    result = run_evaluation(
        "replay",
        tmp_path,
        tmp_path / "run",
        simulator="robomme",
        robomme_python=str(robomme_python),
        episodes="45-47",
        memory="full",
        check_lesson=True,
    )
    # The stand-in ends its test episodes 45, 46 and 47 so, at the third step.
    assert [
        (row.episode, row.condition, row.status, row.steps, row.history_frames, row.error)
        for row in result.rows
    ] == [
        (45, "no-history", "success", 3, 0, None),
        (45, "k0", "success", 3, 7, None),
        (45, "k1", "success", 3, 7 + 32, None),
        (46, "no-history", "fail", 3, 0, None),
        (46, "k0", "fail", 3, 8, None),
        (46, "k1", "fail", 3, 8 + 32, None),
        (47, "no-history", "timeout", 3, 0, None),
        (47, "k0", "timeout", 3, 9, None),
        (47, "k1", "timeout", 3, 9 + 32, None),
    ]
    assert len(result.rows) > EPISODES  # so RoboMME's interpreter was started anew in between
    assert {row.seed for row in result.rows} == {640_045, 640_046, 640_047}


def test_the_time_limit_of_a_run_is_the_simulators() -> None:
    config = RunConfig(
        system="hold",
        policy="hold",
        memory=None,
        simulator="robomme",
        split="s",
        split_name="s",
        revision="r",
        robomme_python="python",
        simulator_s=1000.0,
    )
    assert simulator_options(config, make_policy("hold").cameras, None) == {
        "python": "python",
        "cameras": (),
        "reset_s": 900.0,
        "step_s": 900.0,
    }
