"""What is published of the package: sdist and wheel hold what they should, and work alone."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from support.buffer_sets import GOLDEN, expected_frames, expected_states
from support.hub import BUFFER_SET, push_buffer_set
from support.hub_server import HubServer
from support.package import CONFIG, HEAVY, PACKAGE, ROOT, committable, module_files

from robomme_interference_data import load_buffer_set

pytestmark = pytest.mark.slow  # test_packaging.py compares the lists of files


def build(tree: Path, out: Path, *kind: str) -> None:
    """Run `python -m build`, with the setuptools that is here."""
    command = [sys.executable, "-m", "build", "--no-isolation", *kind, "--outdir", str(out)]
    done = subprocess.run([*command, str(tree)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stdout + done.stderr


@pytest.fixture(scope="module")
def distributions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An sdist, and the wheel that is built from it, as they are published."""
    folder = tmp_path_factory.mktemp("distributions")
    for name in committable():
        (folder / "tree" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, folder / "tree" / name)
    build(folder / "tree", folder / "dist")
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


def test_the_package_index_would_take_both(distributions: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "twine",
        "check",
        "--strict",
        *map(str, distributions.iterdir()),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.count("PASSED")) == (0, 2), done.stdout


@pytest.fixture(scope="module")
def empty_python(distributions: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of an environment with the wheel and what it asks for, as pinned."""
    folder, uv = tmp_path_factory.mktemp("empty") / "venv", Path(sys.executable).with_name("uv")
    (wheel,) = distributions.glob("*.whl")
    # Use uv's cache, which set-up has filled, and pip's configured index (scripts/setup.sh).
    own = {name: text for name, text in os.environ.items() if name != "XDG_CACHE_HOME"}
    query = [sys.executable, "-m", "pip", "config", "get", "global.index-url"]
    index = subprocess.run(query, capture_output=True, text=True, check=False).stdout.strip()
    if index:
        own.setdefault("UV_DEFAULT_INDEX", index)
    subprocess.run([uv, "venv", "--quiet", "--python", sys.executable, folder], check=True)
    command = [uv, "pip", "install", "--quiet", "--python", folder / "bin" / "python"]
    command += ["--constraint", ROOT / "requirements.txt", wheel]
    done = subprocess.run(command, env=own, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        pytest.skip(f"no package index gives what is needed: {done.stderr.strip()[-500:]}")
    return folder / "bin" / "python"


LOAD = """
import hashlib, json
from importlib.util import find_spec
from robomme_interference_data import load_buffer

where = dict(buffer_set="{buffer_set}", revision="data-1.0.0")
buffer = load_buffer("MoveCube/test/0", "k3", **where, verify=True)
arrays = [buffer.frames("front"), buffer.frames("wrist"), buffer.states]
print(json.dumps({{
    "arrays": [[a.shape, str(a.dtype), hashlib.sha256(a.tobytes()).hexdigest()] for a in arrays],
    "installed": [name for name in {heavy!r} if find_spec(name)],
}}))
"""


def test_the_wheel_alone_loads_a_buffer_from_the_hub(
    empty_python: Path, hub: HubServer, tmp_path: Path
) -> None:
    push_buffer_set(hub, GOLDEN, tmp_path / "work")
    own = {"HF_ENDPOINT": hub.endpoint, "HF_HUB_CACHE": str(tmp_path / "fresh")}
    own |= {"HF_HUB_DISABLE_XET": "1", "HF_HUB_OFFLINE": "0"}
    code = LOAD.format(buffer_set=BUFFER_SET, heavy=HEAVY)
    command = [empty_python, "-I", "-c", code]
    done = subprocess.run(
        command, env=os.environ | own, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    sessions = load_buffer_set(GOLDEN).manifest("MoveCube/test/0", "k3").sessions
    arrays = [*(expected_frames(sessions, name) for name in ("front", "wrist"))]
    arrays.append(expected_states(sessions))
    assert json.loads(done.stdout) == {
        "arrays": [
            [[*one.shape], str(one.dtype), hashlib.sha256(one.tobytes()).hexdigest()]
            for one in arrays
        ],
        "installed": [],
    }
    assert hub.downloads()


def test_the_wheel_alone_has_the_command(empty_python: Path) -> None:
    command = [empty_python.with_name("robomme-interference"), "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout == f"robomme-interference {CONFIG['project']['version']}\n", done.stderr
