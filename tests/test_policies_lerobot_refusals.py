"""LeRobot policies that do not fit are refused; the files that a policy is known by."""

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("lerobot")

import lerobot_policies  # noqa: E402
from lerobot_policies import (  # noqa: E402
    ACTION,
    FRONT,
    STATE,
    WRIST,
    edit,
    observation,
    play,
    save_policy,
    section,
)

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

pytestmark = pytest.mark.filterwarnings("ignore:To evaluate in the environment, your VQ-BeT")

# The fixtures.
_one_thread = lerobot_policies.one_thread
act = lerobot_policies.act
vqbet = lerobot_policies.vqbet


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
