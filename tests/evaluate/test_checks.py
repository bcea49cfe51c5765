"""Checks before a run: settings, the simulator, and the names of systems."""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from support.buffer_sets import QUERIES, copy_buffer_set
from support.messages import raises
from support.retrieval import QUIET, make_index
from support.runs import CHEAT, config, header, run, run_one
from support.worlds import World

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.dataset.build import build_dataset
from robomme_interference_data.build_dataset.dataset.plan import DatasetPlan, PlannedEpisode
from robomme_interference_data.build_dataset.manifests import plan_manifests, write_manifests
from robomme_interference_data.build_dataset.plan.episodes import choose_episodes
from robomme_interference_data.build_dataset.plan.planned import datasets_in
from robomme_interference_data.build_dataset.sources.sample import SampleSource
from robomme_interference_data.constants import CONTRADICTIONS
from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    MissingExtraError,
    MissingFileError,
    NoRendererError,
    PolicyError,
    PolicyServerError,
    UnknownNameError,
)
from robomme_interference_data.evaluate import systems
from robomme_interference_data.evaluate.policies.registry import make_policy
from robomme_interference_data.evaluate.rollout.checks import (
    check_plan,
    check_policy,
    check_settings,
)
from robomme_interference_data.evaluate.rollout.settings import (
    check_system,
    default_system,
    simulator_options,
)
from robomme_interference_data.evaluate.run.plan import plan_work
from robomme_interference_data.evaluate.systems import name_system
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.simulators.registry import SIMULATORS

pytestmark = pytest.mark.usefixtures("world")

STEP: dict[str, Any] = {"retrieval": "thumbnail"}
SAYS = {"policy": "python:support.own_policies:says"}


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"policy": "websocket://a:1", "system": None}, InvalidOptionError, "need a name"),
        ({"policy": "python:__main__:make"}, InvalidOptionError, "__main__"),
        ({"simulator": "tabeltop"}, UnknownNameError, "no simulator 'tabeltop'"),
        ({"simulator": "tabletop"}, InvalidOptionError, "recorded on 'sample', the run is on"),
        ({"shift": "fog:1"}, InvalidOptionError, "shift 'fog:1'; expected none, or light"),
        ({"shift": "light:2"}, InvalidOptionError, "support.worlds:World does not support shifts"),
        ({"split": "tset"}, InvalidOptionError, "'tset' is none of train, val, test"),
        ({"conditions": ("k2",)}, UnknownNameError, "condition 'k2' is not in"),
        ({"rollout_timeout_s": float("nan")}, InvalidOptionError, "rollout_timeout_s nan"),
        ({"system": "pi05_baseline"}, InvalidOptionError, "the system takes no history, so k0"),
        (STEP | {"system": "retrieval-framesamp-modul"}, InvalidOptionError, "nothing to retrieve"),
        ({"system": "retrieval-framesamp-modul"}, InvalidOptionError, "`retrieval` is None"),
        ({"retrieval_rule": "oracle"}, InvalidOptionError, "`retrieval_rule` has no effect"),
        ({"retrieval": "foo", "policy": "lerobot:no/where"}, UnknownNameError, "no encoder 'foo'"),
        (STEP | {"retrieval_camera": "nose"}, UnknownNameError, "camera 'nose'"),
        (STEP | {"conditions": ("k0",)}, MissingFileError, "'thumbnail'"),
        (SAYS | {"policy_options": ("what=nan",)}, PolicyError, "holds nan"),
    ],
)
def test_invalid_settings_are_errors_before_anything_is_written(
    tmp_path: Path, changes: dict[str, Any], error: type[InterferenceError], words: str
) -> None:
    with pytest.raises(error) as raised:
        run(tmp_path / "run", **changes)
    assert words in raised.value.message
    assert not (tmp_path / "run").exists()


