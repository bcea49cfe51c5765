"""The core imports light, dependencies are pinned, and no file names what it may not."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from support.package import CONFIG, HEAVY, MAPPING, PACKAGE, ROOT, committable, module_files

from robomme_interference_data.constants import DOCS_URL

MODULES = {
    name.removesuffix(".py").removesuffix("/__init__").replace("/", "."): path
    for name, path in module_files().items()
    if path.suffix == ".py"
}


def test_every_top_level_package_is_mapped() -> None:
    folders = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    assert folders == set(MAPPING.values())
    assert {name.split(".")[0] for name in MAPPING} == {PACKAGE}


LIGHT_IMPORT = """
import importlib, sys
heavy = set({heavy!r})
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in heavy:
            raise ImportError(f"{{name}} is not installed")
sys.meta_path.insert(0, Refuse())
for name in {names!r}:
    importlib.import_module(name)
print(len({names!r}), sorted(heavy & set(sys.modules)))
"""


def core_modules() -> list[str]:
    """All of it but what is loaded at use: the areas, training, the simulators, the cluster."""
    cluster = {f"{PACKAGE}.runtime.ray_cluster", f"{PACKAGE}.runtime.ray_actors"}
    training = f"{PACKAGE}.training"
    others = {*MAPPING, training, f"{PACKAGE}.simulators", *cluster} - {PACKAGE}
    return sorted(
        name for name in MODULES if not any(f"{name}.".startswith(f"{one}.") for one in others)
    )


def test_the_core_needs_no_heavy_library() -> None:
    names = core_modules()
    code = LIGHT_IMPORT.format(heavy=HEAVY, names=names)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{len(names)} []\n"


def pins() -> dict[str, str]:
    found = {}
    for line in (ROOT / "requirements.txt").read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            match = re.fullmatch(r"([a-z0-9][a-z0-9.-]*)==([\w.]+)( ; .+)?", line)
            assert match, f"{line!r} is not name==version"
            found[match[1]] = match[2]
    return found


def declared() -> list[Requirement]:
    project = CONFIG["project"]
    groups = CONFIG["dependency-groups"].values()
    lines = project["dependencies"] + [
        one for group in groups for one in group if "include" not in str(one)
    ]
    for extra in project["optional-dependencies"].values():
        lines += extra
    requirements = [Requirement(line) for line in lines]
    return [item for item in requirements if item.name != project["name"]]


def test_every_declared_dependency_is_pinned_within_its_bounds() -> None:
    pinned = pins()
    outside = [
        f"{item} has the pin {pinned.get(item.name)}"
        for item in declared()
        if item.name not in pinned or pinned[item.name] not in item.specifier
    ]
    assert outside == [], "make pins"


def test_only_one_opencv_is_pinned() -> None:
    assert [name for name in pins() if name.startswith("opencv")] == ["opencv-python-headless"]


def text_files() -> Iterator[tuple[str, str]]:
    """Every file that is or could be committed, as text."""
    for name in committable():
        try:
            yield name, (ROOT / name).read_text(encoding="utf-8")
        except UnicodeDecodeError:
            continue  # a picture or a recording


def test_no_file_names_a_package_registry() -> None:
    index = pytest.importorskip("pip._internal.models.index")
    hosts = {index.PyPI.netloc, index.PyPI.file_storage_domain}
    apt = Path("/etc/apt")
    for path in (*apt.glob("sources.list"), *apt.glob("sources.list.d/*")):
        hosts |= set(re.findall(r"https?://([\w.-]+)", path.read_text(encoding="utf-8")))
    named = [(name, host) for name, text in text_files() for host in hosts if host in text]
    assert named == []


def test_no_file_names_a_path_of_one_machine() -> None:
    pattern = re.compile(r"(?<![\w.])/(?:work|root|home|Users|tmp/[a-z])\b[\w./-]*")
    named = [(name, match[0]) for name, text in text_files() for match in pattern.finditer(text)]
    assert named == []


def test_the_metadata_name_the_documentation() -> None:
    assert CONFIG["project"]["urls"]["Documentation"] == DOCS_URL


def test_citation_names_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == CONFIG["project"]["version"]
    assert citation["license"] == CONFIG["project"]["license"]


ABSENT = {
    "windows": {
        "modules": "fcntl grp pwd resource termios pty",
        "os": "O_DIRECTORY fork getpgrp geteuid getuid killpg posix_fallocate pread setpgid setsid "
        "statvfs sync mkfifo sched_getaffinity",
        "signal": "SIGALRM SIGHUP SIGKILL SIGUSR1",
    },
    "macos": {"modules": "", "os": "posix_fallocate sched_getaffinity", "signal": ""},
}
"""What Python lacks there, of what the light core could be tempted to use."""

ELSEWHERE = """
import asyncio, multiprocessing.connection, os, platform, shutil, signal, ssl, subprocess, sys
import tempfile, uuid
absent, names, buffers, run, out = {absent!r}, {names!r}, *sys.argv[1:]
for name in absent["modules"].split():
    sys.modules[name] = None
for module in (os, signal):
    for name in absent[module.__name__].split():
        delattr(module, name)

import importlib
for name in names:
    importlib.import_module(name)

from robomme_interference_data import load_buffer
from robomme_interference_data.cli.main import main
buffer = load_buffer("MoveCube/test/0", "k3", buffer_set=buffers, verify=True)
print(buffer.frames().shape)
cached = load_buffer("MoveCube/test/0", "k3", buffer_set=buffers, cache=os.path.join(out, "cache"))
print(cached.frames().shape)
for command in (
    ["list", buffers],
    ["verify", buffers],
    ["show", buffers, "MoveCube/test/0", "k3", "--out", os.path.join(out, "strip.png")],
    ["score", run, "--out", os.path.join(out, "score")],
):
    sys.argv = ["robomme-interference", *command]
    try:
        main()
    except SystemExit as end:
        print(command[0], end.code)
"""


@pytest.mark.slow
@pytest.mark.parametrize("platform", ABSENT)
def test_the_light_core_needs_nothing_of_one_platform(platform: str, tmp_path: Path) -> None:
    code = ELSEWHERE.format(absent=ABSENT[platform], names=core_modules())
    golden = [ROOT / "tests" / "golden" / name for name in ("buffer_set", "run")]
    command = [sys.executable, "-c", code, *map(str, golden), str(tmp_path)]
    # Pipes have the code page there, which lacks the lines of tables.
    environment = os.environ | {"PYTHONUTF8": "0", "PYTHONIOENCODING": "cp1252"}
    done = subprocess.run(
        command, capture_output=True, encoding="utf-8", env=environment, check=False
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[:2] == ["(144, 32, 32, 3)", "(144, 32, 32, 3)"]
    assert [line for line in lines if re.fullmatch(r"(list|verify|show|score) \d+", line)] == [
        "list 0",
        "verify 0",
        "show 0",
        "score 0",
    ]
