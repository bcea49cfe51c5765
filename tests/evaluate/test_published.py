"""The published systems with a model: each question equals the released client's, or is an error.

The expected questions follow from the client's rules: one for every 16 actions; the whole history
as one video at 30 frames a second, and without a history nothing about it; the subgoals so far,
each once in a row, with points as thousandths of the image; MemER's last eight frames at stride 2.
The texts here are others, in files of the client's structure.
"""

import io
import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from support.chat_server import ChatServer, Seen
from support.client_prompts import FILES
from support.messages import raises
from support.runs import EPISODE, config, header, run_one
from support.worlds import buffer_set_here, query_of

from robomme_interference_data.errors import FormatError, InvalidOptionError
from robomme_interference_data.evaluate.language import published_prompts as published
from robomme_interference_data.evaluate.language.published_prompts import (
    FOLDER,
    PUBLISHED,
    read_client,
)
from robomme_interference_data.evaluate.language.subgoal_settings import with_published

pytestmark = pytest.mark.usefixtures("world", "fast_retries")

BOX = "<|box_start|>(%d,%d)<|box_end|>"


@pytest.fixture
def client(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of the client, whose prompts count as the published ones."""
    for name, code in FILES.items():
        (tmp_path / name).write_text(code)
    known = {
        name: replace(one, sha256=read_client(FILES[one.file], one).sha256)
        for name, one in PUBLISHED.items()
    }
    monkeypatch.setattr(published, "PUBLISHED", known)
    monkeypatch.setattr(
        "robomme_interference_data.evaluate.language.subgoal_settings.PUBLISHED", known
    )
    return tmp_path


def settings(system: str, server: str, prompt: Path | None, **changes: Any) -> dict[str, Any]:
    usual: dict[str, Any] = {"policy": "python:support.own_policies:Told", "system": system}
    usual |= {"subgoals": f"openai:{server}#tiny", "subgoal_prompt": prompt and str(prompt)}
    return usual | changes


def asked(client: Path, system: str, condition: str, answers: Sequence[str]) -> list[Seen]:
    """The questions of a rollout of 40 steps, at steps 0, 16 and 32."""
    left = list(answers)
    with ChatServer(lambda seen: left.pop(0)) as server:
        given = settings(system, server.url, client / PUBLISHED[system].file)
        [row] = run_one(client / "run", conditions=(condition,), **given).rows
        assert (row.status, row.system, row.model_calls) == ("fail", system, 3), row.error
        return server.seen


def written(seen: Seen) -> str:
    """What the model is asked, as the client writes it."""
    system, user = seen.body["messages"]
    tags = {"image_url": "<image>", "video_url": "<video>"}
    parts = user["content"]
    parts = [{"type": "text", "text": parts}] if isinstance(parts, str) else parts
    return f"{system['content']}|" + "".join(tags.get(p["type"]) or p["text"] for p in parts)


def check_video(seen: Seen) -> None:
    """The whole lesson, in order, at 30 frames a second."""
    [data] = seen.videos
    assert b"subme=7" in data and b"crf=23.0" in data  # x264's own defaults
    with av.open(io.BytesIO(data)) as container:
        [stream] = container.streams.video
        decoded = [frame for frame in container.decode(stream)]
        assert stream.average_rate == 30
        times = [frame.time for frame in decoded]
    frames = buffer_set_here().load(EPISODE, "k0").frames("front").astype(int)
    shown = np.stack([frame.to_ndarray(format="rgb24") for frame in decoded]).astype(int)
    assert times == pytest.approx([number / 30 for number in range(48)])
    nearest = [np.abs(frames - one).mean(axis=(1, 2, 3)).argmin() for one in shown]
    assert nearest == list(range(48))


@pytest.mark.parametrize(("condition", "video"), [("k0", "<video>"), ("no-history", "")])
def test_simplesg(client: Path, condition: str, video: str) -> None:
    seen = asked(client, "symbolic-simplesg", condition, ["lift it", "lift it", "push it away"])
    goal = buffer_set_here().query(EPISODE).goal
    begin = f"Plain steps.|{video}Goal: {goal}\n"
    assert [written(one) for one in seen] == [
        f"{begin}New.\n<image>Plain?",
        f"{begin}Done: 1. lift it\n<image>Plain?",
        f"{begin}Done: 1. lift it\n<image>Plain?",
    ]
    for one in seen:
        assert (one.body["max_tokens"], one.body["temperature"]) == (128, 0)
        assert np.array_equal(one.images[0], query_of(str(EPISODE))[2].images["front"])
        assert check_video(one) is None if video else one.videos == []


@pytest.mark.parametrize(("condition", "video"), [("k0", "<video>"), ("no-history", "")])
def test_groundsg(client: Path, condition: str, video: str) -> None:
    """A subgoal is new if it has a point more, and not if its point has moved."""
    answers = ["press it", f"press it at {BOX % (500, 1000)}", f"press it at {BOX % (1, 2)}"]
    seen = asked(client, "symbolic-groundsg", condition, answers)
    goal = buffer_set_here().query(EPISODE).goal
    begin = f"Steps with places.|{video}Goal: {goal}\n"
    assert [written(one) for one in seen] == [
        f"{begin}New.\n<image>Where?",
        f"{begin}Done: 1. press it\n<image>Where?",
        f"{begin}Done: 1. press it; 2. press it at {BOX % (500, 1000)}\n<image>Where?",
    ]
    assert [len(one.videos) for one in seen] == [bool(video)] * 3


@pytest.mark.parametrize(
    ("condition", "video"), [("k0", "There was a video: <video>\n"), ("no-history", "")]
)
def test_memer(client: Path, condition: str, video: str) -> None:
    """Frame 0 is kept, then the last of 16; they are shown before the eight current ones."""
    answers = [
        json.dumps({"current_subtask": f"go at {BOX % (0, 0)}", "keyframe_positions": kept})
        for kept in ([1], [8], [])
    ]
    seen = asked(client, "memer", condition, answers)
    goal = buffer_set_here().query(EPISODE).goal
    eight = ", ".join(["<image>"] * 8)
    end = "\n\nStep and frames?"
    assert [written(one) for one in seen] == [
        f"Steps and frames.|{video}Goal: {goal}\nKept:[]\nNow: [<image>]{end}",
        f"Steps and frames.|{video}Goal: {goal}\nKept:[<image>]\nNow: [{eight}]{end}",
        f"Steps and frames.|{video}Goal: {goal}\nKept:[<image>, <image>]\nNow: [{eight}]{end}",
    ]
    assert [len(one.videos) for one in seen] == [bool(video)] * 3


# --- the name ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("system", "changes"),
    [
        ("memer", {"subgoal_prompt": None}),
        ("memer", {"subgoal_prompt": "memer"}),
        ("symbolic-groundsg", {"subgoal_prompt": "grounded"}),
        ("memer", {"subgoal_options": ("max_tokens=256",)}),
        ("memer", {"subgoal_options": ("fps=10",)}),
        ("memer", {"subgoal_options": ("stride=1",)}),
    ],
)
def test_another_prompt_or_option_may_not_carry_the_name(
    client: Path, system: str, changes: dict[str, Any]
) -> None:
    with ChatServer() as server:
        given = settings(system, server.url, client / PUBLISHED[system].file)
        with raises(InvalidOptionError) as raised:
            run_one(client / "run", **given | changes)
        assert "/official-simulator.html" in str(raised.value.hint)
        assert not (client / "run").exists()


def test_a_model_that_takes_no_video_may_not_carry_the_name(client: Path) -> None:
    given = settings("memer", "http://h/v1", client / "api_memer.py", subgoals="transformers:tiny")
    with raises(InvalidOptionError):
        with_published(config(**given))


def test_the_published_values_may_be_set_and_are_recorded(client: Path) -> None:
    with ChatServer() as server:
        given = settings("symbolic-simplesg", server.url, client / "api.py")
        run_one(client / "run", **given, subgoal_options=("fps=30", "repeats=1"))
        run_one(client / "run", **given)
    recorded = header(client / "run")["invocations"][0]["settings"]["subgoal_options"]
    assert {"fps=30", "frames=4096", "video=mp4", "max_tokens=128"} <= {*recorded}


@pytest.mark.parametrize(
    "code",
    ["", "x = (", "user_prompt = f'{self.other}'", FILES["api_memer.py"].replace("ser_p", "xx")],
)
def test_a_file_that_is_not_the_client_is_an_error(client: Path, code: str) -> None:
    (client / "api_memer.py").write_text(code)
    with ChatServer() as server, raises(FormatError):
        run_one(client / "run", **settings("memer", server.url, client / "api_memer.py"))


def test_the_released_client() -> None:
    """With ROBOMME_CLIENT, a clone of `CLIENT`."""
    clone = os.environ.get("ROBOMME_CLIENT")
    if clone is None:
        pytest.skip("no ROBOMME_CLIENT, a clone of the released client")
    for one in PUBLISHED.values():
        code = (Path(clone) / FOLDER / one.file).read_text()
        assert read_client(code, one).sha256 == one.sha256