def test_every_condition_needs_its_embeddings(tmp_path: Path) -> None:
    buffer_set, source = copy_buffer_set(tmp_path / "buffer_set"), SampleSource(size=32)
    listed = choose_episodes(
        (source,), split="test", families=[one.split("/")[0] for one in QUERIES]
    )
    episodes = tuple(
        PlannedEpisode(number, source.contradict(episode)) for number, episode in listed
    )
    plan = DatasetPlan(CONTRADICTIONS, (source,), episodes)
    build_dataset(plan, buffer_set / CONTRADICTIONS, Serial(), QUIET)
    sum(write_manifests(plan_manifests(datasets_in(buffer_set), ("k0", "stale-k0")), buffer_set))
    make_index(buffer_set)
    settings = STEP | {"buffer_set": buffer_set, "families": ("MoveCube",)}
    with raises(MissingFileError):
        run(tmp_path / "run", **settings, conditions=("k0", "stale-k0"))
    assert not (tmp_path / "run").exists()
    assert run(tmp_path / "run", **settings, conditions=("k0",)).counts["error"] == 0


def test_videos_need_pillow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "PIL", None)
    with raises(MissingExtraError):
        run_one(tmp_path / "run", videos=True)
    assert not (tmp_path / "run").exists()


def test_conditions_beyond_a_systems_positions_are_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Of 4096 positions the rollout takes 3952: 144 remain for the history.
    monkeypatch.setattr(systems, "MAX_STEPS", 3952)
    limited = {"system": "perceptual-framesamp-modul"}
    run(tmp_path / "run", conditions=("k0", "k3"), **limited)  # 48 + 3 · 32
    for conditions in (("k3", "k7"), ()):
        with raises(InvalidOptionError):
            run(tmp_path / "run", conditions=conditions, **limited)


def test_the_default_is_all_conditions_that_apply(tmp_path: Path) -> None:
    def conditions(name: str, **changes: Any) -> list[str]:
        result = run_one(tmp_path / name, conditions=(), **changes)
        return [row.condition for row in result.rows]

    assert conditions("all") == ["no-history", "k0", "k1", "k3", "k7"]
    assert conditions("baseline", system="pi05_baseline") == ["no-history"]
    still = "python:support.own_policies:Still"  # takes no history
    assert conditions("still", policy=still) == ["no-history"]
    with raises(InvalidOptionError):
        run_one(tmp_path / "k0", policy=still, conditions=("k0",))


