"""Simulators in an interpreter of their own: what arrives, failures, versions and options."""

import ast
import importlib
import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from multiprocessing.connection import Pipe
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of
from support.buffer_sets import build, dataset
from support.dot_worker import DARK, DIES, RAISES
from support.messages import raises
from support.remote_simulators import Dot
from support.worker_calls import wait_until_gone

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.sources import open_source
from robomme_interference_data.build_dataset.verify.replay import plan_replay
from robomme_interference_data.errors import (
    InvalidOptionError,
    MissingExtraError,
    NoRendererError,
    SimulatorCrashError,
    SimulatorError,
    UnknownNameError,
)
from robomme_interference_data.evaluate.rollout.runner import plan_rollouts
from robomme_interference_data.evaluate.run.config import RunConfig
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.schema.records import EvidenceSpan
from robomme_interference_data.simulators import Status
from robomme_interference_data.simulators.remote import worker as remote_worker
from robomme_interference_data.simulators.remote.interpreter import Interpreter
from robomme_interference_data.simulators.remote.process import RemoteProcess

Run = Callable[..., tuple[int, str, str]]

DOT = "support.remote_simulators:Dot"
RIGHT = np.array([1, 0], np.float32)


@pytest.fixture
def dot(bare_python: Path) -> Iterator[Dot]:
    with Dot(bare_python) as made:
        yield made


# --- what arrives ------------------------------------------------------------------------------


def test_an_episode_is_what_the_worker_returns(dot: Dot, bare_python: Path) -> None:
    lesson, first, info = dot.reset("RightSide/test/1")
    # Each step moves down by one cell, every first, third, … step by another one; the last value
    # counts them.
    assert lesson.states.tolist() == [[0, 0, 0], [0, 2, 1], [0, 3, 2]]
    assert (lesson.states.dtype, first.state.tolist()) == (np.float32, [0, 5, 3])
    assert lesson.actions.tolist() == [[0, 1]] * 3
    assert lesson.evidence == (EvidenceSpan(0, "falls", 1, 3),) and lesson.scene == "a wall"
    frames = lesson.images["top"]
    assert (frames.shape, frames.dtype) == ((3, 16, 16, 3), np.uint8)
    assert [np.argwhere(frame[..., 0] == 255).tolist() for frame in frames] == [
        [[0, 8]],
        [[2, 8]],
        [[3, 8]],
    ]
    assert first.images["top"][5, 8].tolist() == [255] * 3
    assert (info.goals, info.seed, info.difficulty) == (("go to the side",), 101, "easy")
    assert info.simulator == "dot"
    fewer, _, _ = dot.reset("RightSide/test/1", demonstration=2)
    assert np.array_equal(fewer.images["top"], frames[::2])
    none, seen, _ = dot.reset("RightSide/test/1", demonstration=False)
    assert none.images == {} and np.array_equal(seen.images["top"], first.images["top"])
    blind, seen, _ = Dot(bare_python, cameras=()).reset("RightSide/test/1")
    assert blind.images == seen.images == {} and np.array_equal(blind.states, lesson.states)


def test_an_action_arrives_bit_for_bit(dot: Dot) -> None:
    dot.reset("RightSide/test/0")
    action = np.array([np.float32(0.1), np.float32(1e-20)], np.float32)
    seen, status = dot.step(action, observe=False)
    # From (0, 5), the fourth step: no further cell down.
    assert seen.state.tolist() == [action[0], 5 + action[1], 4]
    assert (status, seen.images) == (Status.ONGOING, {})
    assert dot.act("oracle").tolist() == [1, 0] and dot.act("guess").tolist() == [-1, 0]
    ends = []
    for policy in ("oracle", "guess"):
        dot.reset("RightSide/test/0")
        status = Status.ONGOING
        while status is Status.ONGOING:
            _, status = dot.step(dot.act(policy))
        ends.append(status)
    assert ends == [Status.SUCCESS, Status.FAIL]


_DTYPES = st.sampled_from(["<f4", ">f8", "|u1", "<i8", "|b1"])
_ARRAYS = arrays_of.arrays(_DTYPES, arrays_of.array_shapes(min_dims=2, max_dims=4, max_side=5))
_VALUES = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text()


@settings(max_examples=20, deadline=None)
@given(
    st.dictionaries(st.text().filter(lambda name: name != "arrays"), _VALUES, max_size=3),
    st.dictionaries(st.text(), _ARRAYS, max_size=3),
    st.booleans(),
)
def test_a_message_arrives_as_it_was_sent(
    head: dict[str, Any], arrays: dict[str, Any], listed: bool
) -> None:
    ours, theirs = Pipe()
    with ours, theirs:
        remote_worker.send(ours, head, {n: [*a] if listed else a for n, a in arrays.items()})
        read, received = remote_worker.receive(theirs)
    assert read == head and received.keys() == arrays.keys()
    for name, array in arrays.items():
        assert received[name].dtype == array.dtype
        assert received[name].tobytes() == array.tobytes()


# --- processes ---------------------------------------------------------------------------------


