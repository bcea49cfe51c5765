"""Subgoals: what a model is shown, when they are written, who gets them, and their settings."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.chat_server import BROKEN, BUSY, CLOSED, EMPTY, GARBAGE, REFUSED, SLOW, ChatServer
from support.messages import raises
from support.own_policies import Told
from support.policy_server import PolicyServer
from support.runs import config, header, roll, run, run_one
from support.worlds import buffer_set_here

from robomme_interference_data import load_buffer_set
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    ModelError,
    RunError,
)
from robomme_interference_data.evaluate.language.images import HistoryFrames
from robomme_interference_data.evaluate.language.models import (
    ChatModel,
    Message,
    Part,
    Reply,
    Video,
)
from robomme_interference_data.evaluate.language.subgoal_prompt import SubgoalPrompt
from robomme_interference_data.evaluate.language.subgoal_settings import make_writer
from robomme_interference_data.evaluate.language.subgoal_writers import ModelWriter, OracleWriter
from robomme_interference_data.evaluate.policies.policy import RolloutInfo
from robomme_interference_data.evaluate.policies.registry import make_policy
from robomme_interference_data.evaluate.rollout.checks import check_policy, check_settings
from robomme_interference_data.evaluate.rollout.settings import check_system, default_system
from robomme_interference_data.evaluate.run.history import HistoryReader
from robomme_interference_data.runtime.executor import Executor, Serial
from robomme_interference_data.runtime.process import Processes
from robomme_interference_data.schema.subgoal import Subgoal
from robomme_interference_data.simulators.episode import Observation

pytestmark = pytest.mark.usefixtures("world", "fast_retries")

TOLD = "python:support.own_policies:Told"

# --- what a model is shown -----------------------------------------------------------------------


class Scripted(ChatModel):
    """Answers with one text after the other, and keeps the questions."""

    def __init__(self, *texts: str):
        self._texts = list(texts)
        self.asked: list[tuple[Part, ...]] = []

    def reply(self, messages: Sequence[Message]) -> Reply:
        assert [message.role for message in messages] == ["system", "user"]
        self.asked.append(messages[1].parts)
        return Reply(self._texts.pop(0), tokens=10, calls=2, seconds=0.5)

    def metadata(self) -> dict[str, Any]:
        return {"model": "scripted"}


def seen(number: int) -> Observation:
    """A live observation with its number in every pixel."""
    image = np.full((256, 256, 3), number, np.uint8)
    return Observation({"front": image}, np.zeros(8, np.float32))


def begun(model: ChatModel, condition: str = "k0", prompt: str = "grounded", **o: int) -> Any:
    buffer = buffer_set_here().load("MoveCube/test/0", condition)
    history = HistoryFrames(buffer, range(len(buffer)), HistoryReader(buffer_set_here().datasets))
    writer = ModelWriter(model, SubgoalPrompt.load(prompt), **o)
    writer.start(history, RolloutInfo("move it", len(buffer), 0), None)  # type: ignore[arg-type]
    return writer


def images(parts: Sequence[Part]) -> list[NDArray[np.uint8]]:
    return [part for part in parts if isinstance(part, np.ndarray)]


def written(writer: ModelWriter, number: int, step: int) -> Subgoal:
    writer.watch([seen(number)])
    return writer.next(seen(number), step)


def test_a_model_gets_an_even_sample_of_the_history_and_the_current_view() -> None:
    model = Scripted("pick it up at <500, 250>")
    writer = begun(model, frames=5)
    assert written(writer, 7, 0) == Subgoal("pick it up at <point>", ((128, 64),))
    [parts] = model.asked
    [video] = [part for part in parts if isinstance(part, Video)]
    frames = buffer_set_here().load("MoveCube/test/0", "k0").frames("front")
    # 48 frames: 0, 47/4 = 11.75, 23.5, 35.25, 47; 47 tenths of a second, 4 steps.
    assert np.array_equal(video.frames, frames[[0, 11, 23, 35, 47]])
    assert video.fps == pytest.approx(4 / 4.7)
    [now] = images(parts)
    assert now.max() == now.min() == 7
    assert "move it" in "".join(part for part in parts if isinstance(part, str))
    [turn] = writer.turns
    assert "[video of 5 frames]" in str(turn.prompt) and "[image]" in str(turn.prompt)


def test_the_history_has_the_pace_of_its_recordings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Dataset, "fps", 30.0)
    for frames, pace in ((5, 4 / (47 / 30)), (48, 30.0), (1, 30.0)):
        model = Scripted("go")
        written(begun(model, frames=frames), 0, 0)
        [video] = [part for part in model.asked[0] if isinstance(part, Video)]
        assert video.fps == pytest.approx(pace)


def test_without_history_the_prompt_has_the_word_none() -> None:
    model = Scripted("go")
    written(begun(model, "no-history"), 0, 0)
    [parts] = model.asked
    assert len(images(parts)) == 1 and not any(isinstance(part, Video) for part in parts)
    assert "none" in str(parts[0])


def test_earlier_subgoals_are_listed_once_each() -> None:
    model = Scripted("first at <0, 0>", "first at <500, 0>", "first", "second", "second")
    writer = begun(model)
    subgoals = [written(writer, number, 16 * number) for number in range(5)]
    # Listed again if a point is new, but not if it has moved.
    assert [one.points for one in subgoals] == [((0, 0),), ((128, 0),), (), (), ()]
    words = [str(parts[-1]) for parts in model.asked]
    assert "Steps so far" not in words[0]
    assert "Steps so far: 1. first at <0, 0>\n" in words[1]
    assert "Steps so far: 1. first at <0, 0>\n" in words[2]
    assert "Steps so far: 1. first at <0, 0>; 2. first\n" in words[3]
    assert "Steps so far: 1. first at <0, 0>; 2. first; 3. second\n" in words[4]


@pytest.mark.parametrize("text", ["", "at <1001, 0>"])
def test_an_answer_without_a_subgoal_keeps_the_last_one_and_is_counted(text: str) -> None:
    writer = begun(Scripted(text, "lift it", text))
    assert written(writer, 0, 0) == Subgoal("move it")  # at first, the goal
    assert written(writer, 1, 16) == written(writer, 2, 32) == Subgoal("lift it")
    assert [turn.fault is None for turn in writer.turns] == [False, True, False]
    assert [turn.answer for turn in writer.turns] == [text, "lift it", text]
    assert [(turn.step, turn.calls, turn.tokens) for turn in writer.turns] == [
        (step, 2, 10) for step in (0, 16, 32)
    ]


def test_key_frames_are_kept_near_ones_merged_and_shown_again() -> None:
    answers = ([1], [1, 8], [], [8])
    model = Scripted(*(json.dumps({"subgoal": "go on", "keyframes": one}) for one in answers))
    writer = begun(model, prompt="memer")
    assert writer.every_frame
    written(writer, 0, 0)  # live frame 0, kept
    for first in (1, 17, 33):
        writer.watch([seen(number) for number in range(first, first + 16)])
        writer.next(seen(first + 15), first + 15)
    # The kept frames; then eight recent frames, every second one, up to the current one.
    # Frames 2 and 16 were kept: 0 and 2 are near each other, the upper one of the two stays.
    assert [[int(image.max()) for image in images(parts)] for parts in model.asked] == [
        [0],
        [0, *range(2, 17, 2)],
        [2, 16, *range(18, 33, 2)],
        [2, 16, *range(34, 49, 2)],
    ]
    assert [turn.keyframes for turn in writer.turns] == [(0,), (2, 16), (2, 16), (2, 16, 48)]


@pytest.mark.parametrize("option", ["frames", "fps", "recent", "stride"])
def test_numbers_below_one_are_errors(option: str) -> None:
    with raises(InvalidOptionError):
        begun(Scripted(), **{option: 0})


# --- rollouts and runs ---------------------------------------------------------------------------


@pytest.mark.parametrize(("single", "length"), [(False, 16), (True, 1)])
def test_a_subgoal_before_each_chunk_and_at_least_every_16_steps(single: bool, length: int) -> None:
    policy, writer = Told(single), OracleWriter()
    row = roll("no-history", policy, writer=writer)
    assert row.steps == 40
    assert [turn.step for turn in writer.turns] == [0, 16, 32]
    subgoals = [Subgoal(f"go on from step {at} to <point>", ((at, 7),)) for at in (0, 16, 32)]
    assert policy.told == [subgoals[step // 16] for step in range(0, 40, length)]
    assert (row.model_calls, row.model_tokens, row.model_faults) == (0, None, 0)


def test_a_server_gets_subgoals_with_points_and_without(
    server: PolicyServer, tmp_path: Path
) -> None:
    options = ("checkpoint=a",)
    run_one(tmp_path, policy=server.url, policy_options=options, subgoals="oracle")
    calls = [call for call in server.calls if "prompt" in call]
    assert calls[0]["simple_subgoal"] == "go on from step 0 to"
    assert calls[1]["simple_subgoal"] == "go on from step 16 to"
    assert calls[1]["grounded_subgoal"] == "go on from step 16 to <16, 7>"


def behind(server: ChatServer, **changes: Any) -> dict[str, Any]:
    usual = {"policy": TOLD, "subgoals": f"openai:{server.url}#tiny"}
    return usual | {"subgoal_options": ("frames=4", "response_s=5")} | changes


def test_a_run_with_a_faulty_endpoint_loses_no_row(tmp_path: Path) -> None:
    faults = [BUSY, BROKEN, GARBAGE, REFUSED, EMPTY, CLOSED, SLOW, BUSY]
    with ChatServer(lambda seen: "go to <500, 250>", faults=faults, slow_s=0.05) as server:
        result = run(tmp_path, **behind(server))
        assert [row.status for row in result.rows] == ["fail"] * 4
        # Three subgoals a rollout; all faults but the refusal and the slow answer cause a retry.
        assert len(server.seen) == sum(row.model_calls or 0 for row in result.rows) == 4 * 3 + 6
        assert sum(row.model_faults or 0 for row in result.rows) == 1
        assert sum(row.model_tokens or 0 for row in result.rows) == 4 * 3 * 105
        assert all(row.model_s is not None and row.model_s > 0 for row in result.rows)
    text = (tmp_path / "subgoals" / "MoveCube_test_0_k0.jsonl").read_text()
    lines = [json.loads(line) for line in text.splitlines()]
    assert [line["step"] for line in lines] == [0, 16, 32]
    assert lines[1]["subgoal"] == "go to <16, 8>"  # of 32 × 32 pixels
    assert "[video of 4 frames]" in lines[1]["prompt"] and "Steps so far" in lines[1]["prompt"]
    assert len([*(tmp_path / "subgoals").iterdir()]) == 4


@pytest.mark.slow
@pytest.mark.parametrize("executor", [Serial(), Processes(1)], ids=["serial", "processes"])
def test_an_error_row_has_the_steps_and_calls_before_it(tmp_path: Path, executor: Executor) -> None:
    options = ("repeats=0", "frames=4")
    with ChatServer(faults=["", REFUSED, BROKEN]) as server:
        given = behind(server, subgoal_options=options, conditions=("k0",), families=("MoveCube",))
        [row] = run(tmp_path, executor, **given).rows
    assert row.status == "error" and "500" in str(row.error)
    # Two answers, of which one is empty; the third question, after 32 steps, broke.
    assert (row.steps, row.model_calls, row.model_tokens, row.model_faults) == (32, 2, 210, 1)


def test_the_prompt_and_the_model_identify_the_run(tmp_path: Path) -> None:
    with ChatServer() as server, ChatServer() as other:
        run_one(tmp_path / "run", **behind(server))
        moved = behind(other, subgoal_options=("frames=4", "repeats=1"))
        assert run_one(tmp_path / "run", **moved).counts["fail"] == 1  # the address may change
        for changes in ({"subgoal_prompt": "simple"}, {"subgoal_options": ("frames=5",)}):
            with raises(RunError):
                run_one(tmp_path / "run", **behind(server, **changes))
        with raises(RunError):
            run_one(tmp_path / "run", policy=TOLD)
    start = header(tmp_path / "run")["invocations"][0]
    assert start["policy"]["subgoals"]["model"] == {"model": "tiny"}


def test_a_missing_model_is_an_error_before_the_run(tmp_path: Path) -> None:
    with ChatServer(model="large") as server, raises(ModelError):
        run_one(tmp_path / "run", **behind(server))
    assert not (tmp_path / "run").exists()


# --- settings ------------------------------------------------------------------------------------


MODEL = {"subgoals": "openai:http://h/v1#m"}


@pytest.mark.parametrize(
    ("system", "changes", "words"),
    [
        ("symbolic-groundsg", MODEL, None),
        ("symbolic-simplesg", MODEL, None),
        ("memer", MODEL, None),
        ("mine", {"subgoals": "oracle"}, None),
        ("mine", {**MODEL, "policy": TOLD}, None),
        ("symbolic-groundsg", {}, "acts on subgoals of a model"),
        ("symbolic-groundsg", {"subgoals": "oracle"}, "knows the answer"),
        ("perceptual-framesamp-modul", MODEL, "acts on no subgoals"),
        ("mine", {**MODEL, "policy": "replay"}, "replay reads no subgoals"),
        ("mine", {"subgoal_prompt": "simple"}, "has no effect without a model"),
        ("mine", {"subgoals": "oracle", "subgoal_options": ("frames=3",)}, "`subgoal_options` has"),
    ],
)
def test_settings_that_fit_together_and_others(
    tiny_buffers: Path, system: str, changes: dict[str, Any], words: str | None
) -> None:
    settings = config(**{"simulator": "tabletop", "policy": "websocket://h:1"} | changes)
    if words is None:
        check_system(settings, system)
        buffer_set = load_buffer_set(tiny_buffers)
        check_settings(settings, buffer_set)
        check_policy(settings, buffer_set, make_policy("noop"))
    else:
        with pytest.raises(InterferenceError) as raised:
            check_system(settings, system)
        assert words in raised.value.message


def test_an_unknown_option_lists_those_of_model_and_prompt() -> None:
    settings = config(policy=TOLD, subgoal_prompt="simple", **MODEL, subgoal_options=("framse=3",))
    with raises(InvalidOptionError) as raised:
        make_writer(settings)
    hint = str(raised.value.hint)
    assert "max_tokens" in hint and "frames, fps, recent, stride, near" in hint


def test_rows_behind_a_model_need_a_name() -> None:
    with raises(InvalidOptionError):
        default_system(config(policy=TOLD, **MODEL))
    assert default_system(config(policy="python:a.b:c", subgoals="oracle")) == "a.b-c-oracle"
