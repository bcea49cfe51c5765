"""Policies from text: what is read, what is refused before any episode, and what is made."""

import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data import evaluate
from robomme_interference_data.errors import (
    InvalidOptionError,
    MissingExtraError,
    PolicyError,
    UnknownNameError,
)
from robomme_interference_data.evaluate.policies.policy import Policy
from robomme_interference_data.evaluate.policies.registry import (
    POLICIES,
    make_policy,
    policy_options,
    server_addresses,
)
from robomme_interference_data.runtime.specs import Spec, bind_options

OWN = "python:support.own_policies:"


@pytest.mark.parametrize(
    ("text", "spec", "servers"),
    [
        ("oracle", Spec("oracle"), ()),
        ("replay:window", Spec("replay", "window"), ()),
        ("recall:framesamp", Spec("recall", "framesamp"), ()),
        ("lerobot:me/act", Spec("lerobot", "me/act"), ()),
        ("lerobot:out/last:1", Spec("lerobot", "out/last:1"), ()),
        ("python:my.policies:make", Spec("python", "my.policies:make"), ()),
        (
            "websocket://gpu-1.lab:8013,10.0.0.2:1,[::1]:65535",
            Spec("websocket", "//gpu-1.lab:8013,10.0.0.2:1,[::1]:65535"),
            (("gpu-1.lab", 8013), ("10.0.0.2", 1), ("::1", 65535)),
        ),
    ],
)
def test_what_is_read(text: str, spec: Spec, servers: tuple[tuple[str, int], ...]) -> None:
    assert POLICIES.parse(text) == spec
    assert str(spec) == text
    assert server_addresses(text) == servers
    assert str(POLICIES.parse("replay")) == "replay:full"
    assert str(POLICIES.parse("recall")) == "recall:full"


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        ("orcale", UnknownNameError, "Did you mean 'oracle'"),
        ("websockets://a:1", UnknownNameError, "Did you mean 'websocket'?"),
        ("zzz", UnknownNameError, "expected replay, replay:framesamp or replay:window, recall,"),
        ("", UnknownNameError, "there is no policy ''"),
        *(
            (text, InvalidOptionError, f"policy '{text}'; expected {text.partition(':')[0]}")
            for text in (
                *("oracle:x", "noop:", "replay:", "websocket", "websocket:a:1", "websocket://"),
                *("websocket://a", "websocket://a:0", "websocket://a:65536", "websocket://a:1/x"),
                *("websocket://a:1,", "websocket://a:1,websocket://b:1", "websocket://a:1,a:1"),
                *("lerobot", "lerobot:", "python:module", "python::make", "python:a b:make"),
            )
        ),
    ],
)
def test_what_is_refused(text: str, error: type[Exception], words: str) -> None:
    with pytest.raises(error) as raised:
        POLICIES.parse(text)
    assert words in str(raised.value)
    with pytest.raises(error):
        make_policy(text)


@given(st.text(max_size=20) | st.from_regex(r"(websocket:/?/?|python:|lerobot:)[a-z:,1.\[\]]*"))
def test_any_text_is_a_policy_or_a_clear_error(text: str) -> None:
    try:
        spec = POLICIES.parse(text)
    except (UnknownNameError, InvalidOptionError):
        return
    assert str(spec) == text
    assert len(server_addresses(text)) == (text.count(",") + 1 if spec.kind == "websocket" else 0)


def test_each_worker_has_a_server() -> None:
    make_policy("websocket://a:1,b:2", worker=1)
    with pytest.raises(InvalidOptionError, match="3 workers need 3 policy servers") as raised:
        make_policy("websocket://a:1,b:2", worker=2)
    assert "workers=2" in str(raised.value)
    make_policy("replay", worker=50)


# --- options -----------------------------------------------------------------------------------


def test_options_reach_the_policy_with_the_declared_type() -> None:
    policy: Any = make_policy(f"{OWN}Still", ["gripper=-1"], worker=3)
    assert (policy.action[0, 7], policy.worker) == (-1, 3)  # it asks for its worker
    assert policy_options("websocket://a:1", ["response_s=5"]) == {
        "checkpoint": None,
        "chunk_frames": 16,
        "connect_s": 600.0,
        "response_s": 5.0,
    }

    def make(a: str, b: str | None, c: int | None, d: bool, e, f: list[int]) -> None: ...  # type: ignore[no-untyped-def]

    typed = ["a=7", "b=null", "c=null", "d=true", "e=x=y", "f=[1]"]
    assert bind_options("mine", make, {}, typed) == {
        **{"a": "7", "b": "null", "c": None, "d": True, "e": "x=y", "f": [1]}
    }


