"""Policies from text: what is read, what is refused before any episode, and what is made."""

import sys
from pathlib import Path
from typing import Any

import own_policies
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data.errors import (
    InvalidOptionError,
    MissingExtraError,
    PolicyError,
    UnknownNameError,
)
from robomme_interference_data.evaluate.policies.base import Policy
from robomme_interference_data.evaluate.policies.options import (
    bind_options,
    policy_identity,
    read_options,
    split_options,
)
from robomme_interference_data.evaluate.policies.registry import (
    PolicySpec,
    check_workers,
    make_policy,
    parse_policy,
    policy_factory,
)

MEMBERS: frozenset[str] = frozenset(Policy.__protocol_attrs__)  # type: ignore[attr-defined]
"""What `Policy` lists."""


@pytest.mark.parametrize(
    ("text", "spec", "servers"),
    [
        ("oracle", PolicySpec("oracle"), ()),
        ("replay", PolicySpec("replay"), ()),
        ("lerobot:me/act", PolicySpec("lerobot", "me/act"), ()),
        ("lerobot:out/last:1", PolicySpec("lerobot", "out/last:1"), ()),
        ("python:my.policies:make", PolicySpec("python", "my.policies:make"), ()),
        (
            "websocket://localhost:8013",
            PolicySpec("websocket", "localhost:8013"),
            (("localhost", 8013),),
        ),
        (
            "websocket://gpu-1.lab:8013,10.0.0.2:1,[::1]:65535",
            PolicySpec("websocket", "gpu-1.lab:8013,10.0.0.2:1,[::1]:65535"),
            (("gpu-1.lab", 8013), ("10.0.0.2", 1), ("::1", 65535)),
        ),
    ],
)
def test_what_is_read(text: str, spec: PolicySpec, servers: tuple[tuple[str, int], ...]) -> None:
    assert parse_policy(text) == spec
    assert str(spec) == text
    assert spec.servers == servers


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        ("orcale", UnknownNameError, "there is no policy 'orcale'\nDid you mean 'oracle'?"),
        ("websockets://a:1", UnknownNameError, "Did you mean 'websocket'?"),
        ("zzz", UnknownNameError, "Expected oracle, guess, hold, replay, websocket://host:port"),
        ("", UnknownNameError, "there is no policy ''"),
        ("replay:full", InvalidOptionError, "nothing may follow replay"),
        ("websocket:a:1", InvalidOptionError, "names no server"),
        ("websocket", InvalidOptionError, "names no server"),
        ("websocket://", InvalidOptionError, "'' is not host:port"),
        ("websocket://a", InvalidOptionError, "'a' is not host:port"),
        ("websocket://a:0", InvalidOptionError, "'a:0' is not host:port"),
        ("websocket://a:65536", InvalidOptionError, "'a:65536' is not host:port"),
        ("websocket://a:1/x", InvalidOptionError, "'a:1/x' is not host:port"),
        ("websocket://a:1,", InvalidOptionError, "'' is not host:port"),
        ("websocket://a:1,websocket://b:1", InvalidOptionError, "'websocket://b:1' is not"),
        ("websocket://a:1,b:1,a:1", InvalidOptionError, "names the server a:1 twice"),
        ("lerobot", InvalidOptionError, "is not complete\nExpected lerobot:namespace/name"),
        ("lerobot:", InvalidOptionError, "is not complete"),
        ("python:module", InvalidOptionError, "Expected python:module:factory"),
        ("python::make", InvalidOptionError, "is not complete"),
        ("python:a b:make", InvalidOptionError, "is not complete"),
    ],
)
def test_what_is_refused(text: str, error: type[Exception], words: str) -> None:
    with pytest.raises(error) as raised:
        parse_policy(text)
    assert words in str(raised.value)
    with pytest.raises(error):
        make_policy(text)


@given(st.text(max_size=20) | st.from_regex(r"(websocket:/?/?|python:|lerobot:)[a-z:,1.\[\]]*"))
def test_any_text_is_a_policy_or_a_clear_error(text: str) -> None:
    try:
        spec = parse_policy(text)
    except (UnknownNameError, InvalidOptionError):
        return
    assert str(spec) == text
    assert len(spec.servers) == (text.count(",") + 1 if spec.kind == "websocket" else 0)


