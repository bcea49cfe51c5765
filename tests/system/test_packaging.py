"""The core imports light, dependencies are pinned, and no file names what it may not."""

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


def test_the_core_needs_no_heavy_library() -> None:
    """All of it but the areas, the simulators, and the cluster, which are loaded at use."""
    others = {*MAPPING, f"{PACKAGE}.simulators", f"{PACKAGE}.runtime.ray_cluster"} - {PACKAGE}
    names = sorted(
        name for name in MODULES if not any(f"{name}.".startswith(f"{one}.") for one in others)
    )
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
