"""LeRobot policies: the same actions as LeRobot's own loop gives, and what does not fit."""

import hashlib
import json
import shutil
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("lerobot")

import lerobot_policies  # noqa: E402
from lerobot_policies import ACTION, FRONT, SIZE, STATE, WRIST, save_policy  # noqa: E402

from robomme_interference_data.errors import (  # noqa: E402
    HubError,
    InvalidOptionError,
    MissingFileError,
    PolicyError,
)
from robomme_interference_data.evaluate.policies.base import RolloutInfo  # noqa: E402
from robomme_interference_data.evaluate.policies.lerobot import LeRobotPolicy  # noqa: E402
from robomme_interference_data.evaluate.policies.lerobot_files import digest_files  # noqa: E402
from robomme_interference_data.evaluate.policies.registry import make_policy, pin_policy  # noqa: E402
from robomme_interference_data.simulators.base import Observation  # noqa: E402

SEED = 5

pytestmark = pytest.mark.filterwarnings("ignore:To evaluate in the environment, your VQ-BeT")


@pytest.fixture(autouse=True, scope="module")
def _one_thread() -> Iterator[None]:
    """Models this small are slower on several threads, and much slower on a busy machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def act(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_policy(tmp_path_factory.mktemp("act"), "act")


@pytest.fixture(scope="module")
def vqbet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_policy(tmp_path_factory.mktemp("vqbet"), "vqbet", (FRONT,))


@cache
def section(start: int, stop: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Made-up frames and states, each number its own."""
    frames = {"front": [], "wrist": []}
    states = []
    for number in range(start, stop):
        draw = np.random.default_rng(number)
        for part in frames.values():
            coarse = draw.integers(0, 256, (8, 8, 3), dtype=np.uint8)
            part.append(coarse.repeat(SIZE // 8, 0).repeat(SIZE // 8, 1))
        states.append(draw.normal(size=8).astype(np.float32))
    return {name: np.stack(part) for name, part in frames.items()}, np.stack(states)


def observation(number: int) -> Observation:
    frames, states = section(number, number + 1)
    return Observation({name: part[0] for name, part in frames.items()}, states[0])


def only(cameras: tuple[str, ...], frames: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: frames[name] for name in cameras}


def play(policy: Any, history: int, live: list[int]) -> list[np.ndarray]:
    """Give history in two chunks, then live frames; return the actions of each time."""
    policy.reset(RolloutInfo("pick the cube", history, SEED))
    if policy.wants_history and history:
        for start, stop in [(0, history // 2), (history // 2, history)]:
            if stop > start:
                frames, states = section(start, stop)
                policy.add_history(only(policy.history_cameras, frames), states, history)
    at, actions = history, []
    for count in live:
        frames, states = section(at, at + count)
        policy.observe(only(policy.cameras, frames), states)
        at += count
        actions.append(policy.act(observation(at - 1), "pick the cube"))
    return actions


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
    policy = make_policy(f"lerobot:{act}", device="cpu")
    assert policy.metadata() == {
        "policy": "lerobot",
        "source": str(act),
        "sha256": digest_files(act),
        "type": "act",
        "n_obs_steps": 1,
        "device": "cpu",
    }
    policy.close()


def test_asked_twice_it_looks_at_the_observation_again(act: Path) -> None:
    policy = LeRobotPolicy(str(act), device="cpu")
    (first,) = play(policy, 0, [1])
    np.testing.assert_array_equal(policy.act(observation(0), "pick the cube"), first)


# --- what does not fit -------------------------------------------------------------------------


def edit(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    path = folder / "config.json"
    config = json.loads(path.read_text(encoding="utf-8"))
    change(config)
    path.write_text(json.dumps(config), encoding="utf-8")


def rename(config: dict[str, Any]) -> None:
    config["input_features"]["observation.images.top"] = config["input_features"].pop(WRIST)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (rename, "wants observation.images.top (3, 256, 256), which the simulators do not give"),
        (
            lambda config: config["input_features"][FRONT].update(shape=[3, 96, 96]),
            "wants observation.images.front of shape (3, 96, 96); the simulators give "
            "(3, 256, 256)",
        ),
        (
            lambda config: config["input_features"][STATE].update(shape=[6]),
            "wants observation.state of shape (6,); the simulators give (8,)",
        ),
        (
            lambda config: config["output_features"][ACTION].update(shape=[7]),
            "gives actions {'action': (7,)}; the simulators take action (8,)",
        ),
        (lambda config: config.update(use_peft=True), "is an adapter (PEFT)"),
        (lambda config: config.update(type="nonesuch"), "Policy type 'nonesuch'"),
        (lambda config: config.update(chunk_size=1), "LeRobot cannot load the policy"),
    ],
)
def test_what_does_not_fit_is_refused_when_it_is_made(
    act: Path, tmp_path: Path, change: Callable[[dict[str, Any]], object], words: str
) -> None:
    folder = shutil.copytree(act, tmp_path / "policy")
    edit(folder, change)
    with pytest.raises(PolicyError) as raised:
        LeRobotPolicy(str(folder), device="cpu")
    assert words in raised.value.message
    assert raised.value.hint


def test_renamed_observations_fit(tmp_path: Path) -> None:
    top = "observation.images.top"
    folder = save_policy(tmp_path, "act", (top,))
    path = folder / "policy_preprocessor.json"
    settings = json.loads(path.read_text(encoding="utf-8"))
    for step in settings["steps"]:
        if "rename_map" in step["config"]:
            step["config"]["rename_map"] = {FRONT: top}
    path.write_text(json.dumps(settings), encoding="utf-8")
    policy = LeRobotPolicy(str(folder), device="cpu")
    assert policy.cameras == ("front",)
    assert play(policy, 0, [1])[0].shape == (16, 8)


@pytest.mark.parametrize(
    "name",
    ["config.json", "model.safetensors", "policy_preprocessor.json", "policy_postprocessor.json"],
)
def test_a_missing_file_is_named(act: Path, tmp_path: Path, name: str) -> None:
    folder = shutil.copytree(act, tmp_path / "policy")
    (folder / name).unlink()
    with pytest.raises(MissingFileError, match=f"{name} missing in"):
        LeRobotPolicy(str(folder), device="cpu")


def test_weights_of_another_model_are_refused(act: Path, vqbet: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(act, tmp_path / "policy")
    shutil.copy(vqbet / "model.safetensors", folder / "model.safetensors")
    policy = LeRobotPolicy(str(folder), device="cpu")
    with pytest.raises(PolicyError, match="LeRobot cannot load the policy"):
        policy.reset(RolloutInfo("x", 0, 0))


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match=r"there is no folder '.*/none'"):
        LeRobotPolicy(str(tmp_path / "none"))
    with pytest.raises(HubError, match="the model 'nobody/nothing' is not in the cache"):
        LeRobotPolicy("nobody/nothing")


def test_a_model_of_the_hub_is_recorded_with_its_commit(
    act: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commit = "0123456789abcdef0123456789abcdef01234567"
    snapshot = shutil.copytree(act, tmp_path / "snapshots" / commit)
    asked: list[tuple[str, str | None]] = []

    def download(repo_id: str, revision: str | None = None, **options: Any) -> str:
        asked.append((repo_id, revision))
        return str(snapshot)

    monkeypatch.setattr("huggingface_hub.snapshot_download", download)
    assert LeRobotPolicy("me/act", device="cpu").metadata()["source"] == f"me/act@{commit}"
    # A run asks once what a branch or tag stands for; its workers then ask for the commit.
    assert pin_policy("lerobot:me/act@v1") == f"lerobot:me/act@{commit}"
    policy = make_policy(f"lerobot:me/act@{commit}", device="cpu")
    assert policy.metadata()["source"] == f"me/act@{commit}"
    assert asked == [("me/act", None), ("me/act", "v1"), ("me/act", commit)]
    assert pin_policy(f"lerobot:{act}") == f"lerobot:{act}"
    with pytest.raises(MissingFileError, match="there is no folder 'me/act@'"):
        pin_policy("lerobot:me/act@")


def test_the_digest_is_over_weights_and_configuration(act: Path, tmp_path: Path) -> None:
    def digest(folder: Path) -> str:
        return str(LeRobotPolicy(str(folder), device="cpu").metadata()["sha256"])

    copy = shutil.copytree(act, tmp_path / "elsewhere")
    (copy / "README.md").write_text("another card")
    assert digest(copy) == digest(act)
    weights = copy / "model.safetensors"
    data = bytearray(weights.read_bytes())
    data[-1] ^= 1  # in the last weight
    weights.write_bytes(data)
    changed = digest(copy)
    assert changed != digest(act)
    settings = copy / "config.json"
    settings.write_text(settings.read_text() + "\n")
    assert len({changed, digest(copy), digest(act)}) == 3


def test_the_digest_is_sha256_of_names_and_digests(tmp_path: Path) -> None:
    (tmp_path / "model.safetensors").write_bytes(b"weights")
    (tmp_path / "config.json").write_bytes(b"{}")
    (tmp_path / "notes.txt").write_bytes(b"not read")
    lines = "".join(
        f"{name}\0{hashlib.sha256(data).hexdigest()}\n"
        for name, data in (("config.json", b"{}"), ("model.safetensors", b"weights"))
    )
    assert digest_files(tmp_path) == hashlib.sha256(lines.encode()).hexdigest()


def test_options_that_do_not_apply(act: Path) -> None:
    for device in ("cuda:99", "tpu", "cpu:1", "cuda:x"):
        with pytest.raises(InvalidOptionError, match=f"there is no device '{device}'"):
            LeRobotPolicy(str(act), device=device)


def test_actions_that_are_not_numbers_are_refused(act: Path) -> None:
    policy = LeRobotPolicy(str(act), device="cpu")
    policy.reset(RolloutInfo("x", 0, 0))
    with torch.no_grad():
        for weight in policy._model.parameters():
            weight.fill_(float("nan"))
    policy.observe(*section(0, 1))
    with pytest.raises(PolicyError, match="not finite"):
        policy.act(observation(0), "x")


def test_the_saved_policies_are_always_the_same(tmp_path: Path) -> None:
    for name in ("one", "other"):
        save_policy(tmp_path / name, "act", (FRONT,))
    one, other = ((tmp_path / name / "model.safetensors").read_bytes() for name in ("one", "other"))
    assert one == other
    assert lerobot_policies.SMALL.keys() == {"act", "vqbet", "diffusion"}


@pytest.mark.slow
def test_a_policy_trained_on_built_demonstrations_acts(tmp_path: Path) -> None:
    import factories
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.policies.factory import (
        get_policy_class,
        make_policy_config,
        make_pre_post_processors,
    )

    from robomme_interference_data.build_dataset.sample import write_sample

    families = ("MoveCube", "PatternLock")
    for _ in write_sample(
        tmp_path / "rec", families=families, train=1, test=1, size=SIZE, demonstration=20
    ):
        pass
    factories.build("frames", tmp_path / "rec", tmp_path / "demonstrations", split="test")
    config = make_policy_config(
        "act",
        device="cpu",
        push_to_hub=False,
        pretrained_backbone_weights=None,
        **lerobot_policies.features(),
        **lerobot_policies.SMALL["act"],
    )
    dataset = LeRobotDataset(
        "local/demonstrations",
        root=tmp_path / "demonstrations",
        delta_timestamps={ACTION: [step / 10 for step in config.action_delta_indices]},
        video_backend="pyav",
    )
    before, after = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    model = get_policy_class("act")(config).train()
    optimizer = torch.optim.AdamW(model.parameters(), 1e-3)
    losses = []
    batch = before(torch.utils.data.default_collate([dataset[index] for index in range(4)]))
    for _ in range(5):
        loss, _ = model.forward(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0]
    folder = tmp_path / "policy"
    for part in (model, before, after):
        part.save_pretrained(folder)
    (actions,) = play(make_policy(f"lerobot:{folder}", device="cpu"), 0, [1])
    assert actions.shape == (16, 8)
