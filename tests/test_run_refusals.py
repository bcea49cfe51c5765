"""Runs that are refused: in the folder of another one, in a damaged one, or that cannot work."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from run_calls import CHEAT, run

from robomme_interference_data.errors import (
    FormatError,
    HistoryTooLongError,
    InterferenceError,
    InvalidIdError,
    InvalidOptionError,
    MissingFileError,
    RunFolderError,
    UnknownNameError,
)
from robomme_interference_data.evaluate import run_evaluation
from robomme_interference_data.evaluate.config import IDENTITY, RunConfig

pytestmark = pytest.mark.usefixtures("world")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"system": "yours"}, "system is 'mine' there, 'yours' here"),
        ({"model_seed": 7}, "model_seed is 0 there, 7 here"),
        ({"policy": "hold"}, f"policy is '{CHEAT}' there, 'hold' here"),
    ],
)
def test_another_run_is_refused_and_the_difference_named(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    run(tmp_path / "run", families=["MoveCube"], episodes="0")
    before = (tmp_path / "run" / "run.json").read_bytes()
    with pytest.raises(RunFolderError, match="holds another run") as raised:
        run(tmp_path / "run", families=["MoveCube"], episodes="0", **changes)
    assert message in raised.value.message
    assert (tmp_path / "run" / "run.json").read_bytes() == before


def test_every_setting_is_classed() -> None:
    """A new setting either makes another run of it, or does not: somebody has to say which."""
    assert {
        *IDENTITY,
        *("policy", "memory", "policy_options"),  # by policy_identity
        *("retrieval", "retrieval_rule", "retrieval_camera"),  # by Selector.identity
        *("split", "split_name", "robomme_python", "check_lesson", "videos", "workers"),
        *("rollout_s", "simulator_s", "cache", "history_chunk", "max_errors"),
    } == {field.name for field in dataclasses.fields(RunConfig)}


def test_a_run_may_be_refused_if_one_is_there(tmp_path: Path) -> None:
    run(tmp_path / "run", families=["MoveCube"], episodes="0")
    with pytest.raises(RunFolderError, match="holds a run already"):
        run(tmp_path / "run", families=["MoveCube"], episodes="0", resume=False)


def test_a_folder_with_other_files_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "thesis.tex").write_text("…")
    with pytest.raises(RunFolderError, match=r"holds other files \(thesis\.tex\)"):
        run(tmp_path / "run")
    assert [p.name for p in (tmp_path / "run").iterdir()] == ["thesis.tex"]


def test_a_folder_that_is_being_written_is_refused(tmp_path: Path) -> None:
    import fcntl

    run(tmp_path / "run", families=["MoveCube"], episodes="0")
    with (tmp_path / "run" / ".lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(RunFolderError, match="another process is writing"):
            run(tmp_path / "run", families=["MoveCube"], episodes="0")


def test_a_later_format_is_refused(tmp_path: Path) -> None:
    run(tmp_path / "run", families=["MoveCube"], episodes="0")
    path = tmp_path / "run" / "run.json"
    path.write_text(path.read_text().replace('"format_version": 1', '"format_version": 2'))
    with pytest.raises(FormatError, match="format version 2; this package reads 1"):
        run(tmp_path / "run", families=["MoveCube"], episodes="0")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (b"{}\n", "is not a row of a rollout"),
        (b"not json\n", "is not a row of a rollout"),
        (b'{"unknown": 1}\n', "is not a row of a rollout"),
    ],
)
def test_a_damaged_line_is_named(tmp_path: Path, line: bytes, message: str) -> None:
    run(tmp_path / "run", families=["MoveCube"], episodes="0")
    log = tmp_path / "run" / "rollouts.jsonl"
    log.write_bytes(line + log.read_bytes())
    with pytest.raises(FormatError, match=rf"rollouts.jsonl, line 1 {message}"):
        run(tmp_path / "run", families=["MoveCube"], episodes="0")


def test_a_finished_rollout_with_two_rows_is_refused(tmp_path: Path) -> None:
    run(tmp_path / "run", families=["MoveCube"], episodes="0")
    log = tmp_path / "run" / "rollouts.jsonl"
    log.write_bytes(log.read_bytes() * 2)
    with pytest.raises(FormatError, match="line 3: a second row of"):
        run(tmp_path / "run", families=["MoveCube"], episodes="0")


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"policy": "orakel"}, UnknownNameError, "no policy 'orakel'"),
        (
            {"policy": "websocket://a:1", "system": None},
            InvalidOptionError,
            "need the name of the system that it serves",
        ),
        (
            {"policy": "lerobot:out/last/pretrained_model", "system": None},
            InvalidOptionError,
            "the rows of lerobot:out/last/pretrained_model need a name",
        ),
        ({"policy": "hold", "memory": "full"}, InvalidOptionError, "memory"),
        (
            {"policy": "replay", "policy_options": {"memory": "window"}},
            InvalidOptionError,
            "the memory rule is no --policy-option",
        ),
        ({"policy_options": {"a": object()}}, InvalidOptionError, "cannot be written down"),
        ({"policy_options": {"speed": 2}}, InvalidOptionError, "unexpected keyword argument"),
        ({"simulator": "tabeltop"}, UnknownNameError, "no simulator 'tabeltop'"),
        ({"simulator": "tabletop"}, InvalidOptionError, "recorded on the simulator 'sample'"),
        ({"families": ["MoveCub"]}, UnknownNameError, "'MoveCub' is not in the split"),
        ({"episodes": "0-9"}, UnknownNameError, "no query episode"),
        ({"conditions": ["k7"]}, UnknownNameError, "no buffers for k7; it has no-history, k0"),
        ({"conditions": ["k"]}, InvalidIdError, "'k' is not a condition"),
        ({"workers": 0}, InvalidOptionError, "workers 0; expected more than 0"),
        ({"rollout_s": 0.0}, InvalidOptionError, "rollout_s 0.0; expected more"),
        ({"system": "pi05_baseline"}, InvalidOptionError, "k0 does not apply"),
        ({"system": "retrieval-framesamp-modul"}, InvalidOptionError, None),
        ({"system": "perceptual-framesamp-modull"}, UnknownNameError, "reads like the system"),
    ],
)
def test_what_cannot_work_is_refused_before_anything_is_written(
    tmp_path: Path, changes: dict[str, Any], error: type[InterferenceError], message: str | None
) -> None:
    with pytest.raises(error) as raised:
        run(tmp_path / "run", **changes)
    assert message is None or message in raised.value.message
    assert raised.value.hint
    assert not (tmp_path / "run").exists()


def test_a_missing_split_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="is not a split"):
        run_evaluation("hold", tmp_path / "none", tmp_path / "run")


def test_a_history_beyond_the_systems_positions_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from robomme_interference_data.evaluate import systems

    monkeypatch.setitem(
        systems.SYSTEMS,
        "perceptual-framesamp-modul",
        dataclasses.replace(
            systems.SYSTEMS["perceptual-framesamp-modul"], position_limit=1300 + 36 + 32
        ),
    )
    limited = {"system": "perceptual-framesamp-modul", "families": ["MoveCube"]}
    run(tmp_path / "run", conditions=["k0", "k1"], **limited)
    with pytest.raises(HistoryTooLongError, match=r"116 history frames and 1300 steps exceed"):
        run(tmp_path / "run", conditions=["k3"], **limited)  # 20 + 3 · 32 at index 0
