"""LeRobot policies: the same actions as LeRobot's own loop gives."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("lerobot")

from support import lerobot_policies  # noqa: E402
from support.lerobot_policies import (  # noqa: E402
    FRONT,
    SEED,
    STATE,
    edit,
    play,
    save_policy,
    section,
)

from robomme_interference_data.evaluate.policies.lerobot import LeRobotPolicy  # noqa: E402
from robomme_interference_data.evaluate.policies.registry import make_policy  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore:To evaluate in the environment, your VQ-BeT")

# The fixtures.
_one_thread = lerobot_policies.one_thread
act = lerobot_policies.act
vqbet = lerobot_policies.vqbet


def loaded(folder: Path) -> tuple[Any, Any, Any]:
    """Load policy and processors as LeRobot's own evaluation does."""
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors

    config = PreTrainedConfig.from_pretrained(folder)
    model = get_policy_class(config.type).from_pretrained(folder, config=config)
    return model, *make_pre_post_processors(config, pretrained_path=str(folder))


def prepared(number: int, goal: str = "pick the cube") -> dict[str, Any]:
    frames, states = section(number, number + 1)
    batch: dict[str, Any] = {STATE: torch.from_numpy(states), "task": [goal]}
    for name, part in frames.items():
        image = torch.from_numpy(part).permute(0, 3, 1, 2).float() / 255
        batch[f"observation.images.{name}"] = image
    return batch


def test_act_gives_what_lerobots_own_loop_gives(act: Path) -> None:
    policy = LeRobotPolicy(str(act), device="cpu")
    assert (policy.wants_history, policy.every_frame, policy.privileged) == (False, False, False)
    assert (policy.cameras, policy.history_cameras) == (("front", "wrist"), ())
    found = play(policy, 0, [1, 1])

    model, before, after = loaded(act)
    for number in (0, 1):
        model.reset()
        expected = []
        for _ in range(16):  # of 20: more are never executed
            with torch.inference_mode():
                expected.append(after(model.select_action(before(prepared(number)))).numpy()[0])
        assert found[number].shape == (16, 8)
        assert found[number].dtype == np.float32
        np.testing.assert_allclose(found[number], np.stack(expected), rtol=1e-5, atol=1e-6)
    assert not np.allclose(found[0], found[1])
    policy.close()


def test_fewer_action_steps_are_respected(act: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(act, tmp_path / "short")
    edit(folder, lambda config: config.update(n_action_steps=3))
    whole = play(LeRobotPolicy(str(act), device="cpu"), 0, [1])[0]
    short = play(LeRobotPolicy(str(folder), device="cpu"), 0, [1])[0]
    np.testing.assert_array_equal(short, whole[:3])


def test_temporal_ensembling_gives_one_averaged_action(act: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(act, tmp_path / "ensemble")
    edit(folder, lambda config: config.update(n_action_steps=1, temporal_ensemble_coeff=0.01))
    chunk = play(LeRobotPolicy(str(act), device="cpu"), 0, [1, 1])
    found = play(LeRobotPolicy(str(folder), device="cpu"), 0, [1, 1])
    assert [part.shape for part in found] == [(1, 8), (1, 8)]
    np.testing.assert_allclose(found[0][0], chunk[0][0], rtol=1e-5, atol=1e-6)
    # Second step: weights 1 for the older chunk and exp(-0.01) for the newer.
    weight = np.exp(-0.01)
    mean = (chunk[0][1] + weight * chunk[1][0]) / (1 + weight)
    np.testing.assert_allclose(found[1][0], mean, rtol=1e-4, atol=1e-5)


def expected_of_vqbet(folder: Path, numbers: list[int], asked: int) -> np.ndarray:
    """What the model gives for a window of observations, without any queue."""
    model, before, after = loaded(folder)
    batches = [before(prepared(number)) for number in numbers]
    window = {
        STATE: torch.stack([batch[STATE] for batch in batches], 1),
        "observation.images": torch.stack([batch[FRONT][:, None] for batch in batches], 1),
    }
    torch.manual_seed((SEED << 16) + asked)
    with torch.inference_mode():
        chunk = model.vqbet(window, rollout=True)[0, :5]
        return np.stack([after(action[None]).numpy()[0] for action in chunk])


def test_a_queue_is_filled_with_the_end_of_the_history(vqbet: Path) -> None:
    policy = LeRobotPolicy(str(vqbet), device="cpu")
    assert (policy.wants_history, policy.every_frame) == (True, True)
    assert (policy.cameras, policy.history_cameras) == (("front",), ("front",))
    found = play(policy, 6, [1, 5, 1])
    # The first live observation is number 6: history 5 comes before it.
    for asked, numbers in enumerate([[5, 6], [10, 11], [11, 12]]):
        assert found[asked].shape == (5, 8)
        expected = expected_of_vqbet(vqbet, numbers, asked)
        np.testing.assert_allclose(found[asked], expected, rtol=1e-4, atol=1e-5)


def test_without_history_the_first_observation_fills_the_queue(vqbet: Path) -> None:
    found = play(LeRobotPolicy(str(vqbet), device="cpu"), 0, [1])
    expected = expected_of_vqbet(vqbet, [0, 0], 0)
    np.testing.assert_allclose(found[0], expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("kind", ["vqbet", "diffusion"])
def test_rollouts_repeat_and_do_not_touch_the_global_generator(kind: str, tmp_path: Path) -> None:
    policy = LeRobotPolicy(str(save_policy(tmp_path, kind, (FRONT,))), device="cpu")
    state = torch.get_rng_state()
    first = play(policy, 4, [1, 3])
    torch.manual_seed(99)
    second = play(policy, 4, [1, 3])
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, other)
    torch.set_rng_state(state)
    play(policy, 0, [1])
    assert torch.equal(torch.get_rng_state(), state)
    # What came before in the history is in the queue, and makes a difference.
    assert not np.array_equal(first[0], play(policy, 3, [1])[0])


def test_diffusion_gives_what_its_model_gives_for_the_window(tmp_path: Path) -> None:
    folder = save_policy(tmp_path, "diffusion", (FRONT,))
    found = play(LeRobotPolicy(str(folder), device="cpu"), 3, [1])[0]
    model, before, after = loaded(folder)
    batches = [before(prepared(number)) for number in (2, 3)]
    window = {
        STATE: torch.stack([batch[STATE] for batch in batches], 1),
        "observation.images": torch.stack([batch[FRONT][:, None] for batch in batches], 1),
    }
    torch.manual_seed(SEED << 16)
    with torch.inference_mode():
        chunk = model.diffusion.generate_actions(window)[0]
        expected = np.stack([after(action[None]).numpy()[0] for action in chunk])
    assert found.shape == (8, 8)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def test_the_registry_makes_it_and_the_record_names_it(act: Path) -> None:
    policy = make_policy(f"lerobot:{act}", ["device=cpu"])
    said = policy.metadata()
    assert len(said.pop("sha256")) == 64
    assert said == {
        "policy": "lerobot",
        "source": str(act),
        "type": "act",
        "n_obs_steps": 1,
        "device": "cpu",
    }
    policy.close()


def test_the_saved_policies_are_always_the_same(tmp_path: Path) -> None:
    for name in ("one", "other"):
        save_policy(tmp_path / name, "act", (FRONT,))
    one, other = ((tmp_path / name / "model.safetensors").read_bytes() for name in ("one", "other"))
    assert one == other
