"""Policies from text: parsing, errors before any episode, options, and user-defined policies."""

import ast
import dataclasses
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.messages import raises

from robomme_interference_data import evaluate
from robomme_interference_data.errors import (
    InvalidOptionError,
    MissingExtraError,
    PolicyError,
    UnknownNameError,
)
from robomme_interference_data.evaluate.policies.identity import policy_identity
from robomme_interference_data.evaluate.policies.kinds import PolicyKind, Role, ServerAddress
from robomme_interference_data.evaluate.policies.policy import Policy
from robomme_interference_data.evaluate.policies.registry import (
    POLICIES,
    make_policy,
    policy_kind,
    policy_memory,
    policy_options,
    server_addresses,
)
from robomme_interference_data.runtime.specs import Spec, SpecKind, bind_options
from robomme_interference_data.simulators.base import Simulator
from robomme_interference_data.simulators.recordings import Recordings
from robomme_interference_data.simulators.registry import SIMULATORS, simulator_class

OWN = "python:support.own_policies:"
STILL = f"{OWN}Still"


def test_a_policy_is_parsed() -> None:
    assert POLICIES.parse("lerobot:out/last:1") == Spec("lerobot", "out/last:1")
    assert [str(POLICIES.parse(text)) for text in ("replay", "recall")] == [
        *("replay:full", "recall:full")
    ]
    places = [("gpu-1.lab", 8013), ("10.0.0.2", 1), ("::1", 65535)]
    written = "//gpu-1.lab:8013,10.0.0.2:1,[::1]:65535"
    for scheme, tls in (
        ("websocket:", False),
        ("websocket:wss:", True),
        ("vla-eval:ws:", False),
        ("vla-eval:wss:", True),
    ):
        expected = tuple(ServerAddress(*place, tls) for place in places)
        assert server_addresses(f"{scheme}{written}") == expected


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        ("websockets://a:1", UnknownNameError, "Did you mean 'websocket'?"),
        ("lamp:Lamp", UnknownNameError, "write python:lamp:Lamp"),
        ("wss://a:1", UnknownNameError, "Write websocket:wss://a:1"),
        ("ws://a:1", UnknownNameError, "Write websocket://a:1"),
        ("zzz", UnknownNameError, "replay:window:N or replay:window:SECONDS@FPS, recall,"),
        *(
            (text, InvalidOptionError, f"policy '{text}'; expected {text.partition(':')[0]}")
            for text in (
                *("oracle:x", "noop:", "replay:", "websocket", "websocket:a:1", "websocket://"),
                *("websocket://a", "websocket://a:0", "websocket://a:65536", "websocket://a:1/x"),
                *("websocket://a:1,", "websocket://a:1,websocket://b:1", "websocket://a:1,a:1"),
                *("vla-eval", "vla-eval:a:1", "vla-eval://a:1", "vla-eval:ws://a:0"),
                *("lerobot", "lerobot:", "python:module", "python::make", "python:a b:make"),
            )
        ),
    ],
)
def test_invalid_policies_are_errors(text: str, error: type[Exception], words: str) -> None:
    with pytest.raises(error) as raised:
        POLICIES.parse(text)
    assert words in str(raised.value)


@given(
    st.text(max_size=20)
    | st.from_regex(r"(websocket:(wss:)?/?/?|vla-eval:wss?://|python:|lerobot:)[a-z:,1.\[\]]*")
)
def test_any_text_is_a_policy_or_a_clear_error(text: str) -> None:
    try:
        spec = POLICIES.parse(text)
    except (UnknownNameError, InvalidOptionError):
        return
    assert str(spec) == text
    served = spec.kind in ("websocket", "vla-eval")
    assert len(server_addresses(text)) == (text.count(",") + 1 if served else 0)


def test_each_worker_has_a_server() -> None:
    make_policy("websocket://a:1,b:2", worker=1)
    with raises(InvalidOptionError) as raised:
        make_policy("websocket://a:1,b:2", worker=2)
    assert "workers=2" in str(raised.value)
    make_policy("replay", worker=50)