def test_a_process_plays_so_many_episodes(dot: Dot) -> None:
    played = [(dot.reset("LeftSide/test/0")[0].states.tolist(), dot.pid) for _ in range(5)]
    states, pids = zip(*played, strict=True)
    assert states.count(states[0]) == 5
    assert [pids.index(pid) for pid in pids] == [0, 0, 2, 2, 4]
    wait_until_gone([int(pids[0]), int(pids[2])], seconds=20)


def test_failures_end_the_episode_or_the_process(bare_python: Path) -> None:
    with Dot(bare_python) as dot:
        dot.reset(f"RightSide/test/{RAISES}")
        pid = dot.pid
        with raises(SimulatorCrashError):
            dot.step(RIGHT)
        assert dot.pid == pid  # only the episode has ended
        with raises(UnknownNameError):
            dot.reset("RightSide/test/99")
        with raises(NoRendererError):
            dot.reset(f"RightSide/test/{DARK}")
        with raises(SimulatorCrashError) as caught:
            dot.reset(f"RightSide/test/{DIES}")
        assert (caught.value.hint or "").endswith("\nfalling")
        assert dot.pid is None
        assert len(dot.reset("RightSide/test/0")[0]) == 3


def test_an_incomplete_answer_names_what_is_missing(bare_python: Path, tmp_path: Path) -> None:
    file = tmp_path / "half_worker.py"
    file.write_text(
        "class Episodes:\n"
        "    def __init__(self, cameras): self.cameras = cameras\n"
        "    def reset(self, family, split, index, frame_step):\n"
        "        import numpy as np\n"
        "        states = [np.zeros(3, np.float32)] * 4\n"
        "        image = [np.zeros((4, 4, 3), np.uint8)] * 4\n"
        "        whole = {'states': states, 'top': image}\n"
        "        facts = {3: {'goals': 'go'}, 4: {'goals': ['go']}}.get(index, {})\n"
        "        return facts, [{}, {'states': states}, whole, whole, whole][index]\n"
        "    def step(self, action, observe): return {'status': 'done'}, {}\n"
        "    def close(self): pass\n"
    )
    half = type("Half", (Dot,), {"worker": file})
    with half(bare_python) as simulator:
        for index in range(4):
            with raises(SimulatorError):
                simulator.reset(f"LeftSide/test/{index}")
        simulator.reset("LeftSide/test/4")
        with raises(SimulatorError):
            simulator.step(RIGHT)


# --- interpreters ------------------------------------------------------------------------------


def test_the_worker_program_is_of_python_3_8() -> None:
    source = Path(remote_worker.__file__).read_text(encoding="utf-8")
    ast.parse(source, feature_version=(3, 8))
    imported = {
        name.name.partition(".")[0]
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Import)
        for name in node.names
    }
    assert imported - {"numpy"} <= sys.stdlib_module_names


@pytest.mark.slow
@pytest.mark.parametrize("version", ["3.8", "3.9", "3.10", "3.11"])
def test_an_older_python_runs_the_worker(version: str, tmp_path: Path) -> None:
    python = _python(version)
    file = tmp_path / "worker_without_numpy.py"
    file.write_text(
        "import sys\n"
        "class Episodes:\n"
        "    def version(self): return {'python': list(sys.version_info[:2])}, {}\n"
    )
    interpreter = Interpreter.find("old", "nothing", (3, 8), python)
    process = RemoteProcess(interpreter, file, {}, 60)
    try:
        facts, _ = process.call("version")
    finally:
        process.end()
    assert facts == {"python": [int(part) for part in version.split(".")]}


def _python(version: str) -> str:
    """An interpreter of this version, such as pyenv's, which is found but does not run."""
    places = [shutil.which(f"python{version}")]
    places += sorted(map(str, Path.home().glob(f".pyenv/versions/{version}.*/bin/python")))
    for python in filter(None, places):
        if subprocess.run([python, "-c", ""], capture_output=True, check=False).returncode == 0:
            return python
    pytest.skip(f"there is no Python {version}")


def test_an_interpreter_that_is_too_old(tmp_path: Path) -> None:
    # One that knows nothing of our files, but says its version, as Python 2 would.
    python = tmp_path / "python"
    python.write_text('#!/bin/sh\n[ "$1" = -c ] && echo 2.7 && exit\nexit 1\n')
    python.chmod(0o755)
    with raises(InvalidOptionError):
        Dot(python)
    with raises(InvalidOptionError):
        Dot.versions(str(python))


