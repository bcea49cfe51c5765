"""`scripts/install_robomme.sh`: what it refuses, and, with a clone of RoboMME, what it installs."""

import os
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "scripts" / "install_robomme.sh"


def install(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [str(SCRIPT), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=1800, check=False)


def clone_of(folder: Path, name: str, *, lock: bool = True, commit: bool = True) -> Path:
    """Make a folder like a clone of RoboMME."""
    (folder / "src" / "robomme").mkdir(parents=True)
    (folder / "pyproject.toml").write_text(f'[project]\nname = "{name}"\n')
    if lock:
        (folder / "uv.lock").touch()
    if commit:
        for words in (["init", "-q"], ["add", "."], ["commit", "-qm", "all"]):
            git = ["git", "-c", "user.name=me", "-c", "user.email=me@example.com"]
            subprocess.run([*git, *words], cwd=folder, check=True)
    return folder


def test_what_is_no_clone_of_robomme_is_one_error(tmp_path: Path) -> None:
    env = tmp_path / "env"
    for clone, words in (
        (tmp_path / "absent", "there is no folder"),
        (clone_of(tmp_path / "other", "other"), "is not a clone of RoboMME"),
        (clone_of(tmp_path / "unlocked", "robomme", lock=False), "has no uv.lock"),
        (clone_of(tmp_path / "unpacked", "robomme", commit=False), "has no commit"),
    ):
        done = install(clone, env)
        message, advice = done.stderr.splitlines()
        assert done.returncode == 1 and words in message and ":" in advice
        assert not env.exists()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").touch()
    done = install(clone_of(tmp_path / "clone", "robomme"), tmp_path / "mine")
    assert done.returncode == 1 and "is no Python environment" in done.stderr
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["notes.txt"]


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_it_installs_what_doctor_accepts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clone = os.environ.get("ROBOMME_CLONE")
    if clone is None:
        pytest.skip("set ROBOMME_CLONE to the folder of a clone of RoboMME (7.5 GB, minutes)")
    done = install(clone, tmp_path / "env")
    assert done.returncode == 0, done.stderr
    python = tmp_path / "env" / "bin" / "python"
    assert done.stdout.splitlines()[0] == f"export ROBOMME_PYTHON={python}"

    from robomme_interference_data.simulators.robomme.simulator import RoboMMESimulator

    monkeypatch.setenv("ROBOMME_PYTHON", str(python))
    versions = RoboMMESimulator.versions()
    commit = subprocess.check_output(["git", "rev-parse", "HEAD"], cwd=clone, text=True).strip()
    assert versions["robomme"].partition("+")[2].startswith(commit)
    assert versions["robomme_mani_skill"] == "3.0.1"
    with RoboMMESimulator(python, cameras=(), subgoals=False) as simulator:
        assert len(simulator.patches) > 0
        lesson, _, _ = simulator.reset("VideoUnmask/test/0")
        assert len(lesson) == 66  # as the published recordings
