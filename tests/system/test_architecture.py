"""The picture of the package's folders shows the imports of the code."""

import ast
import runpy
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
PICTURE = runpy.run_path(str(ROOT / "docs" / "pictures" / "make_architecture.py"))
PACKAGE = "robomme_interference_data"
SHARED = "cli: options, console"


def folder_of(module: tuple[str, ...]) -> str:
    """The box of a module, given its path inside the package."""
    if module[:2] in (("cli", "options"), ("cli", "console")):
        return SHARED
    return module[0]


def modules() -> Iterator[tuple[Path, tuple[str, ...]]]:
    """Yield each file and its path inside the package."""
    inside = ROOT / PACKAGE
    for path in inside.glob("*/**/*.py"):
        yield path, path.relative_to(inside).with_suffix("").parts
    for area in ("build_dataset", "cards", "evaluate", "retrieval"):
        for path in (ROOT / area).rglob("*.py"):
            yield path, path.relative_to(ROOT).with_suffix("").parts


def imported(path: Path, module: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """Yield what a file imports of the package, as paths inside it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.ImportFrom):
            continue
        base = (PACKAGE, *module)[: -node.level] if node.level else ()
        source = (*base, *(node.module or "").split("."))
        for name in node.names:
            whole = tuple(part for part in (*source, name.name) if part)
            if whole[0] == PACKAGE and len(whole) > 1:
                yield whole[1:]


def reached(start: str, arrows: set[tuple[str, str]]) -> set[str]:
    """The boxes at the ends of all paths from a box."""
    found: set[str] = set()
    left = {start}
    while left:
        left = {target for source, target in arrows if source in left} - found
        found |= left
    return found


def test_arrows_are_the_imports() -> None:
    boxes = set(PICTURE["BOXES"])
    imports = {
        (folder_of(module), folder_of(target))
        for path, module in modules()
        for target in imported(path, module)
    }
    imports = {(a, b) for a, b in imports if a != b and {a, b} <= boxes}
    assert {name for pair in imports for name in pair} == boxes
    arrows = set(PICTURE["ARROWS"])
    assert arrows <= imports
    assert [(a, b) for a, b in sorted(imports) if b not in reached(a, arrows)] == []
    for arrow in arrows:  # none follows from the others
        assert arrow[1] not in reached(arrow[0], arrows - {arrow}), arrow
