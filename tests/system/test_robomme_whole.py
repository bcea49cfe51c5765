"""The official simulator the whole way: recorded, built, evaluated; a stand-in plays RoboMME."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from robomme_interference_data.build_dataset.build import build_dataset
from robomme_interference_data.build_dataset.config import BuildConfig, plan_build
from robomme_interference_data.build_dataset.manifests import (
    in_folder,
    plan_manifests,
    write_manifests,
)
from robomme_interference_data.constants import DEMONSTRATIONS, DISTRACTORS
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.runtime.executor import Executor, Processes, Serial
from robomme_interference_data.runtime.progress import WorkProgress
from robomme_interference_data.simulators.robomme.simulator import EPISODES
from robomme_interference_data.storage.files import LocalFiles


def build(kind: str, config: BuildConfig) -> int:
    """Build a dataset in this process; return how many episodes were added."""
    plan = plan_build(kind, config)
    return build_dataset(plan, config.buffer_set / kind, Serial(), WorkProgress(quiet=True)).added


def config_of(out: Path, python: Path, episodes: str) -> BuildConfig:
    return BuildConfig(
        source=("robomme",),
        buffer_set=out,
        families=("MoveCube",),
        split="test",
        episodes=episodes,
        robomme_python=str(python),
    )


def test_demonstrations_are_built_from_it(tmp_path: Path, robomme_python: Path) -> None:
    out = tmp_path / "demonstrations"
    config = config_of(tmp_path, robomme_python, "0-1")
    assert build(DEMONSTRATIONS, config) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["demonstrations"]
    dataset = Dataset(LocalFiles(out))
    first, second = dataset.records()
    assert (str(first.episode_id), str(second.episode_id)) == ("MoveCube/test/0", "MoveCube/test/1")
    assert (first.simulator, first.exact, first.seed) == ("robomme", True, 640_000)
    # The stand-in's demonstrations have 2 + index % 40 frames; then comes the live observation.
    assert (first.length, second.length) == (3, 4)
    assert "action" not in dataset.features
    assert dataset.cameras == ("front", "wrist")
    # Frame t of the front camera is all t, of the wrist camera all 100 + t.
    for camera, offset in zip(dataset.cameras, (0, 100), strict=True):
        frames = list(dataset.iter_frames(second.episode_index, camera, 0, 4))
        assert [np.unique(frame).tolist() for frame in frames] == [[offset + t] for t in range(4)]
    assert build(DEMONSTRATIONS, config) == 0
    with pytest.raises(InvalidOptionError, match="demonstrations only"):
        build(DISTRACTORS, replace(config, buffer_set=tmp_path / "units"))
    assert [path.name for path in tmp_path.iterdir()] == ["demonstrations"]


@pytest.mark.parametrize("executor", [Serial(), Processes(2)])
def test_an_interpreter_that_will_not_do_leaves_nothing(tmp_path: Path, executor: Executor) -> None:
    for python, error in (("/nowhere/python", InvalidOptionError), (sys.executable, ImportError)):
        config = config_of(tmp_path / "new", Path(python), "0-9")
        plan = plan_build(DEMONSTRATIONS, config)
        with pytest.raises(error):
            build_dataset(plan, config.buffer_set, executor, WorkProgress(quiet=True))
        assert list(tmp_path.iterdir()) == []


def test_an_evaluation_on_it(tmp_path: Path, robomme_python: Path) -> None:
    from robomme_interference_data.evaluate import run_evaluation
    from robomme_interference_data.evaluate.run.config import RunConfig

    queries = config_of(tmp_path, robomme_python, "45-47")
    build(DEMONSTRATIONS, replace(queries, cameras=("front",)))
    units = BuildConfig(("sample:VideoRepick",), tmp_path, split="train", cameras=("front",))
    build(DISTRACTORS, units)
    for _ in write_manifests(
        plan_manifests(in_folder(tmp_path), ("no-history", "k0", "k1")), tmp_path
    ):
        pass
    config = RunConfig(
        policy="replay",
        buffer_set=tmp_path,
        out=tmp_path / "run",
        simulator="robomme",
        robomme_python=str(robomme_python),
        episodes="45-47",
        check_lesson=True,
    )
    result = run_evaluation(config, executor=Serial())
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