@pytest.mark.parametrize("library", ["websockets", "msgpack"])
def test_a_missing_library_names_the_extra(library: str, monkeypatch: pytest.MonkeyPatch) -> None:
    package = "robomme_interference_data.evaluate.policies"
    for name in list(sys.modules):
        if name.startswith((f"{package}.w", f"{package}.connection", library)):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, library, None)
    with raises(MissingExtraError) as raised:
        make_policy("websocket://a:1")
    assert "robomme-interference-data[evaluate]" in str(raised.value.hint)


# --- options -----------------------------------------------------------------------------------


def test_options_reach_the_policy_with_the_declared_type() -> None:
    policy: Any = make_policy(STILL, ["gripper=-1"], worker=3)
    assert (policy.action[0, 7], policy.worker) == (-1, 3)  # it has a parameter `worker`

    def make(a: str, b: str | None, c: int | None, d: bool, e, f: list[int]) -> None: ...  # type: ignore[no-untyped-def]

    typed = ["a=7", "b=null", "c=null", "d=true", "e=x=y", "f=[1]"]
    assert bind_options("mine", make, {}, typed) == {
        **{"a": "7", "b": "null", "c": None, "d": True, "e": "x=y", "f": [1]}
    }


@pytest.mark.parametrize("texts", [["gripper"], ["=1"], ["two words=1"], ["a=1", "b=1", "a=2"]])
def test_malformed_or_repeated_options_are_errors(texts: list[str]) -> None:
    with raises(InvalidOptionError):
        policy_options("noop", texts)


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        ("websocket://a:1", ["chunk_frames=true"], "chunk_frames is True; expected a whole number"),
        ("websocket://a:1", ["connect_s=soon"], "connect_s is 'soon'; expected a number"),
        ("websocket://a:1", ["memory=full"], "Its options: checkpoint, chunk_frames, "),
        ("websocket://a:1", ["port=2"], "port"),
        ("websocket://a:1", ["connect_s=-1"], "expected positive numbers"),
        ("noop", ["speed=1"], "Its options: none."),
        (f"{OWN}still", [], "the option gripper is missing"),
    ],
)
def test_options_that_do_not_fit(text: str, options: list[str], words: str) -> None:
    with pytest.raises(InvalidOptionError) as raised:
        make_policy(text, options)
    assert words in str(raised.value)


def test_the_part_of_a_policy_that_can_change_a_result() -> None:
    # The default memory may be left out.
    assert [POLICIES.pin(text) for text in ("replay", "replay:full")] == ["replay:full"] * 2
    assert POLICIES.pin("recall:window") == POLICIES.pin("recall:window:32") == "recall:window:32"
    assert make_policy("replay:framesamp:8").metadata()["memory"] == "framesamp:8"
    metadata = {"policy": "websocket", "server": "a:1", "server_metadata": {"model": "m"}}
    assert policy_identity("websocket://a:1,b:2", ("response_s=5", "checkpoint=7"), metadata) == {
        "policy": "websocket",
        "policy_options": {"checkpoint": "7", "chunk_frames": 16, "other_states": "refuse"},
        "policy_metadata": {"policy": "websocket", "server_metadata": {"model": "m"}},
    }
    assert policy_identity(STILL, ("gripper=1",), {}) == policy_identity(STILL, (), {})
    assert policy_identity(STILL, ("gripper=0.5",), {"device": "cuda"}) == {
        "policy": STILL,
        "policy_options": {"gripper": 0.5},
        "policy_metadata": {"device": "cuda"},
    }
    objects = policy_identity("python:support.own_policies:with_object", (), {})
    assert objects["policy_options"] == {"name": "x"}  # values that JSON lacks are left out


# --- what kinds declare ------------------------------------------------------------------------


def test_a_forgotten_capability_is_an_error() -> None:
    capabilities = {one.name for one in dataclasses.fields(PolicyKind)}
    capabilities -= {one.name for one in dataclasses.fields(SpecKind)}
    declared = vars(POLICIES.kinds["noop"])
    assert PolicyKind(**declared) == POLICIES.kinds["noop"]
    for name in sorted(capabilities):
        with raises(TypeError):
            PolicyKind(**{key: value for key, value in declared.items() if key != name})


