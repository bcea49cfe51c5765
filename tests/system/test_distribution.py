"""What is published of the package: sdist and wheel, which `make bare` uses."""

import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pytest
from support.package import CONFIG, PACKAGE, ROOT, module_files

pytestmark = pytest.mark.slow  # test_packaging.py compares the lists of files


@pytest.fixture(scope="module")
def distributions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An sdist, and the wheel that is built from it, as they are published."""
    folder = tmp_path_factory.mktemp("distributions")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "scripts")
        from distribution import copy_source
    copy_source(folder / "tree")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder / "dist")]
    done = subprocess.run(
        [*command, str(folder / "tree")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stdout + done.stderr
    return folder / "dist"


def test_the_wheel_holds_every_file_and_one_top_level_name(distributions: Path) -> None:
    expected = module_files()
    (wheel,) = distributions.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = [name for name in archive.namelist() if ".dist-info/" not in name]
        assert sorted(names) == sorted(expected)
        for name, path in expected.items():
            assert archive.read(name) == path.read_bytes()
        info = wheel.name.split("-py3")[0] + ".dist-info"
        assert archive.read(f"{info}/top_level.txt").decode().split() == [PACKAGE]
        assert f"{info}/licenses/LICENSE" in archive.namelist()


def test_the_sdist_holds_what_the_wheel_needs_and_nothing_else(distributions: Path) -> None:
    (sdist,) = distributions.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        found = {one.name.split("/", 1)[1] for one in archive.getmembers() if one.isfile()}
    own = {path.relative_to(ROOT).as_posix() for path in module_files().values()}
    made = {name for name in found if ".egg-info/" in name} | {"PKG-INFO", "setup.cfg"}
    assert found - made == own | {"LICENSE", "README.md", "pyproject.toml"}


def test_links_of_the_description_lead_to_files_of_the_repository(distributions: Path) -> None:
    (wheel,) = distributions.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        [metadata] = [name for name in archive.namelist() if name.endswith("/METADATA")]
        description = archive.read(metadata).decode().partition("\n\n")[2]
    links = re.findall(r"\]\(([^)#]+)\)", description)
    assert all(link.startswith("https://") for link in links)
    page = CONFIG["project"]["urls"]["Repository"]
    own = [link.removeprefix(page).split("/", 3) for link in links if link.startswith(page)]
    files = {(kind, tag, path) for _, kind, tag, path in own if kind in ("blob", "raw")}
    tag = f"v{CONFIG['project']['version']}"
    assert {("raw", tag, "docs/pictures/headline.png"), ("blob", tag, "LICENSE")} <= files
    assert all((ROOT / path).is_file() for *_, path in files)


def test_twine_uploads_both_and_uv_installs_them_by_name(
    distributions: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The index has rules, too: no file is replaced, and a name has an owner."""
    monkeypatch.syspath_prepend(ROOT / "scripts")
    from distribution import quietly, uploaded

    with uploaded(distributions) as index:
        [project] = index.projects.values()
        assert [*project.files] == sorted(path.name for path in distributions.iterdir())
        uv, python = Path(sys.executable).with_name("uv"), tmp_path / "venv" / "bin" / "python"
        venv = [uv, "venv", "--quiet", "--python", sys.executable, tmp_path / "venv"]
        subprocess.run(venv, check=True)
        install = [uv, "pip", "install", "--quiet", "--no-cache", "--no-deps", "--python", python]
        name = CONFIG["project"]["name"]
        subprocess.run([*install, "--default-index", index.simple, name], check=True)
        code = f"from importlib.metadata import version; print(version('{name}'))"
        done = subprocess.run([python, "-c", code], capture_output=True, text=True, check=True)
        assert done.stdout.strip() == CONFIG["project"]["version"]

        index.passwords["somebody"] = "else"
        wheel = str(next(distributions.glob("*.whl")))
        for user, password, says in (
            ("rehearsal", "rehearsal", "400"),  # the file exists
            ("somebody", "else", "403"),  # the name is another user's
            ("somebody", "wrong", "403"),
        ):
            login = ("--username", user, "--password", password, "--non-interactive")
            with pytest.raises(SystemExit, match=says):
                quietly("twine", "upload", "--repository-url", index.legacy, *login, wheel)


USER = """
from typing import assert_type, override

import numpy as np
from numpy.typing import NDArray
from robomme_interference_data import (
    Buffer, BufferManifest, BufferSet, Chunk, EpisodeId, Query, Session
)
from robomme_interference_data import load_buffer, load_buffer_set
from robomme_interference_data.evaluate import Observation, Policy
from robomme_interference_data.training import HistoryDataset

buffer = load_buffer("MoveCube/test/0", "k3", buffer_set="buffers")
assert_type(buffer, Buffer)
assert_type(buffer.frames("front"), NDArray[np.uint8])
assert_type(buffer.states, NDArray[np.float32])
assert_type(buffer.goal, str)
assert_type(buffer.sessions, tuple[Session, ...])
for chunk in buffer.stream(64):
    assert_type(chunk, Chunk)
    assert_type(chunk.frames, dict[str, NDArray[np.uint8]])
buffers = load_buffer_set("buffers")
assert_type(buffers, BufferSet)
assert_type(buffers.episode_ids, tuple[EpisodeId, ...])
assert_type(buffers.query("MoveCube/test/0"), Query)
assert_type(buffers.manifest("MoveCube/test/0", "k3"), BufferManifest)
assert_type(HistoryDataset("buffers", ["k3"]), HistoryDataset)

class Still(Policy):
    @override
    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        assert_type(observation.state, NDArray[np.float32])
        return np.zeros((1, 8), np.float32)
"""

MISTAKES = """
from robomme_interference_data import load_buffer
from robomme_interference_data.evaluate import RunConfig

load_buffer("MoveCube/test/0", "k3", bufer_set="buffers")
load_buffer("MoveCube/test/0", "k3", buffer_set="buffers").frames(1)
RunConfig(policy=1)
"""


def test_type_checkers_see_the_types_of_the_wheel(distributions: Path, tmp_path: Path) -> None:
    """An editable install would not do: they do not follow its mapping of folders."""
    uv, python = Path(sys.executable).with_name("uv"), tmp_path / "venv" / "bin" / "python"
    (wheel,) = distributions.glob("*.whl")
    subprocess.run(
        [uv, "venv", "--quiet", "--python", sys.executable, tmp_path / "venv"], check=True
    )
    install = [uv, "pip", "install", "--quiet", "--offline", "--no-deps", "--python", python, wheel]
    subprocess.run(install, check=True)
    (site,) = tmp_path.glob("venv/lib/python*/site-packages")
    (site / "numpy.pth").write_text(str(Path(np.__file__).parents[1]), encoding="utf-8")
    for name, text in {"user.py": USER, "mistakes.py": MISTAKES}.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    settings = "[mypy]\nstrict = true\n[mypy-torch.*]\nfollow_imports = skip\n"
    (tmp_path / "mypy.ini").write_text(settings, encoding="utf-8")
    command = [
        sys.executable,
        "-m",
        "mypy",
        "--python-executable",
        python,
        "user.py",
        "mistakes.py",
    ]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    lines = done.stdout.splitlines()
    assert [line.split(": ")[0] for line in lines if ": error: " in line] == [
        "mistakes.py:5",
        "mistakes.py:6",
        "mistakes.py:7",
    ], done.stdout + done.stderr
