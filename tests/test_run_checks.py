"""What is found out before a run: what cannot work, the simulator, the names of rows."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest
from run_calls import CHEAT, config
from run_calls import run_one as run

from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    MissingExtraError,
    MissingIndexError,
    NoRendererError,
    UnknownNameError,
)
from robomme_interference_data.evaluate import runner
from robomme_interference_data.evaluate.checks import check_simulator, describe_policy
from robomme_interference_data.evaluate.config import RunConfig, default_system

pytestmark = pytest.mark.usefixtures("world")


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"simulator": "nosuch:thing"}, UnknownNameError, "no simulator 'nosuch:thing'"),
        ({"simulator": "rollout_doubles:Word"}, UnknownNameError, "no attribute 'Word'"),
        ({"conditions": []}, InvalidOptionError, "there is nothing to run"),
        ({"families": []}, InvalidOptionError, "there is nothing to run"),
        (
            {"retrieval": "thumbnail", "conditions": ["k0", "k1"]},
            MissingIndexError,
            "has no embeddings of encoder 'thumbnail'",
        ),
        ({"policy": "python:__main__:make"}, InvalidOptionError, "worker processes run another"),
        ({"retrieval_rule": "oracle"}, InvalidOptionError, "--retrieval-rule oracle says nothing"),
        ({"retrieval_camera": "wrist"}, InvalidOptionError, "--retrieval-camera wrist says"),
        (
            {"retrieval": "thumbnail", "retrieval_rule": "best!", "system": None},
            UnknownNameError,
            "there is no method 'best!'",
        ),
        (
            {"retrieval": "thumbnail", "retrieval_rule": "top32"},
            InvalidOptionError,
            "a policy is handed a span",
        ),
        (
            {
                "retrieval": "thumbnail",
                "retrieval_rule": "last/0.9",
                "system": "retrieval-framesamp-modul",
            },
            InvalidOptionError,
            "chooses by max, not by last/0.9",
        ),
    ],
)
def test_what_cannot_work_is_refused_before_anything_is_written(
    tmp_path: Path, changes: dict[str, Any], error: type[InterferenceError], message: str
) -> None:
    with pytest.raises(error) as raised:
        run(tmp_path / "run", **changes)
    assert message in raised.value.message
    assert raised.value.hint
    assert not (tmp_path / "run").exists()


def test_videos_without_pillow_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(MissingExtraError, match="--videos needs pillow"):
        run(tmp_path / "run", videos=True)
    assert not (tmp_path / "run").exists()


# --- the simulator -----------------------------------------------------------------------------


def test_a_machine_that_cannot_draw_is_told_so_once(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mani_skill")
    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.setenv(name, "/nowhere.json")
    with pytest.raises(NoRendererError) as raised:
        check_simulator(config(), describe_policy(config()))
    assert raised.value.hint


def test_the_simulator_is_made_before_the_folder_and_only_for_rollouts_that_are_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def broken(config: RunConfig, policy: Any) -> None:
        asked.append(config.simulator)
        raise NoRendererError("no driver", "Install one.")

    whole = run(tmp_path / "whole")
    monkeypatch.setattr(runner, "check_simulator", broken)
    with pytest.raises(NoRendererError):
        run(tmp_path / "run")
    assert not (tmp_path / "run").exists()
    assert asked == ["rollout_doubles:World"]
    assert run(tmp_path / "whole").rows == whole.rows
    assert len(asked) == 1
    with pytest.raises(NoRendererError):
        run(tmp_path / "whole", conditions=["no-history", "k0"])
    assert len(asked) == 2


# --- labels ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("policy", "memory", "system", "message"),
    [
        ("oracle", None, "perceptual-framesamp-modul", "is not the paper's system"),
        ("lerobot:x/y", None, "pi05_baseline", "is not the paper's system"),
        ("replay", "window", "replay-full", "replay with the memory window is not the control"),
        ("replay", None, "replay-window", "replay is not the control replay-window"),
        ("guess", None, "oracle", "guess is not the control oracle"),
        (CHEAT, None, "oracle", "is not the control oracle"),
        ("hold", None, "retrieval-replay-full", "hold is not the control"),
        ("websocket://h:1", None, "memer", "sends the server none"),
        ("websocket://h:1", None, "symbolic-simplesg", "sends the server none"),
    ],
)
def test_a_name_of_the_table_is_refused_to_another_policy(
    policy: str, memory: str | None, system: str, message: str
) -> None:
    from robomme_interference_data.evaluate.checks import _check_label
    from robomme_interference_data.evaluate.systems import name_system

    with pytest.raises(InvalidOptionError) as raised:
        _check_label(config(policy=policy, memory=memory, system=system), name_system(system))
    assert message in raised.value.message
    assert raised.value.hint is not None and "name of your own" in raised.value.hint


@pytest.mark.parametrize(
    ("policy", "memory", "retrieval", "system"),
    [
        ("oracle", None, None, "oracle"),
        ("oracle", None, None, "my-upper-end"),
        ("replay", None, None, "replay-full"),
        ("replay", "window", None, "replay-window"),
        ("replay", "window", "thumbnail", "retrieval-replay-window"),
        ("websocket://h:1", None, None, "perceptual-framesamp-modul"),
        ("websocket://h:1", None, None, "without-subgoals"),
        (CHEAT, None, None, "memer"),
    ],
)
def test_a_name_is_given_to_the_policy_that_it_stands_for(
    policy: str, memory: str | None, retrieval: str | None, system: str
) -> None:
    from robomme_interference_data.evaluate.checks import _check_label
    from robomme_interference_data.evaluate.systems import name_system

    made = config(policy=policy, memory=memory, retrieval=retrieval, system=system)
    _check_label(made, name_system(system))


@pytest.mark.parametrize(
    ("step", "name"),
    [
        ({}, "replay-window"),
        ({"retrieval": "siglip"}, "retrieval-replay-window"),
        ({"retrieval": "siglip", "retrieval_rule": "oracle"}, "retrieval-replay-window-oracle"),
        (
            {"retrieval": "siglip", "retrieval_rule": "max/0.9", "retrieval_camera": "wrist"},
            "retrieval-replay-window-max-0.9-wrist",
        ),
    ],
)
def test_rows_are_named_after_the_retrieval_step(step: dict[str, str], name: str) -> None:
    from robomme_interference_data.evaluate.checks import _check_label
    from robomme_interference_data.evaluate.systems import name_system

    assert default_system("replay", "window", **step) == name
    made = config(policy="replay", memory="window", system=name, **step)
    _check_label(made, name_system(name))
    if "retrieval_rule" in step:
        with pytest.raises(InvalidOptionError, match="not the control retrieval-replay-window"):
            _check_label(made, name_system("retrieval-replay-window"))


def test_labels_are_checked_before_a_run(tmp_path: Path) -> None:
    with pytest.raises(InvalidOptionError, match="is not the control replay-full"):
        run(tmp_path / "run", system="replay-full")
    assert not (tmp_path / "run").exists()


def test_a_privileged_policy_is_on_record(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(tmp_path / "run", policy="python:own_policies:insider")
    header = json.loads((tmp_path / "run" / "run.json").read_text())
    assert header["policy"] == {"policy": "still", "privileged": True}
    assert "own_policies:insider is privileged: it gets the simulator" in capsys.readouterr().err
    run(tmp_path / "other", policy="python:own_policies:Still")
    header = json.loads((tmp_path / "other" / "run.json").read_text())
    assert header["policy"] == {"policy": "still"}
    assert "privileged" not in capsys.readouterr().err
