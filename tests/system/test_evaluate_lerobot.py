"""A LeRobot policy that is trained on a built dataset acts: features and sizes fit."""

from pathlib import Path

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("lerobot")
pytestmark = pytest.mark.slow


def test_a_policy_trained_on_built_executions_acts(tmp_path: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.policies.factory import (
        get_policy_class,
        make_policy_config,
        make_pre_post_processors,
    )
    from lerobot.utils.feature_utils import dataset_to_policy_features
    from support.lerobot_policies import SMALL, features, play

    from robomme_interference_data.build_dataset.config import BuildConfig
    from robomme_interference_data.build_dataset.dataset.build import build_dataset
    from robomme_interference_data.build_dataset.plan.datasets import plan_dataset
    from robomme_interference_data.constants import ACTION
    from robomme_interference_data.evaluate.policies.registry import make_policy
    from robomme_interference_data.progress import WorkProgress
    from robomme_interference_data.runtime.executor import Serial

    out = tmp_path / "executions"
    config = BuildConfig(source=("sample:MoveCube,PatternLock",), buffer_set=out, split="test")
    plan = plan_dataset("executions", config)
    build_dataset(plan, out, Serial(), WorkProgress(quiet=True))
    options = {"device": "cpu", "push_to_hub": False, "pretrained_backbone_weights": None}
    act = make_policy_config("act", **options, **features(), **SMALL["act"])
    steps = [step / 10 for step in act.action_delta_indices]
    dataset = LeRobotDataset(
        "local/it", root=out, delta_timestamps={ACTION: steps}, video_backend="pyav"
    )
    inferred = dataset_to_policy_features(dataset.meta.features)
    given = features()
    assert inferred == given["input_features"] | given["output_features"]
    before, after = make_pre_post_processors(act, dataset_stats=dataset.meta.stats)
    model = get_policy_class("act")(act).train()
    optimizer = torch.optim.AdamW(model.parameters(), 1e-3)
    batch = before(torch.utils.data.default_collate([dataset[index] for index in range(4)]))
    losses = []
    for _ in range(5):
        loss, _ = model.forward(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0]
    for part in (model, before, after):
        part.save_pretrained(tmp_path / "policy")
    (actions,) = play(make_policy(f"lerobot:{tmp_path / 'policy'}", ["device=cpu"]), 0, [1])
    assert actions.shape == (16, 8)
