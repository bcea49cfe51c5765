"""The example `examples/memory_policy`: it trains, resumes, answers, and acts in rollouts."""

import csv
import json
import re
import shutil
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from support.messages import raises
from support.retrieval import make_index
from support.tabletop import TABLETOP
from support.worlds import BUFFER_SET

from robomme_interference_data import load_buffer_set
from robomme_interference_data.evaluate import RunConfig, run_evaluation
from robomme_interference_data.evaluate.score.rows.reading import read_rows
from robomme_interference_data.runtime.executor import Serial

EXAMPLE = Path(__file__).parents[2] / "examples" / "memory_policy"
SMALL = ("--image-size", "16", "--batch", "4", "--device", "cpu", "--split", "test")


@pytest.fixture(autouse=True)
def example(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Make the example's modules importable, as if one stood in its folder."""
    monkeypatch.syspath_prepend(str(EXAMPLE))
    yield
    for name in ("train", "answer", "command_line", "memory_model", "memory_policy"):
        sys.modules.pop(name, None)


@pytest.fixture
def program(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run one of the example's programs in this process."""

    def call(name: str, *arguments: object) -> None:
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *map(str, arguments)])
        __import__(name)
        module = sys.modules[name]
        module.run(module.main, module.arguments())

    return call


def weights(run: Path) -> dict[str, torch.Tensor]:
    from safetensors.torch import load_file

    return load_file(run / "model.safetensors")


def test_actions_need_not_have_the_size_of_states() -> None:
    """A robot with 11 state and 10 action values: the first guess is the mean action."""
    from memory_model import Config, MemoryModel

    def batch(items: int) -> dict[str, Any]:
        return {
            "observation.state": torch.randn(items, 11),
            "action": 5 + torch.randn(items, 4, 10),
            "action_is_pad": torch.zeros(items, 4, dtype=torch.bool),
            "memory.state": torch.randn(items, 3, 11),
            "memory.position": torch.arange(3).expand(items, -1),
            "memory.is_pad": torch.zeros(items, 3, dtype=torch.bool),
            "position": torch.full((items,), 3),
            "task": ["place the cup"] * items,
        }

    torch.manual_seed(0)
    sizes = {"state": 11, "action": 10, "chunk": 4, "image_size": 16}
    model = MemoryModel(Config(task="act", data="", memory="full", cameras=(), **sizes))
    model.fit_scales(batch(64))
    actions = model(batch(2))
    assert actions.shape == (2, 4, 10)
    assert abs(actions.mean().item() - 5) < 0.5


@pytest.mark.parametrize(
    ("positions", "before", "between"),  # whether what is moved by this changes the actions
    [("both", True, True), ("absolute", True, False), ("relative", False, True)],
)
def test_from_where_frames_are_counted(positions: str, before: bool, between: bool) -> None:
    """Sessions before the lesson move memory and now; sessions after it move now alone."""
    from memory_model import Config, MemoryModel

    def actions(memory_moved: int, now_moved: int) -> torch.Tensor:
        batch = {
            "observation.state": torch.zeros(1, 8),
            "memory.state": torch.zeros(1, 3, 8),
            "memory.position": memory_moved + torch.arange(3)[None],
            "memory.is_pad": torch.zeros(1, 3, dtype=torch.bool),
            "position": torch.tensor([3 + now_moved]),
            "task": ["place the cup"],
        }
        return model(batch)

    torch.manual_seed(0)
    config = Config(task="act", data="", memory="full", cameras=(), image_size=16)
    model = MemoryModel(replace(config, positions=positions)).eval()
    here = actions(0, 0)
    assert torch.equal(here, actions(224, 224)) is not before
    assert torch.equal(here, actions(0, 224)) is not between
    model = MemoryModel(replace(config, positions="shifted"))
    assert not torch.equal(actions(0, 0), actions(0, 0))  # moved at random, in training alone
    model.eval()
    assert torch.equal(actions(0, 0), actions(0, 0))