def test_kinds_declare_what_their_policies_are() -> None:
    for name, kind in POLICIES.kinds.items():
        if kind.role not in (Role.CONTROL, Role.REFERENCE):
            continue
        policy = make_policy(name)
        scripts = {*Simulator.policies, *Recordings.policies}
        assert policy.privileged == (kind.script is not None)
        assert policy.memory == policy_memory(name)
        assert kind.script is None or kind.script in scripts
        assert {*kind.option_labels} <= {*policy_options(name)}
        memory = policy_memory(name)
        assert policy.metadata().get("memory") == memory
        assert memory == ("full" if name in ("replay", "recall") else None)
    assert policy_memory("replay:framesamp") == "framesamp:32"
    assert policy_memory(STILL) is None
    assert policy_kind(STILL) is POLICIES.kinds["python"]


@pytest.mark.parametrize("name", SIMULATORS)
def test_simulators_of_the_package_declare_which_episodes_they_play(name: str) -> None:
    assert {"own_episodes", "try_out"} <= {*vars(simulator_class(name))}


def test_no_check_compares_the_name_of_a_kind() -> None:
    folder = Path(evaluate.__file__).parent
    names = {*POLICIES.kinds, *SIMULATORS}
    rooms = ("policies", "rollout", "run")
    for path in [path for room in rooms for path in (folder / room).glob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Compare):
                texts = {one.value for one in ast.walk(node) if isinstance(one, ast.Constant)}
                assert not texts & names, f"{path}:{node.lineno}"


# --- user-defined policies ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        ("python:no_such_module:make", InvalidOptionError, "PYTHONPATH"),
        ("python:no_such_module:make", InvalidOptionError, "policy 'python:no_such_module:make'"),
        (f"{OWN}stil", UnknownNameError, "Did you mean 'still'"),
        (f"{OWN}NUMBER", UnknownNameError, "function 'NUMBER'"),
        ("python:broken_policy:make", InvalidOptionError, "No module named 'not_installed_here'"),
    ],
)
def test_invalid_factories_are_errors(
    text: str, error: type[Exception], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "broken_policy.py").write_text("import not_installed_here\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(error) as raised:
        make_policy(text)
    assert words in str(raised.value)


def test_a_factory_that_raises_shows_only_its_own_traceback() -> None:
    with raises(PolicyError) as raised:
        make_policy(f"{OWN}raising")
    hint = raised.value.hint or ""
    assert "own_policies.py" in hint and "return 1 / 0" in hint and "registry.py" not in hint


def test_users_import_everything_from_one_place() -> None:
    for name in evaluate.__all__:
        assert getattr(evaluate, name).__name__ == name or name == "Frames"


def test_every_member_of_the_protocol_is_required() -> None:
    members = [name for name in vars(Policy) if not name.startswith("_")]
    assert len(members) == 13
    for name in members:
        with raises(PolicyError):
            make_policy(f"{OWN}lacking", [f"name={name}"])


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("history_cameras", "[3]", "a tuple of names of cameras"),
        ("cameras", '"front"', "cameras 'front'"),
        ("every_frame", "1", "every_frame 1; expected True or False"),
        ("act", "3", r"no method act()"),
        ("memory", '"framsamp:8"', "memory 'framsamp:8'; expected full, framesamp:N"),
        ("memory", "[]", "memory []; expected full, framesamp:N"),
    ],
)
def test_members_of_another_type_are_errors(name: str, value: str, words: str) -> None:
    with pytest.raises(PolicyError) as raised:
        make_policy(f"{OWN}changed", [f"name={name}", f"value={value}"])
    assert words in str(raised.value)
    make_policy(f"{OWN}changed", ["name=cameras", 'value=["wrist"]'])  # a list is accepted


def test_misspelled_declarations_are_one_error() -> None:
    """A subclass has defaults, so nothing else would show the slip."""
    with raises(PolicyError) as raised:
        make_policy(f"{OWN}Misspelled")
    for name in ("camera", "memroy"):
        assert f"an attribute {name}, " in raised.value.message
    assert "size" not in raised.value.message  # an attribute of the user's own


def test_a_file_in_place_of_a_module_is_explained() -> None:
    with pytest.raises(InvalidOptionError) as raised:
        POLICIES.parse("python:pol/file.py:make")
    assert raised.value.hint is not None
    assert "python:file:make" in raised.value.hint and "folder pol" in raised.value.hint
