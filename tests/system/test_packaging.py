"""The distribution holds what the folders hold, and imports go one way."""

import ast
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
CONFIG = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PACKAGE = "robomme_interference_data"
MAPPING: dict[str, str] = CONFIG["tool"]["setuptools"]["package-dir"]

# Who may import whom (docs/architecture.md). cli.py may import every area's commands, and
# anything inside functions.
MAY_IMPORT = {
    "core": {"core"},
    "simulators": {"core", "simulators"},
    "build_dataset": {"core", "simulators", "build_dataset"},
    "retrieval": {"core", "retrieval"},
    "evaluate": {"core", "simulators", "retrieval", "evaluate"},
    "cards": {"core", "build_dataset", "retrieval", "evaluate", "cards"},
}

HEAVY = ("torch", "lerobot", "h5py", "matplotlib", "datasets", "pandas", "mani_skill", "sapien")
HEAVY += ("transformers", "scipy", "jinja2", "gymnasium", "cv2")


def module_files() -> dict[str, Path]:
    """All files of the package by their path in an installed copy."""
    found = {}
    for package, folder in MAPPING.items():
        for path in sorted((ROOT / folder).rglob("*")):
            relative = path.relative_to(ROOT / folder)
            if path.is_file() and "__pycache__" not in relative.parts:
                found[f"{package.replace('.', '/')}/{relative.as_posix()}"] = path
    return found


def area_of(name: str) -> str:
    parts = name.split(".")
    return parts[1] if len(parts) > 1 and parts[1] in MAY_IMPORT else "core"


MODULES = {
    name.removesuffix(".py").removesuffix("/__init__").replace("/", "."): path
    for name, path in module_files().items()
    if path.suffix == ".py"
}


def test_every_top_level_package_is_mapped() -> None:
    folders = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    assert folders == set(MAPPING.values())
    assert {name.split(".")[0] for name in MAPPING} == {PACKAGE}


class Imports(ast.NodeVisitor):
    """Collects what a module imports of this package, and whether inside a function."""

    def __init__(self) -> None:
        self.found: list[tuple[str, bool, int]] = []
        self.relative: list[int] = []
        self._depth = 0

    def visit_FunctionDef(self, node: ast.FunctionDef | ast.AsyncFunctionDef) -> None:
        self._depth += 1
        self.generic_visit(node)
        self._depth -= 1

    visit_AsyncFunctionDef = visit_FunctionDef

    def visit_Import(self, node: ast.Import) -> None:
        for alias in node.names:
            self._add(alias.name, node.lineno)

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        if node.level:
            self.relative.append(node.lineno)
        for alias in node.names:
            self._add(f"{node.module}.{alias.name}", node.lineno)

    def visit_Constant(self, node: ast.Constant) -> None:
        # A registry names the modules that it loads.
        if isinstance(node.value, str) and node.value in MODULES:
            self.found.append((node.value, True, node.lineno))

    def _add(self, name: str, line: int) -> None:
        if name.partition(".")[0] == PACKAGE:
            self.found.append((name, self._depth > 0, line))


def wrong_imports(module: str, source: str) -> Iterator[str]:
    visitor = Imports()
    visitor.visit(ast.parse(source))
    for line in visitor.relative:
        yield f"{module}:{line} relative import"
    for name, inside_function, line in visitor.found:
        commands = name.rpartition(".")[2] == "commands"
        sees_all = module in (f"{PACKAGE}.cli", f"{PACKAGE}.doctor")
        allowed = sees_all and (inside_function or commands)
        if area_of(name) not in MAY_IMPORT[area_of(module)] and not allowed:
            yield f"{module}:{line} imports {name}"


def test_imports_go_one_way() -> None:
    wrong = [
        text
        for module, path in MODULES.items()
        for text in wrong_imports(module, path.read_text(encoding="utf-8"))
    ]
    assert wrong == []


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
    names = sorted(name for name in MODULES if area_of(name) == "core")
    code = LIGHT_IMPORT.format(heavy=HEAVY, names=names)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{len(names)} []\n"


BUILD = """
import sys
from setuptools import build_meta
build = build_meta.build_sdist if sys.argv[1] == "sdist" else build_meta.build_wheel
print(build(sys.argv[2]))
"""


def build(kind: str, tree: Path, out: Path) -> Path:
    done = subprocess.run(
        [sys.executable, "-c", BUILD, kind, str(out)],
        cwd=tree,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return out / done.stdout.splitlines()[-1]


def test_the_wheel_holds_every_file_and_one_top_level_name(tmp_path: Path) -> None:
    expected = module_files()
    tree = tmp_path / "tree"
    for path in [*expected.values(), *(ROOT / name for name in ("pyproject.toml", "LICENSE"))]:
        target = tree / path.relative_to(ROOT)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(path.read_bytes())
    (tree / "README.md").write_bytes((ROOT / "README.md").read_bytes())

    sdist = build("sdist", tree, tmp_path)
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path / "unpacked", filter="data")
    (unpacked,) = (tmp_path / "unpacked").iterdir()
    for path in expected.values():
        assert (unpacked / path.relative_to(ROOT)).is_file(), f"{path} is not in the sdist"

    # From the unpacked sdist, as an installer without wheels would.
    wheel = build("wheel", unpacked, tmp_path)
    with zipfile.ZipFile(wheel) as archive:
        names = [name for name in archive.namelist() if ".dist-info/" not in name]
        assert sorted(names) == sorted(expected)
        for name, path in expected.items():
            assert archive.read(name) == path.read_bytes()
        info = wheel.name.split("-py3")[0] + ".dist-info"
        assert archive.read(f"{info}/top_level.txt").decode().split() == [PACKAGE]
        assert f"{info}/licenses/LICENSE" in archive.namelist()


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
    lines = [*project["dependencies"], *CONFIG["dependency-groups"]["dev"]]
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
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    for name in filter(None, done.stdout.split("\0")):
        path = ROOT / name
        if path.is_file():
            try:
                yield name, path.read_text(encoding="utf-8")
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


def test_the_citation_names_this_version_and_the_paper() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == CONFIG["project"]["version"]
    assert citation["license"] == CONFIG["project"]["license"]
    paper = citation["preferred-citation"]
    assert paper["title"] == ("RoboMME-Interference: Benchmarking Robot Memory Under Interference")
    assert (paper["year"], paper["month"]) == (2026, 8)
    assert [author["family-names"] for author in paper["authors"]] == ["Rathi"]
