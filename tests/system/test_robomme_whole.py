"""The official simulator the whole way: recorded, built, evaluated; a stand-in plays RoboMME."""

from dataclasses import replace
from pathlib import Path

import pytest

from robomme_interference_data.build_dataset.config import BuildConfig
from robomme_interference_data.build_dataset.dataset.build import build_dataset
from robomme_interference_data.build_dataset.manifests import plan_manifests, write_manifests
from robomme_interference_data.build_dataset.plan.datasets import plan_dataset
from robomme_interference_data.build_dataset.plan.planned import datasets_in
from robomme_interference_data.constants import DEMONSTRATIONS, DISTRACTORS
from robomme_interference_data.errors import BuildError
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.simulators.robomme.simulator import EPISODES


def build(kind: str, config: BuildConfig) -> int:
    """Build a dataset in this process; return how many episodes were added."""
    plan = plan_dataset(kind, config)
    return build_dataset(plan, config.buffer_set / kind, Serial(), WorkProgress(quiet=True)).added


def config_of(out: Path, episodes: str) -> BuildConfig:
    return BuildConfig(
        source=("robomme",), buffer_set=out, families=("MoveCube",), split="test", episodes=episodes
    )


@pytest.mark.slow
def test_an_evaluation_on_it(tmp_path: Path, robomme_python: Path) -> None:
    from robomme_interference_data.evaluate import run_evaluation
    from robomme_interference_data.evaluate.run.config import RunConfig

    queries = config_of(tmp_path, "45-47")
    assert build(DEMONSTRATIONS, replace(queries, cameras=("front",))) == 3
    assert build(DEMONSTRATIONS, replace(queries, cameras=("front",))) == 0
    # The stand-in hides the answers of this family, so its oracle cannot complete an episode.
    with pytest.raises(BuildError) as raised:
        build(DISTRACTORS, replace(queries, buffer_set=tmp_path / "units", split="train"))
    assert "hides its answers" in raised.value.message
    units = BuildConfig(
        source=("sample:VideoRepick",), buffer_set=tmp_path, split="train", cameras=("front",)
    )
    build(DISTRACTORS, units)
    for _ in write_manifests(
        plan_manifests(datasets_in(tmp_path), ("no-history", "k0", "k1")), tmp_path
    ):
        pass
    config = RunConfig(
        policy="replay",
        buffer_set=tmp_path,
        out=tmp_path / "run",
        simulator="robomme",
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