@pytest.mark.parametrize("texts", [["gripper"], ["=1"], ["two words=1"], ["a=1", "b=1", "a=2"]])
def test_what_is_no_option(texts: list[str]) -> None:
    with pytest.raises(InvalidOptionError, match="policy 'noop': option"):
        policy_options("noop", texts)


@pytest.mark.parametrize(
    ("text", "option", "words"),
    [
        ("websocket://a:1", "chunk_frames=2.5", "chunk_frames is 2.5; expected a whole number"),
        ("websocket://a:1", "chunk_frames=true", "is True; expected a whole number"),
        ("websocket://a:1", "connect_s=soon", "connect_s is 'soon'; expected a number"),
        ("websocket://a:1", "memory=full", "Its options: checkpoint, chunk_frames, "),
        ("websocket://a:1", "port=2", "port"),
        ("websocket://a:1", "connect_s=-1", "expected positive numbers"),
        (f"{OWN}still", "gripper=null", "gripper is None; expected a number"),
        ("noop", "speed=1", "Its options: none."),
    ],
)
def test_options_that_do_not_fit(text: str, option: str, words: str) -> None:
    with pytest.raises(InvalidOptionError) as raised:
        make_policy(text, [option])
    assert words in str(raised.value)
    with pytest.raises(InvalidOptionError, match="missing a required argument: 'gripper'"):
        make_policy(f"{OWN}still")


# --- policies of one's own ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        ("python:no_such_module:make", InvalidOptionError, "PYTHONPATH"),
        (f"{OWN}stil", UnknownNameError, "Did you mean 'still'"),
        (f"{OWN}NUMBER", UnknownNameError, "function 'NUMBER'"),
        ("python:builtins:dict", PolicyError, "dict has cameras None; expected a tuple of 'front'"),
        ("python:builtins:dict", PolicyError, "no method reset(); no method add_history()"),
        ("python:broken_policy:make", InvalidOptionError, "No module named 'not_installed_here'"),
    ],
)
def test_a_factory_that_is_none(
    text: str, error: type[Exception], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "broken_policy.py").write_text("import not_installed_here\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(error) as raised:
        make_policy(text)
    assert words in str(raised.value)


def test_a_factory_that_raises_shows_its_own_traceback_alone() -> None:
    with pytest.raises(PolicyError, match="its factory raised ZeroDivisionError") as raised:
        make_policy(f"{OWN}raising")
    hint = raised.value.hint or ""
    assert "own_policies.py" in hint and "return 1 / 0" in hint and "registry.py" not in hint


def test_authors_import_all_from_one_place() -> None:
    for name in evaluate.__all__:
        assert getattr(evaluate, name).__name__ == name or name == "Frames"


def test_every_member_of_the_protocol_is_asked_for() -> None:
    members = [name for name in vars(Policy) if not name.startswith("_")]
    assert len(members) == 11
    for name in members:
        with pytest.raises(PolicyError, match=rf"Lacking has (no method )?{name}\b"):
            make_policy(f"{OWN}lacking", [f"name={name}"])


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("history_cameras", "null", "history_cameras None"),
        ("history_cameras", '["top"]', "a tuple of 'front' and 'wrist'"),
        ("cameras", '"front"', "cameras 'front'"),
        ("wants_history", "no", "wants_history 'no'; expected True or False"),
        ("every_frame", "1", "every_frame 1"),
        ("act", "3", r"no method act()"),
    ],
)
def test_a_member_of_another_kind(name: str, value: str, words: str) -> None:
    with pytest.raises(PolicyError) as raised:
        make_policy(f"{OWN}changed", [f"name={name}", f"value={value}"])
    assert words in str(raised.value)
    make_policy(f"{OWN}changed", ["name=cameras", 'value=["wrist"]'])  # a list will do


@pytest.mark.parametrize("library", ["websockets", "msgpack"])
def test_a_missing_library_names_the_extra(library: str, monkeypatch: pytest.MonkeyPatch) -> None:
    package = "robomme_interference_data.evaluate.policies"
    for name in list(sys.modules):
        if name.startswith((f"{package}.w", f"{package}.connection", library)):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(MissingExtraError, match=f"needs {library}") as raised:
        make_policy("websocket://a:1")
    assert "robomme-interference-data[evaluate]" in str(raised.value.hint)