def test_a_missing_library_is_named(bare_python: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DOT_NEEDS", "falling_dots.physics")
    with raises(MissingExtraError) as caught:
        Dot(bare_python)
    assert caught.value.hint == (  # the environment has no pip
        f"Install what is missing: uv pip install --python {bare_python} falling-dots"
    )
    with raises(MissingExtraError) as caught:  # not into the environment of this package
        Dot(sys.executable)
    assert "into a separate environment" in str(caught.value.hint)


# --- the command line --------------------------------------------------------------------------


def test_interpreter_and_options_are_set_by_options(
    bare_python: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ("simulate", "RightSide/test/0", "--simulator", DOT, "--json")
    chosen = ("--simulator-python", str(bare_python))
    code, out, _ = run(*command, *chosen)
    assert (code, json.loads(out)["status"]) == (0, "success")
    for given_options, words in (
        ((), "DOT_PYTHON"),
        ((*chosen, "--simulator-option", "heigth=3"), "unexpected keyword argument 'heigth'"),
        ((*chosen, "--simulator-option", "cameras=top"), "there is no option cameras"),
        (("--simulator-python", "/nowhere/python"), "not an executable file"),
    ):
        code, _, err = run(*command, *given_options)
        assert code == 1 and words in err
    monkeypatch.setenv("DOT_PYTHON", str(bare_python))
    assert run(*command)[0] == 0
    code, _, err = run("simulate", "MoveCube/test/0", *chosen)
    assert code == 1 and "--simulator-python has no effect" in err


def test_sources_read_with_its_options_and_record_them(bare_python: Path, run: Run) -> None:
    chosen = {"simulator_python": str(bare_python), "simulator_options": ("weight=2.0",)}
    with closing(open_source(DOT, **chosen)) as source:
        [planned] = [one for one in source.episodes() if str(one.id) == "LeftSide/test/1"]
        with closing(source.read(planned, ()).frames) as frames:
            states = [next(frames).state.tolist() for _ in range(4)]
    # With that weight every first, third, … step moves down by two further cells.
    assert states == [[0, 0, 0], [0, 3, 1], [0, 4, 2], [0, 7, 3]]
    assert source.provenance["options"] == ["weight=2.0"]
    with raises(InvalidOptionError):
        open_source(DOT, **chosen | {"simulator_options": ("cameras=top",)})
    with raises(InvalidOptionError):
        open_source("tabletop", simulator_python=str(bare_python))
    code, _, err = run("build", "x", "--source", "sample", "--simulator-option", "a=1")
    assert code == 1 and "no effect on sample" in err


def test_verify_plays_again_with_its_interpreter_and_options(
    bare_python: Path, tmp_path: Path
) -> None:
    chosen = {"simulator_python": str(bare_python), "simulator_options": ("weight=2.0",)}
    lessons = {"families": ("LeftSide",), "split": "test", "numbers": (1,)}
    build(tmp_path, "demonstrations", open_source(DOT, **chosen), **lessons)
    stored = {"demonstrations": dataset(tmp_path, "demonstrations")}
    for options, wrong in ((("weight=2.0",), 0), ((), 1)):
        plan = plan_replay(stored, DOT, **chosen | {"simulator_options": options})
        found = [*plan.run(Serial(), WorkProgress(quiet=True))]
        assert sum("observation.state" in violation.what for violation in found) == wrong


def test_runs_are_identified_by_its_versions_and_options(
    bare_python: Path, tiny_buffers: Path, tmp_path: Path
) -> None:
    settings = RunConfig(
        policy="oracle",
        buffer_set=str(tiny_buffers),
        out=tmp_path,
        simulator="support.remote_simulators:AnyDot",
        simulator_python=str(bare_python),
        simulator_options=("weight=2.0",),
    )
    planned = plan_rollouts(settings, load_buffer_set(tiny_buffers))
    assert planned.run.identity["simulator_options"] == ["weight=2.0"]
    versions = planned.run.identity["simulator_version"]
    assert versions.keys() == {"dot", "dot_python", "dot_numpy"}
    assert (versions["dot"], versions["dot_numpy"][:2]) == ("4", "1.")


# --- the example -------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_example_runs_in_an_interpreter_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The environment of docs/how-to/another-benchmark.md, with the example in it."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "venv"], check=True)
    python = tmp_path / "venv" / "bin" / "python"
    install = [sys.executable, "-m", "pip", "--no-input", "--quiet", "--python", str(python)]
    install += ["install", "gymnasium-robotics==1.4.2", "mujoco<3.4"]
    done = subprocess.run(install, capture_output=True, text=True, timeout=500, check=False)
    if done.returncode != 0:
        pytest.skip(f"no package index gives Gymnasium-Robotics: {done.stderr.strip()[-500:]}")
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "examples" / "own_simulator")
    reach = importlib.import_module("reach").ReachSimulator
    assert reach.versions(str(python))["reach_gymnasium-robotics"] == "1.4.2"
    with reach(python, cameras=()) as simulator:
        lessons = {}
        for policy in ("oracle", "guess"):
            ends = []
            for episode in [episode for episode in reach.episodes() if episode.split == "test"]:
                lesson, first, _ = simulator.reset(str(episode))
                again = lessons.setdefault(str(episode), lesson)
                assert np.array_equal(lesson.states, again.states)
                assert (len(lesson), first.state.shape) == (10, (10,))
                status = Status.ONGOING
                while status is Status.ONGOING:
                    _, status = simulator.step(simulator.act(policy))
                ends.append(status)
            assert (set(ends) == {Status.SUCCESS}) is (policy == "oracle")
