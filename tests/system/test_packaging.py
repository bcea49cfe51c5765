"""Imports go one way, dependencies are pinned, and no file names what it may not."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from support.package import CONFIG, HEAVY, MAPPING, PACKAGE, ROOT, committable, module_files

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
    """All of it but the module of the extra `cluster`, which is loaded at use."""
    names = sorted(
        name for name in MODULES if area_of(name) == "core" and name != f"{PACKAGE}.cluster"
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


def test_the_citation_names_this_version_and_the_paper() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == CONFIG["project"]["version"]
    assert citation["license"] == CONFIG["project"]["license"]
    paper = citation["preferred-citation"]
    assert paper["title"] == ("RoboMME-Interference: Benchmarking Robot Memory Under Interference")
    assert (paper["year"], paper["month"]) == (2026, 8)
    assert [author["family-names"] for author in paper["authors"]] == ["Rathi"]
