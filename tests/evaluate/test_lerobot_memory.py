"""LeRobot policies with a memory: what they get in rollouts, with the example's plug-in."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.buffer_sets import copy_buffer_set, plan_again
from support.lazy import lazy
from support.messages import raises
from support.runs import config, run
from support.worlds import BUFFER_SET

from robomme_interference_data import load_buffer_set
from robomme_interference_data.constants import FRONT, STATE, WRIST
from robomme_interference_data.errors import PolicyError
from robomme_interference_data.evaluate.policies.policy import RolloutInfo
from robomme_interference_data.evaluate.rollout.rollout import run_rollout
from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.evaluate.run.worker import RunContext
from robomme_interference_data.evaluate.systems import SystemFacts
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.simulators.recordings import Recordings
from robomme_interference_data.training import HistoryDataset

torch, _ = lazy("torch"), lazy("lerobot")
lerobot = lazy("robomme_interference_data.evaluate.policies.lerobot.policy")
small = lazy("support.lerobot_policies")

EPISODE = EpisodeId("MoveCube", "test", 0)
GOAL = "pick the cube"
MEMORY_STATE = "observation.memory.state"


@pytest.fixture(scope="module")
def history(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small.save_policy(tmp_path_factory.mktemp("history"), "history_act")


def made(folder: Path) -> Any:
    return lerobot.LeRobotPolicy(str(folder), device="cpu")


def watch(policy: Any) -> list[dict[str, Any]]:
    """Note the batches that a policy's model gets."""
    policy._load()
    batches, predict = [], policy._model.predict_action_chunk
    policy._model.predict_action_chunk = lambda batch: batches.append(batch) or predict(batch)
    return batches


def as_lerobot(batch: dict[str, Any]) -> dict[str, Any]:
    """Entries of a batch of `HistoryDataset` as a policy of LeRobot takes them."""
    found = {name: batch[name] for name in (STATE, FRONT, WRIST, "task")}
    found["observation.position"] = batch["position"]
    for name in ("state", "position", "images.front", "images.wrist"):
        found[f"observation.memory.{name}"] = batch[f"memory.{name}"]
    found["observation.memory.padding"] = batch["memory.is_pad"]
    for name, values in found.items():
        if "images" in name:
            found[name] = values.to(torch.float32) / 255
    return found


