"""Chat endpoints: what they are sent, what they answer, and what is done about their faults."""

import io
import time
from collections.abc import Iterator
from typing import Any

import av
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.chat_server import (
    BROKEN,
    BUSY,
    BUSY_FOR_AN_HOUR,
    BUSY_SOME_TIME,
    CLOSED,
    DEEP,
    DRIPS,
    DRIPS_HEADERS,
    EMPTY,
    ENDLESS,
    GARBAGE,
    LOCKED,
    REFUSED,
    SLOW,
    UNCOUNTED,
    ChatServer,
)
from support.messages import raises

from robomme_interference_data.errors import InvalidOptionError, ModelError
from robomme_interference_data.evaluate.language import openai as openai_module
from robomme_interference_data.evaluate.language.images import within
from robomme_interference_data.evaluate.language.models import (
    MODELS,
    Message,
    Video,
    model_identity,
)

pytestmark = pytest.mark.usefixtures("fast_retries")

NOISE = np.random.default_rng(0).integers(0, 256, (20, 33, 21, 3), dtype=np.uint8)
ASKED = [Message("system", ("be brief",)), Message("user", ("what is it? ", NOISE[0]))]


@pytest.fixture
def server() -> Iterator[ChatServer]:
    with ChatServer(answer=lambda seen: f"{len(seen.images)} images") as running:
        yield running


def model_of(server: ChatServer, *options: str, name: str = "tiny") -> Any:
    return MODELS.make(f"openai:{server.url}#{name}", options)


# --- what is sent --------------------------------------------------------------------------------


def test_text_and_images_arrive_unchanged(server: ChatServer) -> None:
    reply = model_of(server, "max_tokens=7").reply(ASKED)
    assert (reply.text, reply.tokens, reply.calls) == ("1 images", 105, 1)
    [seen] = server.seen
    assert seen.text == "be briefwhat is it? "
    assert np.array_equal(seen.images[0], NOISE[0])
    assert (seen.body["max_tokens"], seen.body["temperature"]) == (7, 0.0)


def test_one_connection_is_kept(server: ChatServer) -> None:
    model = model_of(server)
    model.metadata()
    for _ in range(3):
        model.reply(ASKED)
    assert server.connections == 1


def test_a_video_becomes_evenly_spread_images_within_the_budget(server: ChatServer) -> None:
    asked = [Message("user", (Video(NOISE, 10.0), NOISE[7]))]
    model_of(server, "images=5").reply(asked)
    # One image is single; 4 of 20 frames: 0, 19/3 = 6.3, 12.7, 19.
    for found, number in zip(server.seen[0].images, (0, 6, 12, 19, 7), strict=True):
        assert np.array_equal(found, NOISE[number])


@pytest.mark.parametrize("fps", [5.0, 12.5, 0.5])
def test_a_video_as_mp4(server: ChatServer, fps: float) -> None:
    model_of(server, "video=mp4").reply([Message("user", ("look", Video(NOISE, fps)))])
    [data] = server.seen[0].videos
    with av.open(io.BytesIO(data)) as container:
        stream = container.streams.video[0]
        assert (stream.height, stream.width, stream.average_rate) == (32, 20, fps)
        assert sum(1 for _ in container.decode(video=0)) == 20


@given(st.lists(st.integers(1, 30), max_size=4), st.integers(0, 3), st.integers(1, 40))
def test_budgets(lengths: list[int], single: int, images: int) -> None:
    frame = np.zeros((2, 2, 3), np.uint8)
    videos = [Video(np.repeat(frame[None], length, 0), 10.0) for length in lengths]
    [message] = within([Message("user", (*videos, *[frame] * single))], images)
    assert all(isinstance(part, np.ndarray) for part in message.parts)
    count, most = len(message.parts), max(images, single)
    assert count <= most
    assert count == sum(lengths) + single or count > most - len(lengths) - 1


# --- faults --------------------------------------------------------------------------------------


@pytest.mark.parametrize("fault", [BUSY, BUSY_SOME_TIME, BROKEN, GARBAGE, DEEP, EMPTY, CLOSED])
def test_temporary_failures_are_retried(server: ChatServer, fault: str) -> None:
    server.faults = [fault, fault]
    reply = model_of(server).reply(ASKED)
    assert (reply.text, reply.calls) == ("1 images", 3)
    assert len(server.seen) == 3