def test_each_worker_has_a_server() -> None:
    spec = parse_policy("websocket://a:1,b:2")
    check_workers(spec, 1)
    check_workers(spec, 2)
    with pytest.raises(InvalidOptionError) as raised:
        check_workers(spec, 3)
    assert "3 workers need 3 policy servers; websocket://a:1,b:2 names 2" in str(raised.value)
    assert "--workers 2" in str(raised.value)
    check_workers(parse_policy("replay"), 50)
    second: Any = make_policy("websocket://a:1,b:2", worker=1)
    assert second._server.name == "b:2"
    with pytest.raises(InvalidOptionError, match="3 workers need"):
        make_policy("websocket://a:1,b:2", worker=2)


def test_options_reach_the_policy() -> None:
    server: Any = make_policy("websocket://a:1", chunk_frames=5)
    assert server._chunk == 5
    policy: Any = make_policy("python:own_policies:still", gripper=-1)
    assert policy.action[0, 7] == -1
    with pytest.raises(InvalidOptionError, match="unexpected keyword argument 'memory'") as raised:
        make_policy("websocket://a:1", memory="full")
    assert raised.value.hint == (
        "Its options: chunk_frames, connect_s, response_s, attempts, backoff_s."
    )
    with pytest.raises(InvalidOptionError, match="missing a required argument: 'gripper'"):
        make_policy("python:own_policies:still")


@pytest.mark.parametrize(
    ("texts", "values"),
    [
        (["gripper=-1"], {"gripper": -1}),
        (["gripper=0.5"], {"gripper": 0.5}),
        ([], {}),
    ],
)
def test_options_that_are_typed_get_the_declared_type(
    texts: list[str], values: dict[str, Any]
) -> None:
    found = read_options(own_policies.still, split_options(texts))
    assert found == values
    assert [type(value) for value in found.values()] == [type(v) for v in values.values()]


def test_text_stays_text_where_it_is_declared() -> None:
    def make(a: str, b: str | None, c: int | None, d: bool, e, f: list[int]) -> None: ...  # type: ignore[no-untyped-def]

    typed = split_options(["a=7", "b=null", "c=null", "d=true", "e=x=y", "f=[1]"])
    assert read_options(make, typed) == {
        **{"a": "7", "b": "null", "c": None, "d": True, "e": "x=y", "f": [1]},
    }


@pytest.mark.parametrize("text", ["gripper", "=1", "two words=1", ""])
def test_what_is_no_option(text: str) -> None:
    with pytest.raises(InvalidOptionError, match="is not an option") as raised:
        split_options([text])
    assert raised.value.hint == "Expected NAME=VALUE, such as --policy-option device=cpu."


def test_an_option_is_given_once() -> None:
    with pytest.raises(InvalidOptionError, match="--policy-option a is given twice"):
        split_options(["a=1", "b=1", "a=2"])


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        ("websocket://a:1", {"attempts": 2.5}, "attempts is 2.5\nExpected a whole number."),
        ("websocket://a:1", {"attempts": True}, "attempts is True\nExpected a whole number."),
        ("websocket://a:1", {"connect_s": "soon"}, "connect_s is 'soon'\nExpected a number."),
        ("python:own_policies:still", {"gripper": None}, "gripper is None\nExpected a number."),
        ("hold", {"speed": 1}, "Its options: none."),
        ("websocket://a:1", {"port": 2}, "port"),
    ],
)
def test_options_that_do_not_fit(text: str, options: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidOptionError) as raised:
        make_policy(text, **options)
    assert words in str(raised.value)


def identity_of(text: str, said: dict[str, Any], **options: Any) -> dict[str, Any]:
    bound = bind_options(text, *policy_factory(text), options)
    return policy_identity(parse_policy(text).kind, text, bound, said)