# --- input -------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "memory, condition", [("framesamp:4", "no-history"), ("window:2@2.5", "before-k3")]
)
def test_the_model_gets_what_an_item_of_training_holds(
    history: Path,
    executed_buffers: Path,
    memory: str,
    condition: str,
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    root = tmp_path_factory.getbasetemp() / "same"
    if not root.exists():
        plan_again(copy_buffer_set(root, executed_buffers), ("no-history", "before-k3"))
    monkeypatch.setenv(BUFFER_SET, str(root))
    folder = shutil.copytree(history, root.parent / f"{memory}{condition}".replace(":", "-"))
    small.edit(folder, lambda settings: settings.update(memory=memory))
    policy, buffer_set = made(folder), load_buffer_set(root)
    assert (policy.memory, policy.wants_history, policy.every_frame) == (memory, True, True)
    assert policy.cameras == policy.history_cameras == ("front", "wrist")
    batches = watch(policy)
    run_rollout(
        RunContext(config(), "mine", SystemFacts(), buffer_set.name, buffer_set.revision),
        WorkItem(condition, EPISODE),
        simulator=Recordings(str(root), policy.cameras),
        policy=policy,
        buffer_set=buffer_set,
    )
    data = HistoryDataset(
        buffer_set,
        [condition],
        split="test",
        memory=memory,
        cameras=policy.cameras,
        image_size=24,
        cache=tmp_path_factory.getbasetemp() / "store",
        quiet=True,
    )
    before = small.loaded(folder)[1]
    assert len(batches) == 14  # one for 16 of the 209 actions
    for number, batch in enumerate(batches):
        expected = before(as_lerobot(data[[data.index_of(EPISODE, 16 * number)]]))
        seen = {name for name in batch if name.startswith("observation.")}
        assert seen == {name for name in expected if name.startswith("observation.")}
        for name in seen:
            assert batch[name].dtype == expected[name].dtype
            assert torch.equal(batch[name], expected[name]), name


@pytest.mark.usefixtures("world")
def test_it_runs_under_every_condition(history: Path, tmp_path: Path) -> None:
    result = run(
        tmp_path / "run",
        policy=f"lerobot:{history}",
        policy_options=("device=cpu",),
        families=("MoveCube",),
        conditions=("no-history", "k0", "k3"),
    )
    found = {row.condition: row for row in result.rows}
    assert {name: row.history_frames for name, row in found.items()} == {
        "no-history": 0,
        "k0": 48,
        "k3": 48 + 3 * 32,
    }
    assert {(row.status, row.memory) for row in result.rows} == {("fail", "framesamp:4")}


def test_a_full_memory_has_no_places_to_pad(history: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(history, tmp_path / "full")
    small.edit(folder, lambda settings: settings.update(memory="full"))
    policy = made(folder)
    batches = watch(policy)
    small.play(policy, 2, [1, 4])
    assert [batch[MEMORY_STATE].shape for batch in batches] == [(1, 2, 8), (1, 6, 8)]
    assert not any(batch["observation.memory.padding"].any() for batch in batches)


# --- sessions ----------------------------------------------------------------------------------


def test_sessions_with_their_own_memories_act_in_one_batch(history: Path) -> None:
    policy, alone = made(history), made(history)
    sessions, lengths, seen = [policy.session() for _ in range(3)], (0, 2, 7), []
    batches = watch(policy)
    for number, (session, length) in enumerate(zip(sessions, lengths, strict=True)):
        session.reset(RolloutInfo(GOAL, length, small.SEED))
        start = 10 * number
        if length:
            session.add_history(*small.section(start, start + length), length)
        session.observe(*small.section(start + length, start + length + 1))
        seen.append(small.observation(start + length))
    found = policy.act_batch(sessions, seen, [GOAL] * 3)
    (batch,) = batches
    assert batch["observation.position"].tolist() == [0, 2, 7]
    # framesamp:4 of 8 frames, the last of which is the current one.
    assert batch["observation.memory.position"].tolist() == [[0, 0, 0], [0, 1, 0], [0, 2, 4]]
    assert batch["observation.memory.padding"].sum(1).tolist() == [3, 1, 0]
    for number, length in enumerate(lengths):
        alone.reset(RolloutInfo(GOAL, length, small.SEED))
        for at in range(10 * number, 10 * number + length + 1):
            alone.observe(*small.section(at, at + 1))
        expected = alone.act(seen[number], GOAL)
        assert found[number].shape == (16, 8)
        np.testing.assert_allclose(found[number], expected, rtol=1e-4, atol=1e-5)


# --- policies that do not fit ------------------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        lambda settings: settings.update(memory="fifo:4"),
        lambda settings: settings["input_features"][MEMORY_STATE].update(shape=[7]),
        lambda settings: settings["input_features"][FRONT].update(shape=[3, 256, 256]),
        lambda settings: settings.update(image_size=32),
        lambda settings: settings["input_features"].pop(MEMORY_STATE),
    ],
    ids=["rule", "state", "view", "size", "feature"],
)
def test_policies_with_a_memory_that_do_not_fit(
    history: Path, tmp_path: Path, change: Callable[[dict[str, Any]], object]
) -> None:
    folder = shutil.copytree(history, tmp_path / "policy")
    small.edit(folder, change)
    with raises(PolicyError):
        made(folder).reset(RolloutInfo(GOAL, 0, 0))


def test_a_memory_without_statistics_is_an_error(history: Path, tmp_path: Path) -> None:
    folder, statistics = shutil.copytree(history, tmp_path / "policy"), small.stats((FRONT, WRIST))
    del statistics[MEMORY_STATE]
    small.save_processors(folder, small.loaded(history)[0].config, statistics)
    with raises(PolicyError):
        made(folder)
