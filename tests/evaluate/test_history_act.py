"""The example `examples/lerobot_policy_history_act`, with LeRobot's own functions."""

import shutil
from collections.abc import Callable
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.lazy import lazy

from robomme_interference_data.constants import ACTION, FRONT, STATE, WRIST
from robomme_interference_data.evaluate.policies.policy import RolloutInfo
from robomme_interference_data.evaluate.policies.registry import make_policy
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.simulators.episode import Observation

torch, gymnasium, _ = lazy("torch"), lazy("gymnasium"), lazy("lerobot")
small = lazy("support.lerobot_policies")

SIDE = 24


@pytest.fixture(scope="module")
def history(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small.save_policy(tmp_path_factory.mktemp("history"), "history_act")


def batch_of(count: int) -> dict[str, Any]:
    """A batch of training, of which every item has a padded place."""
    draw = torch.Generator().manual_seed(0)
    views = {name: torch.rand(count, 3, SIDE, SIDE, generator=draw) for name in (FRONT, WRIST)}
    past = {
        f"observation.memory.images.{name}": torch.rand(count, 3, 3, SIDE, SIDE, generator=draw)
        for name in ("front", "wrist")
    }
    padding = torch.zeros(count, 3, dtype=torch.bool)
    padding[:, 2] = True
    return {
        **views,
        **past,
        STATE: torch.rand(count, 8, generator=draw),
        "observation.memory.state": torch.rand(count, 3, 8, generator=draw),
        "observation.memory.position": torch.tensor([[0, 4, 0]]).expand(count, -1),
        "observation.memory.padding": padding,
        "observation.position": torch.full((count,), 9),
        ACTION: torch.rand(count, 16, 8, generator=draw),
        "action_is_pad": torch.zeros(count, 16, dtype=torch.bool),
        "task": ["pick the cube"] * count,
    }


def test_lerobot_finds_it_by_the_name_of_its_distribution() -> None:
    from lerobot.configs import PreTrainedConfig
    from lerobot.utils.import_utils import register_third_party_plugins

    assert distribution("lerobot_policy_history_act").metadata["Name"].startswith("lerobot_policy_")
    register_third_party_plugins()
    made = PreTrainedConfig.get_choice_class("history_act")(device="cpu")
    assert (made.memory, made.image_size) == ("framesamp:32", 96)
    assert made.pretrained_backbone_weights is None  # nothing is downloaded


def test_it_needs_features_of_a_memory() -> None:
    from lerobot.policies.factory import get_policy_class, make_policy_config

    made = make_policy_config("history_act", device="cpu", **small.features())
    with pytest.raises(ValueError, match=r"observation\.memory\.state"):
        get_policy_class("history_act")(made)


def test_it_learns_and_reads_its_memory_but_no_padding(history: Path) -> None:
    policy, before, _ = small.loaded(history)
    batch = before(batch_of(4))
    optimizer = torch.optim.AdamW(policy.get_optim_params(), 1e-3)
    losses = []
    for _step in range(5):
        policy.train()
        loss, _values = policy.forward(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0]
    given = policy.predict_action_chunk(batch)
    for feature in ("images.front", "images.wrist", "state", "position"):
        name = f"observation.memory.{feature}"
        for place, is_read in ((1, True), (2, False)):
            changed = batch[name].clone()
            changed[:, place] += 3
            same = torch.equal(policy.predict_action_chunk(batch | {name: changed}), given)
            assert same is not is_read, (name, place)


@pytest.mark.slow
def test_it_is_pushed_and_loaded_from_the_hub(
    history: Path, login: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    from lerobot.configs.default import DatasetConfig
    from lerobot.configs.train import TrainPipelineConfig

    policy, before, after = small.loaded(history)
    policy.config.repo_id = "someone/history"
    settings = TrainPipelineConfig(dataset=DatasetConfig("someone/buffers"), policy=policy.config)
    # The check of a card asks the real Hub, whatever the endpoint.
    monkeypatch.setattr("huggingface_hub.ModelCard.validate", lambda card: None)
    login("someone")
    policy.push_model_to_hub(settings)  # as lerobot-train does
    for part in (before, after):
        part.push_to_hub("someone/history")
    loaded = make_policy("lerobot:someone/history", ["device=cpu"])
    kept = make_policy(f"lerobot:{history}", ["device=cpu"])
    for one, other in zip(*(small.play(found, 5, [1, 2]) for found in (loaded, kept)), strict=True):
        np.testing.assert_array_equal(one, other)


# --- lerobot-eval ------------------------------------------------------------------------------


def one_episode(simulator: Any, steps: int) -> Any:
    """An episode of tabletop as an environment of LeRobot."""
    space = gymnasium.spaces
    image = space.Box(0, 255, (256, 256, 3), np.uint8)
    vector = space.Box(-np.inf, np.inf, (8,), np.float32)

    class Episode(gymnasium.Env):  # type: ignore[misc,name-defined]
        observation_space = space.Dict(
            {"pixels": space.Dict({"front": image, "wrist": image}), "agent_pos": vector}
        )
        action_space = vector
        metadata = {"render_fps": 10}  # noqa: RUF012, Gymnasium's
        _max_episode_steps = steps
        task = task_description = ""

        def reset(self, **options: Any) -> Any:
            _, first, about = simulator.reset("MoveCube/test/3", demonstration=False)
            self.task = self.task_description = about.goal
            return seen(first), {}

        def step(self, action: Any) -> Any:
            observed, status = simulator.step(action)
            ended = status is not Status.ONGOING
            return seen(observed), 0.0, ended, False, {"is_success": status is Status.SUCCESS}

    def seen(observed: Any) -> dict[str, Any]:
        return {"pixels": dict(observed.images), "agent_pos": observed.state}

    return gymnasium.vector.SyncVectorEnv([Episode])


@pytest.mark.slow
def test_lerobots_evaluation_rolls_it_out_with_a_memory_of_its_own(
    history: Path, tmp_path: Path, tabletop: Any
) -> None:
    from lerobot.processor import PolicyProcessorPipeline
    from lerobot.scripts.lerobot_eval import eval_policy

    folder = shutil.copytree(history, tmp_path / "policy")
    small.edit(folder, lambda settings: settings.update(n_action_steps=3))
    policy, before, after = small.loaded(folder)
    nothing = PolicyProcessorPipeline(steps=[])
    info = eval_policy(
        one_episode(tabletop, 8),
        policy,
        nothing,
        nothing,
        before,
        after,
        n_episodes=1,
        return_episode_data=True,
    )
    episode = info["episodes"]
    actions, states = episode[ACTION].numpy(), episode[STATE].numpy()
    assert actions.shape == (9, 8)  # the last observation repeats the last action
    frames = {
        name: (episode[f"observation.images.{name}"] * 255).round().to(torch.uint8)
        for name in ("front", "wrist")
    }
    # The same as in a rollout without history, where the memory is given.
    given = make_policy(f"lerobot:{folder}", ["device=cpu"])
    given.reset(RolloutInfo("", 0, 0))
    for start, stop, at in ((0, 1, 0), (1, 4, 3), (4, 7, 6)):
        images = {name: part[start:stop].permute(0, 2, 3, 1) for name, part in frames.items()}
        images = {name: part.contiguous().numpy() for name, part in images.items()}
        given.observe(images, states[start:stop])
        now = Observation({name: part[-1] for name, part in images.items()}, states[stop - 1])
        count = min(3, 8 - at)
        found = given.act(now, "")[:count]
        np.testing.assert_allclose(found, actions[at : at + count], rtol=1e-4, atol=1e-5)
