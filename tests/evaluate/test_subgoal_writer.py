"""What a model is shown before each subgoal, and what becomes of its answers."""

import json
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.worlds import buffer_set_here

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.evaluate.models.model import ChatModel, Message, Part, Reply, Video
from robomme_interference_data.evaluate.policies.policy import RolloutInfo
from robomme_interference_data.evaluate.run.history import HistoryReader
from robomme_interference_data.evaluate.subgoals.model_writer import ModelWriter
from robomme_interference_data.evaluate.subgoals.writer import History
from robomme_interference_data.schema.subgoal import Subgoal
from robomme_interference_data.simulators.base import Observation

pytestmark = pytest.mark.usefixtures("world")


class Scripted(ChatModel):
    """Says one text after the other, and keeps what it was asked."""

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
    """What is seen at a live frame: its number is in every pixel."""
    image = np.full((256, 256, 3), number, np.uint8)
    return Observation({"front": image}, np.zeros(8, np.float32))


def begun(model: ChatModel, condition: str = "k0", prompt: str = "grounded", **o: int) -> Any:
    buffer = buffer_set_here().load("MoveCube/test/0", condition)
    writer = ModelWriter(model, prompt, **o)
    info = RolloutInfo("move it", len(buffer), 0)
    writer.start(
        History(buffer, range(len(buffer)), HistoryReader(buffer_set_here().datasets)), info, None
    )  # type: ignore[arg-type]
    return writer


def images(parts: Sequence[Part]) -> list[NDArray[np.uint8]]:
    return [part for part in parts if isinstance(part, np.ndarray)]


def told(writer: ModelWriter, number: int, step: int) -> Subgoal:
    writer.watch([seen(number)])
    return writer.next(seen(number), step)


def test_it_is_shown_an_even_sample_of_the_history_and_what_is_seen_now() -> None:
    model = Scripted("pick it up at <500, 250>")
    writer = begun(model, frames=5)
    assert told(writer, 7, 0) == Subgoal("pick it up at <point>", ((128, 64),))
    [parts] = model.asked
    [video] = [part for part in parts if isinstance(part, Video)]
    frames = buffer_set_here().load("MoveCube/test/0", "k0").frames("front")
    # 48 frames: 0, 47/4 = 11.75, 23.5, 35.25, 47; 47 tenths of a second, 4 steps.
    assert np.array_equal(video.frames, frames[[0, 11, 23, 35, 47]])
    assert video.fps == pytest.approx(4 / 4.7)
    [now] = images(parts)
    assert now.max() == now.min() == 7
    assert "move it" in "".join(part for part in parts if isinstance(part, str))


def test_without_history_there_is_the_word_none() -> None:
    model = Scripted("go")
    told(begun(model, "no-history"), 0, 0)
    [parts] = model.asked
    assert len(images(parts)) == 1 and not any(isinstance(part, Video) for part in parts)
    assert "none" in str(parts[0])


def test_earlier_subgoals_are_told_each_once_while_they_stand() -> None:
    model = Scripted("first at <0, 0>", "first at <500, 0>", "second", "second")
    writer = begun(model)
    given = [told(writer, number, 16 * number) for number in range(4)]
    assert [one.points for one in given] == [((0, 0),), ((128, 0),), (), ()]  # moved, not listed
    words = [str(parts[-1]) for parts in model.asked]
    assert "Steps so far" not in words[0]
    assert "Steps so far: 1. first at <0, 0>\n" in words[1]
    assert "Steps so far: 1. first at <0, 0>\n" in words[2]
    assert "Steps so far: 1. first at <0, 0>; 2. second\n" in words[3]


@pytest.mark.parametrize("text", ["", "  ", "x" * 400, "at <1001, 0>"])
def test_what_cannot_be_used_leaves_the_subgoal_and_is_counted(text: str) -> None:
    writer = begun(Scripted(text, "lift it", text))
    assert told(writer, 0, 0) == Subgoal("move it")  # the goal, as there is no other yet
    assert told(writer, 1, 16) == told(writer, 2, 32) == Subgoal("lift it")
    assert [turn.fault is None for turn in writer.turns] == [False, True, False]
    assert [turn.answer for turn in writer.turns] == [text, "lift it", text]
    assert [(turn.step, turn.calls, turn.tokens) for turn in writer.turns] == [
        (step, 2, 10) for step in (0, 16, 32)
    ]


def memer(*keyframes: Sequence[int]) -> Callable[..., Any]:
    said = [json.dumps({"subgoal": "go on", "keyframes": list(one)}) for one in keyframes]
    return Scripted(*said)  # type: ignore[return-value]


def values(parts: Sequence[Part]) -> list[int]:
    return [int(image.max()) for image in images(parts)]


def test_key_frames_are_kept_near_ones_merged_and_shown_again() -> None:
    model: Any = memer([1], [1, 8], [], [8])
    writer = begun(model, prompt="memer")
    assert writer.every_frame
    told(writer, 0, 0)  # live frame 0, kept
    for first in (1, 17, 33):
        writer.watch([seen(number) for number in range(first, first + 16)])
        writer.next(seen(first + 15), first + 15)
    # Eight recent frames, every second one, the last of now; before them those that were kept.
    assert values(model.asked[0]) == [0]
    assert values(model.asked[1]) == [0, *range(2, 17, 2)]
    # Frames 2 and 16 were kept: 0 and 2 are near each other, the upper one of the two stays.
    assert values(model.asked[2]) == [2, 16, *range(18, 33, 2)]
    assert values(model.asked[3]) == [2, 16, *range(34, 49, 2)]
    assert [turn.keyframes for turn in writer.turns] == [(0,), (2, 16), (2, 16), (2, 16, 48)]


def test_the_record_says_what_was_asked_without_the_images() -> None:
    writer = begun(Scripted("go"), frames=4)
    told(writer, 0, 0)
    [turn] = writer.turns
    assert "[video of 4 frames]" in str(turn.prompt) and "[image]" in str(turn.prompt)


@pytest.mark.parametrize("option", ["frames", "recent", "stride"])
def test_numbers_below_one(option: str) -> None:
    with pytest.raises(InvalidOptionError, match=option):
        begun(Scripted(), **{option: 0})
