"""Report dense idioms in the package, and names of types that mean two things.

Dense are a text or list times a truth value, and spread literals. `"text" * flag` reads as
arithmetic and is a choice: write `"text" if flag else ""`. `*("a", "b")` and `**{"a": 1}` inside
another display only save line breaks: write one item a line.

Two classes or type aliases of one name, private ones included, stop a reader who searches for it.
"""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
AREAS = ("robomme_interference_data", "build_dataset", "retrieval", "evaluate", "cards")

# The factor of a text may be a name only if its last word is one of these: types are not known.
_NUMBERS = {
    "count",
    "depth",
    "indent",
    "length",
    "level",
    "missing",
    "n",
    "number",
    "repeat",
    "size",
    "times",
    "width",
}
_TRUTH_CALLS = {"all", "any", "bool", "callable", "hasattr", "isinstance", "issubclass"}
_TRUTH_METHODS = {"endswith", "exists", "startswith"}

_TYPE = re.compile(r"_?[A-Z][A-Z0-9]*[a-z]\w*")
"""The name of a class or type alias; constants have no small letters."""


def dense_idioms(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield the line of each dense idiom in a syntax tree, with what it is."""
    for node in ast.walk(tree):
        match node:
            case ast.BinOp(op=ast.Mult(), left=left, right=right):
                if _repeats(left, right) or _repeats(right, left):
                    yield node.lineno, "a text or list times a truth value"
            case ast.Tuple(elts=items) | ast.List(elts=items) | ast.Set(elts=items):
                yield from _spread(items)
            case ast.Call(args=items, keywords=keywords):
                yield from _spread(items)
                for keyword in keywords:
                    if keyword.arg is None and _is_literal(keyword.value):
                        yield keyword.value.lineno, "a spread literal"
            case ast.Dict(keys=keys, values=values):
                for key, value in zip(keys, values, strict=True):
                    if key is None and _is_literal(value):
                        yield value.lineno, "a spread literal"


def _spread(items: list[ast.expr]) -> Iterator[tuple[int, str]]:
    for item in items:
        if isinstance(item, ast.Starred) and _is_literal(item.value):
            yield item.lineno, "a spread literal"


def _is_literal(node: ast.expr) -> bool:
    """Return whether a value is written out in place, or a choice between such values."""
    if isinstance(node, ast.IfExp):
        return _is_literal(node.body) and _is_literal(node.orelse)
    return isinstance(node, ast.Tuple | ast.List | ast.Set | ast.Dict)


def _repeats(sequence: ast.expr, factor: ast.expr) -> bool:
    """Return whether a text or display is multiplied by what may be a truth value."""
    is_text = isinstance(sequence, ast.Constant) and isinstance(sequence.value, str | bytes)
    if not (is_text or isinstance(sequence, ast.JoinedStr | ast.Tuple | ast.List)):
        return False
    match factor:
        case ast.Compare() | ast.BoolOp() | ast.UnaryOp(op=ast.Not()):
            return True
        case ast.Call(func=ast.Name(id=name)):
            return name in _TRUTH_CALLS
        case ast.Call(func=ast.Attribute(attr=name)):
            return name in _TRUTH_METHODS or name.startswith(("is_", "has_"))
        case ast.Name(id=name) | ast.Attribute(attr=name):
            return name.split("_")[-1] not in _NUMBERS
    return False


def type_names(tree: ast.Module) -> Iterator[tuple[str, int]]:
    """Yield the name of each class and type alias of a module, without `_`, and its line."""
    for node in tree.body:
        names: list[str] = []
        match node:
            case ast.ClassDef(name=name):
                names = [name]
            case ast.Assign(targets=[ast.Name(id=name)]) | ast.AnnAssign(target=ast.Name(id=name)):
                names = [name]
        for name in names:
            if _TYPE.fullmatch(name):
                yield name.removeprefix("_"), node.lineno


def main() -> int:
    """Print each place; return 1 if there is one."""
    problems: list[str] = []
    first_places: dict[str, str] = {}
    for area in AREAS:
        for path in sorted((ROOT / area).rglob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            file = path.relative_to(ROOT)
            problems += [f"{file}:{line}: {idiom}" for line, idiom in sorted(dense_idioms(tree))]
            for name, line in type_names(tree):
                place = f"{file}:{line}"
                first = first_places.setdefault(name, place)
                if first != place:
                    problems.append(f"{place}: the type {name} has the name of another, {first}")
    print(*problems, sep="\n", end="\n" if problems else "")
    return int(bool(problems))


if __name__ == "__main__":
    sys.exit(main())