@pytest.mark.parametrize(
    "wrong",
    [
        {"families": ("NoFamily",)},
        {"episodes": "99"},
        {"conditions": ("k5",)},
        {"shift": "fog:1"},
        {"simulator": "robomme"},  # without an interpreter
    ],
)
def test_cheap_checks_come_before_a_server_is_waited_for(
    tmp_path: Path, wrong: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("ROBOMME_PYTHON", raising=False)
    # No server listens there: it would be waited for, 600 s by default.
    absent: dict[str, Any] = {"policy": "websocket://127.0.0.1:9", "system": "mine"}
    with raises(InterferenceError):
        run(tmp_path / "run", policy_options=("checkpoint=c",), **absent | wrong)
    assert not (tmp_path / "run").exists()


# --- the simulator -----------------------------------------------------------------------------


def test_the_simulator_is_made_before_the_folder_and_only_for_remaining_rollouts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[dict[str, Any]] = []

    def make(**options: Any) -> Any:
        made.append(options)
        if len(made) > working:
            raise NoRendererError("no driver", "Install one.")
        return World()

    working = 1
    monkeypatch.setitem(SIMULATORS, "sample", make)
    sample = {"simulator": "sample"}
    whole = run_one(tmp_path / "whole", **sample)
    assert (len(whole.rows), len(made)) == (1, 1)
    with pytest.raises(NoRendererError):
        run_one(tmp_path / "run", **sample)
    assert not (tmp_path / "run").exists()
    assert run_one(tmp_path / "whole", **sample).rows == whole.rows
    assert len(made) == 2
    with pytest.raises(NoRendererError):
        run_one(tmp_path / "whole", conditions=("no-history", "k0"), **sample)


def test_a_run_without_a_renderer_ends_once_and_resumes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Dark(World):
        def reset(self, *given: Any, **more: Any) -> Any:
            if broken:
                raise NoRendererError.without_vulkan("vk::createInstanceUnique")
            return super().reset(*given, **more)

    broken = True
    monkeypatch.setitem(SIMULATORS, "sample", lambda **options: Dark())
    with raises(NoRendererError):
        run(tmp_path / "run", simulator="sample")
    assert not (tmp_path / "run" / "errors.log").exists()
    assert "no Vulkan device" in header(tmp_path / "run")["invocations"][0]["stopped"]
    broken = False
    resumed = run(tmp_path / "run", simulator="sample")
    assert [row.attempt for row in resumed.rows] == [1] * 4
    # A simulator that is tried out shows it before there is a folder.
    with raises(NoRendererError):
        run(tmp_path / "tried", simulator="support.own_simulators:Dark")
    assert not (tmp_path / "tried").exists()


def test_only_cameras_in_use_are_rendered(tiny_buffers: Path) -> None:
    demonstrations = load_buffer_set(tiny_buffers).datasets["demonstrations"]

    def options(name: str, *watched: str, **changes: Any) -> dict[str, Any]:
        return simulator_options(config(simulator=name, **changes), watched, demonstrations)

    assert options("tabletop") == {"cameras": (), "shift": "none"}
    assert options("tabletop", shift="light:2") == {"cameras": (), "shift": "light:2"}
    assert options("tabletop", "wrist")["cameras"] == ("wrist",)
    step = STEP | {"retrieval_camera": "wrist"}
    assert options("tabletop", "front", **step)["cameras"] == ("front", "wrist")
    assert options("tabletop", videos=True)["cameras"] == ("front", "wrist")
    assert options("robomme", "front", simulator_timeout_s=100.0) == {
        **{"cameras": ("front",), "answer_s": 90.0, "subgoals": False, "python": None}
    }
    oracle = {"policy": "websocket://h:1", "subgoals": "oracle"}
    assert options("robomme", "front", **oracle)["subgoals"] is True


def test_recall_needs_evidence(tiny_buffers: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    buffer_set = load_buffer_set(tiny_buffers)
    unknown = SimpleNamespace(record=SimpleNamespace(evidence=None))
    monkeypatch.setattr(buffer_set, "query", lambda _: unknown)
    settings = config(policy="recall:window")
    plan = plan_work(buffer_set.episode_ids, conditions=("k0",))
    with raises(InvalidOptionError) as raised:
        check_plan(settings, name_system("recall-window"), buffer_set, plan, plan.items())
    assert "reference/sources" in (raised.value.hint or "")


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"families": ("Nope",)}, UnknownNameError),
        ({"conditions": ("k99",)}, InterferenceError),
        ({"episodes": "7777"}, UnknownNameError),
        ({"shift": "fog:1"}, InvalidOptionError),
        ({"simulator": "nowhere:Nothing"}, InterferenceError),
        ({"shard": "5/2"}, InvalidOptionError),
    ],
)
def test_mistakes_are_found_before_a_server_is_asked(
    tmp_path: Path, changes: dict[str, Any], error: type[InterferenceError]
) -> None:
    settings: dict[str, Any] = {
        "policy": "websocket://127.0.0.1:9",
        "policy_options": ("connect_s=0.1",),
    }
    with pytest.raises(PolicyServerError):
        run(tmp_path / "run", **settings)
    with pytest.raises(error) as raised:
        run(tmp_path / "run", **settings | changes)
    assert not isinstance(raised.value, PolicyServerError)


# --- names -------------------------------------------------------------------------------------


def check_name(tiny_buffers: Path, system: str, **changes: Any) -> None:
    settings = config(**{"simulator": "tabletop"} | changes)
    check_system(settings, system)
    opened = load_buffer_set(tiny_buffers)
    check_settings(settings, opened)
    check_policy(settings, opened, make_policy("noop"))


