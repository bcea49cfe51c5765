"""The checks of the doctor, and how they are printed."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from robomme_interference_data.cli import doctor
from robomme_interference_data.cli.doctor import Check


def test_the_table_shows_state_name_detail_and_fix(
    run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = "pip install " + "a-long-name " * 20
    rows = [Check("fine", True, "1.0"), Check("optional", None, "not installed", command)]
    monkeypatch.setattr(doctor, "checks", lambda: rows)
    code, out, err = run("doctor")
    assert (code, err) == (0, "")
    assert out.splitlines() == [
        "ok        fine      1.0",
        "optional  optional  not installed",
        f"          fix: {command}",
    ]
    rows.append(Check("needed", False, "broken"))
    assert run("doctor")[0] == 1


def test_this_environment_has_all_that_is_needed_and_nothing_heavy_is_imported() -> None:
    code = (
        "import sys; from robomme_interference_data.cli.doctor import checks\n"
        "for row in checks(): print(row.name, row.ok, row.fix, sep='|')\n"
        "print(sorted({'torch', 'lerobot', 'h5py', 'sapien', 'mani_skill', 'transformers',"
        " 'matplotlib', 'datasets', 'pandas'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    *rows, imported = done.stdout.splitlines()
    assert imported == "[]"
    found = [line.split("|") for line in rows]
    assert [name for name, ok, _ in found if ok == "False"] == []
    assert {fix for _, ok, fix in found if ok == "True"} == {"None"}  # nothing to mend


REQUIREMENTS = {
    "robomme-interference-data": [
        "numpy>=2.0",
        'colorama; sys_platform == "win33"',
        'lerobot[dataset]<0.7,>=0.6.1; extra == "build"',
        'h5py>=3.10; extra == "build"',
    ],
    "lerobot": ['datasets<5,>=4.8; extra == "dataset"', 'pygame; extra == "teleop"'],
}
SOURCE = "git+https://github.com/SoumilRathi/robomme-interference-data"

GOOD = {"numpy": "2.2.6", "lerobot": "0.6.1", "h5py": "3.16.0", "datasets": "4.8.5"}
BAD = {"numpy": "1.26.4", "lerobot": "0.6.1", "datasets": "5.0.0"}


@pytest.mark.parametrize(
    ("installed", "extra", "row"),
    [
        (GOOD, "build", (True, "lerobot 0.6.1, h5py 3.16.0", None)),
        (BAD, "", (False, "numpy 1.26.4 is not >=2.0", f"pip install --force-reinstall {SOURCE}")),
        (
            BAD,
            "build",
            (
                None,
                "datasets 5.0.0 is not <5,>=4.8, h5py is not installed",
                'pip install "robomme-interference-data[build]"',
            ),
        ),
    ],
)
def test_requirements_of_the_core_and_of_an_extra(
    installed: dict[str, str], extra: str, row: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    def version(name: str) -> str:
        if name not in installed:
            raise metadata.PackageNotFoundError(name)
        return installed[name]

    monkeypatch.setattr(metadata, "version", version)
    monkeypatch.setattr(metadata, "requires", REQUIREMENTS.get)
    found = doctor.check_packages(extra)
    assert (found.ok, found.detail, found.fix) == row


@pytest.mark.parametrize(
    ("codecs", "ok"), [({"libdav1d", "libaom-av1"}, True), ({"libdav1d"}, None), (set(), False)]
)
def test_only_the_decoder_is_required(
    codecs: set[str], ok: bool | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("av.codecs_available", codecs)
    row = doctor.check_video()
    assert row.ok is ok and (row.fix is None) is (ok is True)


@pytest.mark.parametrize(
    ("program", "ok", "detail"),
    [
        ("print('llvmpipe')", True, "drawn with llvmpipe"),
        ("import os; os.abort()", None, "crashed (exit code -6)"),
        ("import time; time.sleep(60)", None, "did not answer within 1 s"),
    ],
    ids=["draws", "crashes", "hangs"],
)
def test_renderer_check_survives_its_driver(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: str, ok: bool | None, detail: str
) -> None:
    pytest.importorskip("sapien", reason="needs the extra sim")
    (tmp_path / "drawing.py").write_text(program, encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    row = doctor.check_renderer("drawing", seconds=1 if "sleep" in program else 60)
    assert row.ok is ok
    assert detail in row.detail
    assert (row.fix is None) is (ok is True)


@pytest.mark.slow
def test_robommes_interpreter_is_asked(
    robomme_python: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("ROBOMME_PYTHON")
    assert doctor.check_robomme().ok is None
    for python, ok, detail, fix in (
        (str(robomme_python), True, "robomme_numpy 1.", None),
        (sys.executable, False, "RoboMME needs numpy < 2", f"now {sys.executable}"),
        ("/nowhere/python", False, "is not an executable file", "now /nowhere/python"),
    ):
        monkeypatch.setenv("ROBOMME_PYTHON", python)
        row = doctor.check_robomme()
        assert row.ok is ok
        assert detail in row.detail
        assert row.fix is None if fix is None else fix in str(row.fix)
    # Patches are listed: of a ManiSkill from the package index there are some.
    monkeypatch.setenv("ROBOMME_PYTHON", str(robomme_python))
    monkeypatch.setenv("STAND_IN_MANI_SKILL", "index")
    assert "patched: stick planner's arguments, " in doctor.check_robomme().detail


def test_an_unusable_interpreter_of_robomme_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = tmp_path / "python"
    old.write_text('#!/bin/sh\n[ "$1" = -c ] && echo 3.9 && exit\nexit 1\n')
    old.chmod(0o755)
    for python, detail in (
        (str(old), "is Python 3.9; the simulator robomme needs Python 3.10 or newer"),
        ("/nowhere/python", "ROBOMME_PYTHON=/nowhere/python is not an executable file"),
    ):
        monkeypatch.setenv("ROBOMME_PYTHON", python)
        row = doctor.check_robomme()
        assert (row.ok, row.detail.endswith(detail)) == (False, True)
        # It is set, so the advice is not to set it, but to correct it.
        assert str(row.fix).startswith(f"set ROBOMME_PYTHON, now {python}, to ")


def test_the_hub_is_asked_and_a_token_never_shown(
    hub: Any, login: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    row = doctor.check_hub()
    assert (row.ok, row.fix) == (None, "hf auth login")
    login("ada")
    row = doctor.check_hub()
    assert row.ok is True and row.detail.endswith("answers ada") and "hf_ada" not in repr(row)
    monkeypatch.setenv("HF_TOKEN", "hf_secret")
    row = doctor.check_hub()
    assert (row.ok, row.fix) == (False, "hf auth login --force") and "hf_secret" not in repr(row)


def test_a_hub_that_cannot_be_reached_is_optional(monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor.check_hub().detail == "HF_HUB_OFFLINE is set"
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", "http://127.0.0.1:9")
    row = doctor.check_hub()
    assert row.ok is None and "127.0.0.1:9 does not answer" in row.detail


BREAKS = {
    "av.codecs_available": None,
    "huggingface_hub.get_token": Mock(side_effect=PermissionError(13, "Permission denied")),
    "subprocess.run": Mock(side_effect=OSError(8, "Exec format error")),
    "importlib.metadata.packages_distributions": Mock(side_effect=KeyError("Name")),
    "importlib.metadata.requires": Mock(side_effect=metadata.PackageNotFoundError("x")),
    "tempfile.TemporaryFile": Mock(side_effect=PermissionError(13, "Permission denied")),
}


def test_checks_that_raise_are_failed_checks(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("sapien", reason="needs the extra sim")
    for name, broken in BREAKS.items():
        monkeypatch.setattr(name, broken)
    rows = {row.name: row for row in doctor.checks()}
    failed = ["Core libraries", "Video (PyAV)", *[f"Extra [{one}]" for one in doctor.extras()]]
    failed += ["OpenCV", "Vulkan", "Hub cache", "Hugging Face Hub"]
    assert [name for name, row in rows.items() if row.ok is False] == failed
    assert [name for name in rows if name not in failed] == ["Python", "Official simulator"]


def test_packages_without_metadata(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "DISTRIBUTION", "not-installed-at-all")
    assert doctor.extras() == []
    row = doctor.guarded("Core libraries", doctor.check_packages)
    assert row.ok is False and "not-installed-at-all" in row.detail


@pytest.mark.slow
def test_an_unusable_endpoint_is_a_failed_check(run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_ENDPOINT", "hub")
    code, out, err = run("doctor", "--json")
    rows = {row["name"]: row for row in json.loads(out)}
    assert (code, err) == (1, "")
    for name in ("Hub cache", "Hugging Face Hub"):
        assert rows[name]["ok"] is False and "HF_ENDPOINT 'hub'" in rows[name]["detail"]
        assert "unset HF_ENDPOINT" in rows[name]["fix"]


PROGRAM = "from robomme_interference_data.cli import run_program; run_program()"


@pytest.mark.slow
def test_a_broken_library_is_reported(tmp_path: Path) -> None:
    (tmp_path / "pyarrow.py").write_text("raise ImportError('libarrow.so is missing')")
    command = [sys.executable, "-c", PROGRAM, "doctor", "--json"]
    env = os.environ | {"PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    (row,) = [row for row in json.loads(done.stdout) if row["name"] == "Core libraries"]
    assert (done.returncode, done.stderr, row["ok"]) == (1, "", False)
    assert "libarrow.so is missing" in row["detail"]
    assert row["fix"] == f"pip install --force-reinstall {SOURCE}"


def test_without_the_library_of_the_command_line(tmp_path: Path) -> None:
    (tmp_path / "typer.py").write_text("raise ImportError('no typer')")
    command = [sys.executable, "-c", PROGRAM, "doctor"]
    env = os.environ | {"PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("Error: ") and "no typer" in done.stderr
    assert done.stderr.endswith(f"pip install --force-reinstall {SOURCE}\n")
    assert len(done.stderr.splitlines()) == 2


@pytest.mark.parametrize(
    ("installed", "ok"),
    [
        ([], None),
        (["opencv-python-headless"], True),
        (["opencv-python", "opencv-python-headless"], None),
    ],
)
def test_two_opencvs_are_found(
    installed: list[str], ok: bool | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metadata, "packages_distributions", lambda: {"cv2": installed * 2})
    monkeypatch.setattr(metadata, "version", lambda name: "4.13")
    row = doctor.check_opencv()
    assert row.ok is ok
    assert all(f"{name} 4.13" in row.detail for name in installed)
    uninstall = "pip uninstall --yes opencv-python opencv-python-headless && pip install"
    assert (row.fix or "").startswith(uninstall) is (len(installed) == 2)


def test_a_cache_that_cannot_be_written(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "new" / "hub"))
    assert doctor.check_cache().ok is True
    assert [*tmp_path.iterdir()] == []
    (tmp_path / "new").write_bytes(b"")
    row = doctor.check_cache()
    assert row.ok is False and row.fix and "HF_HOME" in row.fix
