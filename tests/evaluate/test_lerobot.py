"""LeRobot policies: the same actions as in LeRobot's loop, and policies that do not fit."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.lazy import lazy
from support.messages import raises

from robomme_interference_data.constants import ACTION, FRONT, STATE, WRIST
from robomme_interference_data.errors import (
    HubError,
    InvalidOptionError,
    MissingFileError,
    PolicyError,
)
from robomme_interference_data.evaluate.policies.policy import RolloutInfo
from robomme_interference_data.evaluate.policies.registry import POLICIES, make_policy

torch, _ = lazy("torch"), lazy("lerobot")
lerobot = lazy("robomme_interference_data.evaluate.policies.lerobot.policy")
small = lazy("support.lerobot_policies")
pytestmark = pytest.mark.filterwarnings("ignore:To evaluate in the environment, your VQ-BeT")


@pytest.fixture(scope="module")
def act(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small.save_policy(tmp_path_factory.mktemp("act"), "act")


@pytest.fixture(scope="module")
def vqbet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small.save_policy(tmp_path_factory.mktemp("vqbet"), "vqbet", (FRONT,))


def made(folder: Path) -> Any:
    return lerobot.LeRobotPolicy(str(folder), device="cpu")


def window(before: Any, numbers: list[int]) -> dict[str, Any]:
    """The last observations as a model takes them, without any queue."""
    batches = [before(small.prepared(number)) for number in numbers]
    return {
        STATE: torch.stack([batch[STATE] for batch in batches], 1),
        "observation.images": torch.stack([batch[FRONT][:, None] for batch in batches], 1),
    }


# --- actions -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_act_acts_as_in_lerobots_loop(act: Path, tmp_path: Path) -> None:
    policy = made(act)
    assert (policy.wants_history, policy.every_frame, policy.privileged) == (False, False, False)
    assert (policy.cameras, policy.history_cameras) == (("front", "wrist"), ())
    found = small.play(policy, 0, [1, 1])
    model, before, after = small.loaded(act)
    for number in (0, 1):
        model.reset()
        expected = []
        for _ in range(16):  # of 20: more are never executed
            with torch.inference_mode():
                expected.append(
                    after(model.select_action(before(small.prepared(number)))).numpy()[0]
                )
        assert found[number].shape == (16, 8)
        assert found[number].dtype == np.float32
        np.testing.assert_allclose(found[number], np.stack(expected), rtol=1e-5, atol=1e-6)
    assert not np.allclose(found[0], found[1])
    # A smaller number of action steps counts.
    folder = shutil.copytree(act, tmp_path / "short")
    small.edit(folder, lambda config: config.update(n_action_steps=3))
    np.testing.assert_array_equal(small.play(made(folder), 0, [1])[0], found[0][:3])
    policy.close()


@pytest.mark.slow
def test_temporal_ensembling_returns_one_averaged_action(act: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(act, tmp_path / "ensemble")
    small.edit(folder, lambda config: config.update(n_action_steps=1, temporal_ensemble_coeff=0.01))
    chunk, found = small.play(made(act), 0, [1, 1]), small.play(made(folder), 0, [1, 1])
    assert [part.shape for part in found] == [(1, 8), (1, 8)]
    np.testing.assert_allclose(found[0][0], chunk[0][0], rtol=1e-5, atol=1e-6)
    # Second step: weights 1 for the older chunk and exp(-0.01) for the newer.
    weight = np.exp(-0.01)
    mean = (chunk[0][1] + weight * chunk[1][0]) / (1 + weight)
    np.testing.assert_allclose(found[1][0], mean, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_a_queue_is_filled_with_the_end_of_the_history(vqbet: Path) -> None:
    policy = made(vqbet)
    assert (policy.wants_history, policy.every_frame) == (True, True)
    assert (policy.cameras, policy.history_cameras) == (("front",), ("front",))
    model, before, after = small.loaded(vqbet)

    def check(found: np.ndarray, numbers: list[int], asked: int) -> None:
        torch.manual_seed((small.SEED << 16) + asked)
        with torch.inference_mode():
            chunk = model.vqbet(window(before, numbers), rollout=True)[0, :5]
            expected = np.stack([after(action[None]).numpy()[0] for action in chunk])
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)

    # The first live observation is number 6: history 5 comes before it.
    found = small.play(policy, 6, [1, 5, 1])
    for asked, numbers in enumerate([[5, 6], [10, 11], [11, 12]]):
        check(found[asked], numbers, asked)
    # Without history the first observation fills the queue.
    check(small.play(policy, 0, [1])[0], [0, 0], 0)


def test_diffusion_acts_as_its_model_for_the_window(tmp_path: Path) -> None:
    folder = small.save_policy(tmp_path, "diffusion", (FRONT,))
    found = small.play(made(folder), 3, [1])[0]
    model, before, after = small.loaded(folder)
    torch.manual_seed(small.SEED << 16)
    with torch.inference_mode():
        chunk = model.diffusion.generate_actions(window(before, [2, 3]))[0]
        expected = np.stack([after(action[None]).numpy()[0] for action in chunk])
    assert found.shape == (8, 8)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def test_rollouts_are_deterministic_and_leave_the_global_generator_alone(vqbet: Path) -> None:
    policy = made(vqbet)
    first = small.play(policy, 4, [1, 3])
    torch.manual_seed(99)
    state = torch.get_rng_state()
    second = small.play(policy, 4, [1, 3])
    assert torch.equal(torch.get_rng_state(), state)
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, other)
    # What came before in the history is in the queue, and makes a difference.
    assert not np.array_equal(first[0], small.play(policy, 3, [1])[0])


# --- sessions ----------------------------------------------------------------------------------


def play_together(policy: Any, count: int, rounds: int = 2) -> list[list[np.ndarray]]:
    """Let sessions act in batches, each on frames of its own; return the actions of each."""
    sessions = [policy.session() for _ in range(count)]
    actions: list[list[np.ndarray]] = [[] for _ in sessions]
    for number, session in enumerate(sessions):
        session.reset(RolloutInfo("pick the cube", 0, small.SEED + number))
    for at in range(rounds):
        seen = []
        for number, session in enumerate(sessions):
            frames, states = small.section(10 * number + at, 10 * number + at + 1)
            session.observe(frames, states)
            images = {name: part[0] for name, part in frames.items()}
            seen.append(lerobot.Observation(images, states[0]))
        chunks = policy.act_batch(sessions, seen, ["pick the cube"] * count)
        for own, chunk in zip(actions, chunks, strict=True):
            own.append(chunk)
    return actions


def play_alone(policy: Any, number: int, rounds: int = 2) -> list[np.ndarray]:
    """Play what session `number` plays, without others."""
    policy.reset(RolloutInfo("pick the cube", 0, small.SEED + number))
    actions = []
    for at in range(rounds):
        frames, states = small.section(10 * number + at, 10 * number + at + 1)
        policy.observe(frames, states)
        images = {name: part[0] for name, part in frames.items()}
        actions.append(policy.act(lerobot.Observation(images, states[0]), "pick the cube"))
    return actions


@pytest.mark.slow
def test_a_batch_of_sessions_acts_as_each_alone(act: Path) -> None:
    policy, alone = made(act), made(act)
    calls = []
    first = policy.session()
    predict = policy._model.predict_action_chunk
    policy._model.predict_action_chunk = lambda batch: calls.append(1) or predict(batch)
    for number, own in enumerate(play_together(policy, 3)):
        expected = play_alone(alone, number)
        assert [chunk.shape for chunk in own] == [(16, 8), (16, 8)]
        np.testing.assert_allclose(own, expected, rtol=1e-4, atol=1e-5)
    assert len(calls) == 2  # one forward pass for three sessions
    assert next(first._model.parameters()) is next(policy._model.parameters())
    np.testing.assert_array_equal(play_alone(first, 1), play_alone(alone, 1))


@pytest.mark.slow
def test_what_cannot_be_batched_acts_session_by_session(
    act: Path, vqbet: Path, tmp_path: Path
) -> None:
    """Queues of observations, temporal ensembling, and random draws: bit by bit as alone."""
    ensemble = shutil.copytree(act, tmp_path / "ensemble")
    change = {"n_action_steps": 1, "temporal_ensemble_coeff": 0.01}
    small.edit(ensemble, lambda config: config.update(change))
    for folder in (vqbet, ensemble):
        for number, own in enumerate(play_together(made(folder), 2)):
            np.testing.assert_array_equal(own, play_alone(made(folder), number))
    # One that draws is found out by its draws, whatever its type.
    policy, alone = made(act), made(act)
    for one in (policy, alone):
        one._load()
        model = one._model
        predict = model.predict_action_chunk
        model.predict_action_chunk = lambda batch, predict=predict: predict(batch) + torch.rand(1)
    for number, own in enumerate(play_together(policy, 2)):
        np.testing.assert_array_equal(own, play_alone(alone, number))


# --- policies that do not fit --------------------------------------------------------------------


def rename(config: dict[str, Any]) -> None:
    config["input_features"]["observation.images.top"] = config["input_features"].pop(WRIST)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (rename, "wants observation.images.top (3, 256, 256), which the simulators do not provide"),
        (
            lambda config: config["input_features"][FRONT].update(shape=[3, 96, 96]),
            "wants observation.images.front of shape (3, 96, 96)",
        ),
        (
            lambda config: config["output_features"][ACTION].update(shape=[7]),
            "gives actions {'action': (7,)}; the simulators take action (8,)",
        ),
        (lambda config: config.update(use_peft=True), "is an adapter (PEFT)"),
        (lambda config: config.update(type="nonesuch"), "has the type 'nonesuch'"),
        (lambda config: config.update(chunk_size=1), "LeRobot cannot load the policy"),
    ],
)
def test_policies_that_do_not_fit_are_errors(
    act: Path, tmp_path: Path, change: Callable[[dict[str, Any]], object], words: str
) -> None:
    folder = shutil.copytree(act, tmp_path / "policy")
    small.edit(folder, change)
    with pytest.raises(PolicyError) as raised:
        made(folder)
    assert words in raised.value.message
    assert raised.value.hint


@pytest.mark.parametrize("lacking", [STATE, ACTION])
def test_a_policy_without_statistics_is_an_error(act: Path, tmp_path: Path, lacking: str) -> None:
    folder, statistics = shutil.copytree(act, tmp_path / "policy"), small.stats((FRONT, WRIST))
    del statistics[lacking]
    small.save_processors(folder, small.loaded(act)[0].config, statistics)
    with raises(PolicyError):
        made(folder)


def test_renamed_observations_fit(tmp_path: Path) -> None:
    top = "observation.images.top"
    folder = small.save_policy(tmp_path, "act", (top,))
    path = folder / "policy_preprocessor.json"
    settings = json.loads(path.read_text(encoding="utf-8"))
    for step in settings["steps"]:
        if "rename_map" in step["config"]:
            step["config"]["rename_map"] = {FRONT: top}
    path.write_text(json.dumps(settings), encoding="utf-8")
    policy = made(folder)
    assert policy.cameras == ("front",)
    assert small.play(policy, 0, [1])[0].shape == (16, 8)


def test_missing_files_and_devices_are_errors(act: Path, vqbet: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(act, tmp_path / "policy")
    shutil.copy(vqbet / "model.safetensors", folder / "model.safetensors")  # of another model
    with pytest.raises(PolicyError) as raised:  # LeRobot lists the missing weights in any order
        made(folder).reset(RolloutInfo("x", 0, 0))
    assert raised.value.message.startswith(f"LeRobot cannot load the policy {folder}: ")
    for name in ("policy_postprocessor.json", "model.safetensors"):
        (folder / name).unlink()
        with raises(MissingFileError):
            made(folder)
    with raises(InvalidOptionError):
        made(tmp_path / "none")
    with raises(HubError):
        lerobot.LeRobotPolicy("nobody/nothing")
    for device in ("cuda:99", "tpu", "cuda:x"):
        with pytest.raises(InvalidOptionError):
            lerobot.LeRobotPolicy(str(act), device=device)


# --- identity ----------------------------------------------------------------------------------


def test_a_model_of_the_hub_is_identified_by_its_commit(
    act: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commit = "0123456789abcdef0123456789abcdef01234567"
    repository = tmp_path / "models--me--act"
    (repository / "refs").mkdir(parents=True)
    for name in ("main", "v1"):
        (repository / "refs" / name).write_text(commit)  # as the client keeps what it resolved
    snapshot = shutil.copytree(act, repository / "snapshots" / commit)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))

    def download(repo_id: str, revision: str, **options: Any) -> str:
        assert (repo_id, revision) == ("me/act", commit)
        return str(snapshot)

    monkeypatch.setattr("huggingface_hub.snapshot_download", download)
    assert lerobot.find_policy("me/act") == (snapshot, f"me/act@{commit}")
    # A run asks once what a branch or tag stands for; its workers then ask for the commit.
    assert POLICIES.pin("lerobot:me/act@v1") == f"lerobot:me/act@{commit}"
    policy = make_policy(f"lerobot:me/act@{commit}", ["device=cpu"])
    assert policy.metadata()["source"] == f"me/act@{commit}"
    assert POLICIES.pin(f"lerobot:{act}") == f"lerobot:{act}"


def test_a_checkpoint_reports_its_training(act: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(act, tmp_path / "000100" / "pretrained_model")
    facts = ("training_seed", "training_steps", "training_step")

    def reported() -> dict[str, int]:
        metadata = made(folder).metadata()
        return {name: metadata[name] for name in facts if name in metadata}

    assert reported() == {}
    # As `save_checkpoint` of LeRobot writes them.
    (folder / "train_config.json").write_text(json.dumps({"steps": 200, "seed": 1000}))
    assert reported() == {"training_seed": 1000, "training_steps": 200}
    state = folder.parent / "training_state"
    state.mkdir()
    (state / "training_step.json").write_text(json.dumps({"step": 100}))
    assert reported() == {"training_seed": 1000, "training_steps": 200, "training_step": 100}


def test_a_folder_is_identified_by_weights_and_configuration(act: Path, tmp_path: Path) -> None:
    metadata = make_policy(f"lerobot:{act}", ["device=cpu"]).metadata()
    digest = metadata.pop("sha256")
    assert metadata == {
        **{"policy": "lerobot", "source": str(act), "type": "act"},
        **{"n_obs_steps": 1, "device": "cpu"},
    }
    copy = shutil.copytree(act, tmp_path / "elsewhere")
    (copy / "README.md").write_text("another card")
    assert made(copy).metadata()["sha256"] == digest
    weights = copy / "model.safetensors"
    data = bytearray(weights.read_bytes())
    data[-1] ^= 1  # in the last weight
    weights.write_bytes(data)
    changed = made(copy).metadata()["sha256"]
    (copy / "config.json").write_text((copy / "config.json").read_text() + "\n")
    assert len({digest, changed, made(copy).metadata()["sha256"]}) == 3
