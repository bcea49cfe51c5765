"""LeRobot policies that do not fit are refused; the files that a policy is known by."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("lerobot")

from support import lerobot_policies  # noqa: E402
from support.lerobot_policies import (  # noqa: E402
    ACTION,
    FRONT,
    STATE,
    WRIST,
    edit,
    play,
    save_policy,
)

from robomme_interference_data.errors import (  # noqa: E402
    HubError,
    InvalidOptionError,
    MissingFileError,
    PolicyError,
)
from robomme_interference_data.evaluate.policies.base import RolloutInfo  # noqa: E402
from robomme_interference_data.evaluate.policies.lerobot import (  # noqa: E402
    LeRobotPolicy,
    find_policy,
)
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
    with pytest.raises(InvalidOptionError, match="neither a folder nor a model repository"):
        LeRobotPolicy(str(tmp_path / "none"))
    with pytest.raises(HubError, match="not in the cache"):
        LeRobotPolicy("nobody/nothing")


def test_a_model_of_the_hub_is_known_by_its_commit(
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
    assert find_policy("me/act") == (snapshot, f"me/act@{commit}")
    # A run asks once what a branch or tag stands for; its workers then ask for the commit.
    assert pin_policy("lerobot:me/act@v1") == f"lerobot:me/act@{commit}"
    policy = make_policy(f"lerobot:me/act@{commit}", ["device=cpu"])
    assert policy.metadata()["source"] == f"me/act@{commit}"
    assert pin_policy(f"lerobot:{act}") == f"lerobot:{act}"


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


def test_devices_that_are_not_there(act: Path) -> None:
    for device in ("cuda:99", "tpu", "cpu:1", "cuda:x"):
        with pytest.raises(InvalidOptionError, match=f"'{device}' is none of cpu"):
            LeRobotPolicy(str(act), device=device)