@pytest.mark.slow
def test_it_learns_to_answer_and_writes_rows(
    program: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of six golden lessons: their frames are of one color each, so not all can be told apart."""
    run, families = tmp_path / "run", ("VideoRepick", "MoveCube", "InsertPeg")
    options = ("--conditions", "k0", "--steps", 140, "--families", ",".join(families))
    program("train", TABLETOP, "--out", run, *options, *SMALL, "--batch", 6, "--seed", 3)
    with (run / "log.csv").open() as file:
        log = [*csv.DictReader(file)]
    assert [line["step"] for line in log] == ["20", "40", "60", "80", "100", "120", "140"]
    first, last = float(log[0]["loss"]), float(log[-1]["loss"])
    assert last < 0.75 * first < 1.2  # guessing: about 1.3
    out = tmp_path / "rows.csv"
    program("answer", run, TABLETOP, "--system", "learned-k0", "--out", out)
    rows = read_rows([out]).rows
    assert len(rows) == 3 * 18 and {row.model_seed for row in rows} == {3}
    assert {row.training_step for row in rows} == {140}
    assert "not finished" not in capsys.readouterr().err
    config = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps(config | {"training_steps": 200}))
    assert {row.condition for row in rows} == {"no-history", "k0", "k1"}
    assert {row.revision for row in rows} == {load_buffer_set(TABLETOP).revision}
    seen = [row.success for row in rows if row.condition == "k0" and row.family in families]
    assert sum(map(bool, seen)) >= 4  # by chance about 2 of 6
    assert {row.evidence_kept for row in rows if row.condition == "k0"} == {1.0}
    assert {row.evidence_kept for row in rows if row.condition == "no-history"} == {None}
    retrieved = tmp_path / "retrieved.csv"
    indexed = tmp_path / "indexed"
    shutil.copytree(TABLETOP, indexed)
    make_index(indexed)
    options = ("--retrieval", "thumbnail", "--system", "learned-k0-retrieval")
    program("answer", run, indexed, *options, "--out", retrieved)
    rows = read_rows([retrieved]).rows
    assert {row.condition for row in rows} == {"k0", "k1"}  # no-history does not apply
    assert {row.retrieval for row in rows} == {"thumbnail/max/adaptive"}
    assert "not finished, step 140 of 200" in capsys.readouterr().err


@pytest.mark.slow
def test_an_interrupted_run_ends_like_another(
    program: Any, executed_buffers: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = ("--task", "act", "--conditions", "k0=2,k3", "--steps", 6, "--save-every", 2)
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    program("train", executed_buffers, "--out", whole, *settings, *SMALL)
    step, taken = sys.modules["train"].train_step, []

    def interrupted(*given: Any) -> Any:
        if len(taken) == 3:
            raise KeyboardInterrupt
        taken.append(1)
        return step(*given)

    monkeypatch.setattr(sys.modules["train"], "train_step", interrupted)
    with raises(SystemExit):
        program("train", executed_buffers, "--out", parts, *settings, *SMALL)
    kept = json.loads((parts / "config.json").read_text())
    assert (kept["training_step"], kept["training_steps"]) == (2, 6)
    monkeypatch.setattr(sys.modules["train"], "train_step", step)
    with raises(SystemExit):
        program("train", executed_buffers, "--out", parts, *settings, *SMALL, "--seed", 1)
    program("train", executed_buffers, "--out", parts, *settings, *SMALL)
    expected, found = weights(whole), weights(parts)
    assert all(torch.equal(expected[name], found[name]) for name in expected)
    for name in ("model.safetensors", "config.json", "log.csv"):  # the state restores them
        (parts / name).unlink()
    program("train", executed_buffers, "--out", parts, *settings, *SMALL)
    for name in ("model.safetensors", "config.json"):
        assert (parts / name).read_bytes() == (whole / name).read_bytes()
    assert (parts / "log.csv").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("trunk, memory", [("transformer", "framesamp:8"), ("gru", "full")])
def test_the_trained_policy_in_rollouts(
    trunk: str,
    memory: str,
    program: Any,
    executed_buffers: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run = tmp_path / "run"
    options = ("--task", "act", "--trunk", trunk, "--memory", memory, "--steps", 2, "--chunk", 8)
    program("train", executed_buffers, "--out", run, "--conditions", "k1", *options, *SMALL)
    monkeypatch.setenv(BUFFER_SET, str(executed_buffers))
    config = RunConfig(
        policy="python:memory_policy:MemoryPolicy",
        policy_options=(f"checkpoint={run}", "device=cpu"),
        buffer_set=executed_buffers,
        out=tmp_path / "results",
        simulator="support.worlds:World",
        system="learned",
        conditions=("no-history", "k1"),
        families=("MoveCube",),
    )
    result = run_evaluation(config, executor=Serial())
    assert result.counts == {"success": 0, "fail": 2, "timeout": 0, "error": 0}


def test_a_checkpoint_of_the_other_task(
    program: Any, executed_buffers: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    program("train", executed_buffers, "--out", run, "--task", "act", "--steps", 1, *SMALL)
    with raises(SystemExit):
        program("answer", run, TABLETOP, "--system", "x", "--out", tmp_path / "rows.csv")
    with raises(SystemExit):
        program("answer", tmp_path, TABLETOP, "--system", "x", "--out", tmp_path / "rows.csv")


PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "train-a-policy.md"


def test_the_pages_commands_and_its_example(
    executed_buffers: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = re.sub(r" *\\\n *", " ", PAGE.read_text())
    lines = re.findall(r"^python examples/memory_policy/(\w+)\.py (.*)$", text, flags=re.M)
    assert {name for name, _ in lines} == {"train", "answer"}
    for name, line in lines:
        monkeypatch.setattr(sys, "argv", [name, *line.split()])
        __import__(name)
        assert sys.modules[name].arguments().out
    [code] = re.findall(r"<!-- example: train -->\n```python\n(.*?)```", text, flags=re.S)
    (tmp_path / "my-training").symlink_to(executed_buffers)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(code.replace("image_size=96", 'image_size=16, split="test"'), names)  # of 32 pixels
    item = names["item"]
    assert item["memory.images.front"].shape == (31, 3, 16, 16) and item["action"].shape == (16, 8)


@pytest.mark.parametrize(
    "options",
    [
        ("--image-size", "65"),
        ("--batch", "0"),
        ("--steps", "0"),
        ("--chunk", "0"),
        ("--save-every", "x"),
        ("--conditions", "k1=x"),
        ("--conditions", "k0,k0=3"),
        ("--noise", "-1"),
        ("--learning-rate", "nan"),
        ("--workers", "-1"),
        ("--seed", "99999999999"),
        ("--device", "nowhere"),
    ],
)
def test_wrong_options_are_one_line(
    options: tuple[str, ...], program: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        program("train", TABLETOP, "--out", tmp_path / "run", *options)
    assert f"argument {options[0]}" in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_what_a_run_must_not_do(program: Any, tmp_path: Path) -> None:
    options = ("--conditions", "k0", "--families", "MoveCube", "--steps", 9, *SMALL)
    with raises(SystemExit):
        program("train", TABLETOP, "--out", tmp_path / "run", *options, "--learning-rate", 1e10)
    (tmp_path / "notes.txt").touch()
    with raises(SystemExit):
        program("train", TABLETOP, "--out", tmp_path, *options)
    rows = tmp_path / "rows.csv"
    rows.touch()
    with raises(SystemExit):
        program("answer", tmp_path, TABLETOP, "--system", "x", "--out", rows)


@pytest.mark.slow
@pytest.mark.parametrize("places", [1, 3])
def test_questions_with_other_points(places: int, program: Any, tmp_path: Path) -> None:
    """Padding of another buffer set changes no score; points beyond the model's are cut."""
    run = tmp_path / "run"
    options = ("--conditions", "k0", "--families", "MoveCube", "--steps", 1, *SMALL)
    program("train", TABLETOP, "--out", run, *options)
    model = sys.modules["memory_model"].load_checkpoint(run)
    data = sys.modules["train"].HistoryDataset(
        TABLETOP, ["k0"], split="test", image_size=16, chunk=0, questions=True, quiet=True
    )
    batch = data[[*range(len(data))]]
    trained = batch["question.points"].shape[2]
    assert trained == model.config.points
    whole = model(batch)
    batch["question.points"] = torch.nn.functional.pad(
        batch["question.points"], (0, 0, 0, places), value=0.5
    )
    batch["question.point_is_pad"] = torch.nn.functional.pad(
        batch["question.point_is_pad"], (0, places), value=True
    )
    assert torch.equal(model(batch), whole)
    fewer = {**batch, "question.points": batch["question.points"][:, :, :1]}
    fewer["question.point_is_pad"] = batch["question.point_is_pad"][:, :, :1]
    assert model(fewer).shape == whole.shape


def test_scores_do_not_depend_on_the_rest_of_the_batch(program: Any, tmp_path: Path) -> None:
    """Histories of two lengths, questions with more and fewer options, all frames in memory."""
    run = tmp_path / "run"
    options = ("--conditions", "k0", "--memory", "full", "--no-attention-dropout", "--steps", 1)
    program("train", TABLETOP, "--out", run, *options, *SMALL)
    model = sys.modules["memory_model"].load_checkpoint(run)
    assert {layer.self_attn.dropout for layer in model.trunk.layers} == {0}
    data = sys.modules["train"].HistoryDataset(
        TABLETOP,
        ["k0", "k1"],
        split="test",
        memory="full",
        image_size=16,
        chunk=0,
        questions=True,
        quiet=True,
    )
    batch = data[[*range(len(data))]]
    frames, choices = (~batch["memory.is_pad"]).sum(1), (~batch["question.option_is_pad"]).sum(1)
    assert len({*frames.tolist()}) > 1 and len({*choices.tolist()}) > 1
    whole = model(batch)
    for index, choice in enumerate(choices.tolist()):
        torch.testing.assert_close(model(data[[index]])[0], whole[index], rtol=1e-3, atol=1e-4)
        assert whole[index].isneginf().sum() == whole.shape[1] - choice


def test_damaged_checkpoints(program: Any, tmp_path: Path) -> None:
    run, out = tmp_path / "run", ("--system", "x", "--out", tmp_path / "rows.csv")
    options = ("--conditions", "k0", "--families", "MoveCube", "--steps", 1, *SMALL)
    program("train", TABLETOP, "--out", run, *options)
    (run / "state.pt").write_bytes((run / "state.pt").read_bytes()[:100])
    with raises(SystemExit):
        program("train", TABLETOP, "--out", run, *options)
    (run / "model.safetensors").write_bytes(b"x")
    with raises(SystemExit):
        program("answer", run, TABLETOP, *out)
    (run / "config.json").write_text('{"task": "answer"}')
    with raises(SystemExit):
        program("answer", run, TABLETOP, *out)