@pytest.mark.parametrize("fault", [BROKEN, EMPTY, CLOSED])
def test_a_failure_after_all_retries_is_one_error(server: ChatServer, fault: str) -> None:
    server.faults = [fault] * 9
    with raises(ModelError):
        model_of(server, "repeats=2").reply(ASKED)
    assert len(server.seen) == 3


@pytest.mark.parametrize("fault", [SLOW, DRIPS, DRIPS_HEADERS])
def test_no_whole_answer_in_time(server: ChatServer, fault: str) -> None:
    server.faults = [fault] * 2
    began = time.monotonic()
    with raises(ModelError):
        model_of(server, "repeats=1", "response_s=0.05", "connect_s=0.1").reply(ASKED)
    assert len(server.seen) == 2
    assert time.monotonic() - began < 60


def test_an_answer_without_end(server: ChatServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(openai_module, "MAX_BYTES", 1 << 20)
    server.faults = [ENDLESS] * 2
    with raises(ModelError):
        model_of(server, "repeats=1").reply(ASKED)
    assert model_of(server).reply(ASKED).text == "1 images"


def test_half_a_surrogate_pair_is_replaced() -> None:
    """It is valid JSON, but cannot be written or sent back."""
    with ChatServer(answer=lambda seen: "pick \ud800 <1, 2>") as server:
        assert model_of(server).reply(ASKED).text == "pick ? <1, 2>"


def test_a_refusal_is_an_empty_answer_and_tokens_may_be_unknown(server: ChatServer) -> None:
    server.faults = [REFUSED, UNCOUNTED]
    model = model_of(server)
    for text, tokens in (("", 105), ("1 images", None)):
        reply = model.reply(ASKED)
        assert (reply.text, reply.tokens, reply.calls) == (text, tokens, 1)


@pytest.mark.parametrize(
    ("fault", "next_step"), [(BUSY_FOR_AN_HOUR, "resume"), (LOCKED, "OPENAI_API_KEY")]
)
def test_failures_that_no_retry_solves(server: ChatServer, fault: str, next_step: str) -> None:
    server.faults = [fault]
    with raises(ModelError) as raised:
        model_of(server).reply(ASKED)
    assert next_step in str(raised.value.hint)
    assert len(server.seen) == 1


@pytest.mark.parametrize("key", ["one\ntwo", "schlüssel"])
def test_an_invalid_key_is_an_error_that_does_not_show_it(
    server: ChatServer, key: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", key)
    with raises(InvalidOptionError) as raised:
        model_of(server)
    assert key not in str(raised.value)


def test_a_missing_model_is_an_error_that_lists_those_served(server: ChatServer) -> None:
    model = model_of(server, name="small")
    for call in (model.metadata, lambda: model.reply(ASKED)):
        with raises(ModelError) as raised:
            call()
        assert "tiny" in str(raised.value.hint)
    assert len(server.seen) == 1
    assert model_of(server).metadata() == {"model": "tiny"}


def test_a_list_of_models_that_cannot_be_read(server: ChatServer) -> None:
    server.faults = [DEEP]
    with raises(ModelError):
        model_of(server).metadata()


def test_no_server_listens() -> None:
    with ChatServer() as server:
        model = model_of(server, "repeats=1")
    for call in (model.metadata, lambda: model.reply(ASKED)):
        with raises(ModelError):
            call()


# --- names and options of models -----------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        *("openai:localhost:8000#m", "openai:http://h:1/v1", "openai:http://h#", "transformers:"),
        *("openai:http://h:99999#m", "openai:http://h:x#m", "openai:http://[::1#m"),
        *("openai:http:///v1#m", "openai:http://me:key@h#m"),
    ],
)
def test_invalid_names_are_errors(text: str) -> None:
    with raises(InvalidOptionError):
        MODELS.parse(text)


@pytest.mark.parametrize(
    "option",
    [
        *("max_tokens=0", "images=0", "video=gif", "repeats=-1", "response_s=0", "colour=red"),
        *("temperature=NaN", "temperature=Infinity", "response_s=NaN", "connect_s=Infinity"),
    ],
)
def test_options_out_of_range(server: ChatServer, option: str) -> None:
    with raises(InvalidOptionError):
        model_of(server, option)


def test_what_identifies_a_model() -> None:
    said = {"model": "m"}
    here = model_identity("openai:http://h/v1#m", ["images=9", "response_s=3"], said)
    assert here == model_identity("openai:http://other/v1#m", ["images=9", "repeats=1"], said)
    assert here != model_identity("openai:http://h/v1#m", ["images=8"], said)
    assert (here["kind"], here["model"], here["options"]["images"]) == ("openai", "m", 9)