def test_what_of_a_policy_can_change_a_result() -> None:
    # A default is the same, given or not.
    assert identity_of("replay", {}) == identity_of("replay", {}, memory="full")
    assert identity_of("replay", {}, memory="window")["policy_options"] == {"memory": "window"}
    here = {"policy": "websocket", "server": "a:1", "server_metadata": {"model": "m"}}
    assert identity_of("websocket://a:1,b:2", here, response_s=5.0) == {
        "policy": "websocket",
        "policy_options": {"chunk_frames": 16},
        "policy_metadata": {"policy": "websocket", "server_metadata": {"model": "m"}},
    }
    loaded = {"source": "out/last", "device": "cuda", "sha256": "ab"}
    assert policy_identity("lerobot", "lerobot:out/last", {"device": "cuda"}, loaded) == {
        "policy": "lerobot",
        "policy_options": {},
        "policy_metadata": {"sha256": "ab"},
    }
    changed = "python:own_policies:changed"
    assert identity_of(changed, {}, name="x", value=[1])["policy_options"]["value"] == [1]
    assert "value" not in identity_of(changed, {}, name="x", value=object())["policy_options"]
    whole = identity_of("python:own_policies:Still", {}, gripper=1)
    assert repr(whole) == repr(identity_of("python:own_policies:Still", {}))
    own = identity_of("python:own_policies:Still", {"device": "cuda"}, gripper=0.5)
    assert own == {
        "policy": "python:own_policies:Still",
        "policy_options": {"gripper": 0.5},
        "policy_metadata": {"device": "cuda"},
    }


def test_a_factory_that_asks_is_told_its_worker() -> None:
    policy: Any = make_policy("python:own_policies:Still", worker=3)
    assert isinstance(policy, own_policies.Still)
    assert policy.worker == 3


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        ("python:no_such_module:make", UnknownNameError, "PYTHONPATH"),
        ("python:own_policies.deeper:make", UnknownNameError, "no module 'own_policies.deeper'"),
        ("python:own_policies:stil", UnknownNameError, "Did you mean 'still'"),
        ("python:own_policies:NUMBER", UnknownNameError, "has no function 'NUMBER'"),
        (
            "python:own_policies:nothing",
            PolicyError,
            "object has no cameras, history_cameras, wants_history",
        ),
        ("python:own_policies:nothing", PolicyError, "reset(), add_history()"),
        ("python:own_policies:all_cameras", PolicyError, "cameras are ('front', 'top')"),
        ("python:own_policies:one_camera", PolicyError, "Expected a tuple"),
        ("python:builtins:dict", PolicyError, "dict has no cameras"),
    ],
)
def test_a_factory_that_is_none(text: str, error: type[Exception], words: str) -> None:
    with pytest.raises(error) as raised:
        make_policy(text)
    assert words in str(raised.value)


@pytest.mark.parametrize("name", sorted(MEMBERS))
def test_every_member_of_the_protocol_is_asked_for(name: str) -> None:
    with pytest.raises(PolicyError, match=rf"Lacking has no {name}(\(\))?\n") as raised:
        make_policy("python:own_policies:lacking", name=name)
    assert "docs/systems.md has one" in str(raised.value)


def test_a_policy_has_what_the_protocol_lists() -> None:
    assert set(dir(own_policies.Still)) >= MEMBERS
    assert len(MEMBERS) == 11


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("history_cameras", None, "its history_cameras are None"),
        ("history_cameras", ("top",), "Expected a tuple of 'front' and 'wrist'"),
        ("cameras", {"front": 1}, "its cameras are {'front': 1}"),
        ("wants_history", "no", "its wants_history is 'no'"),
        ("privileged", None, "Expected True or False"),
        ("every_frame", 1, "its every_frame is 1"),
        ("act", 3, r"has no act()"),
    ],
)
def test_a_member_of_another_kind(name: str, value: Any, words: str) -> None:
    with pytest.raises(PolicyError) as raised:
        make_policy("python:own_policies:changed", name=name, value=value)
    assert words in str(raised.value)


def test_a_list_of_cameras_will_do() -> None:
    policy = make_policy("python:own_policies:changed", name="cameras", value=["wrist"])
    assert policy.cameras == ["wrist"]


def test_a_module_that_does_not_import_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "broken_policy.py").write_text("import not_installed_here\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(PolicyError, match="No module named 'not_installed_here'"):
        make_policy("python:broken_policy:make")


@pytest.mark.parametrize("library", ["websockets", "msgpack"])
def test_a_missing_library_names_the_extra(library: str, monkeypatch: pytest.MonkeyPatch) -> None:
    package = "robomme_interference_data.evaluate.policies"
    for name in list(sys.modules):
        if name.startswith((f"{package}.w", f"{package}.connection", library)):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(MissingExtraError) as raised:
        make_policy("websocket://a:1")
    assert raised.value.hint == "pip install 'robomme-interference-data[evaluate]'"
    assert f"needs {library}" in raised.value.message