@pytest.mark.parametrize(
    ("changes", "name", "other"),
    [
        ({}, "replay-window", "replay-full"),
        ({"policy_options": ("extrapolate=true",)}, "replay-window-extrapolate", "replay-window"),
        (
            {
                "policy": "follow-subgoals",
                "subgoals": "oracle",
                "policy_options": ("points=false",),
            },
            *("follow-subgoals-oracle-simple", "follow-subgoals-oracle"),
        ),
        (
            {"retrieval": "siglip", "retrieval_rule": "max/0.9", "retrieval_camera": "wrist"},
            *("retrieval-replay-window-max-0.9-wrist", "retrieval-replay-window"),
        ),
        ({"policy": "replay:window:60@2"}, "replay-window60s2fps", "replay-window"),
    ],
)
def test_the_default_name_states_the_policy_and_the_retrieval_step(
    tiny_buffers: Path, changes: dict[str, Any], name: str, other: str
) -> None:
    settings: dict[str, Any] = {"policy": "replay:window"} | changes
    assert default_system(config(**settings)) == name
    check_name(tiny_buffers, name, **settings)
    with raises(InvalidOptionError):
        check_name(tiny_buffers, other, **settings)
    assert default_system(config(policy="python:my.module:make")) == "my.module-make"


@pytest.mark.parametrize(
    ("policy", "system", "words"),
    [
        ("oracle", "perceptual-framesamp-modul", "is not the paper's system"),
        ("lerobot:x/y", "pi05_baseline", "is not the paper's system"),
        ("replay:window", "replay-full", "replay:window is not the control"),
        (CHEAT, "oracle", "is not the control oracle"),
        (CHEAT, "retrieval-replay-full", "is not the control"),
        ("websocket://h:1", "memer", "acts on subgoals of a model"),
        ("oracle", "my-upper-end", None),
        ("websocket://h:1", "perceptual-framesamp-modul", None),
        (CHEAT, "memer", None),
        ("replay:window:120@1", "simplememvla", "is not the system simplememvla"),
        ("lerobot:x/y", "pi05-mem", "is not the system pi05-mem"),
        ("websocket://h:1", "simplememvla", None),
        (CHEAT, "pi05-mem", None),
    ],
)
def test_a_name_of_the_table_needs_its_policy(
    tiny_buffers: Path, policy: str, system: str, words: str | None
) -> None:
    if words is None:
        check_name(tiny_buffers, system, policy=policy)
        return
    with raises(InvalidOptionError) as raised:
        check_name(tiny_buffers, system, policy=policy)
    assert raised.value.hint is not None and "name of your own" in raised.value.hint


def test_a_named_system_brings_its_memory(tmp_path: Path, tiny_buffers: Path) -> None:
    """MoveCube's lesson of 48 frames shows the answer in frames 0 to 3, and in 31 to 38."""
    found = {}
    for system in ("simplememvla", "pi05-mem", "mine"):
        (row,) = run_one(tmp_path / system, policy=CHEAT, system=system, conditions=("k0",)).rows
        found[system] = row.memory, row.evidence_kept
    # 38, 28, 18 and 8 are kept by both.
    assert found == {
        "simplememvla": ("window:120@1", 0.5),
        "pi05-mem": ("window:6@1", 0.5),
        "mine": (None, None),
    }
    with raises(InvalidOptionError):
        check_name(tiny_buffers, "simplememvla", policy="websocket://h:1", retrieval="siglip")


def test_the_papers_retrieval_system_chooses_by_max(tiny_buffers: Path) -> None:
    served = {"policy": "websocket://h:1", "retrieval": "siglip"}
    check_name(tiny_buffers, "retrieval-framesamp-modul", **served)
    with raises(InvalidOptionError):
        check_name(tiny_buffers, "retrieval-framesamp-modul", retrieval_rule="last/0.9", **served)
    with raises(InvalidOptionError):
        check_name(tiny_buffers, "perceptual-framesamp-modul", **served)
