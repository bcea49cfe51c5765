"""The check of plain code finds dense idioms and types, and nothing that reads plainly."""

import ast
import runpy
from pathlib import Path

import pytest

SCRIPT = runpy.run_path(str(Path(__file__).parents[2] / "scripts" / "plain_code.py"))


def idioms(code: str) -> list[str]:
    return [idiom for _, idiom in SCRIPT["dense_idioms"](ast.parse(code))]


@pytest.mark.parametrize(
    "code",
    [
        "'s' * plural",
        "f': {text}' * bool(text)",
        "(count != 1) * 's'",
        "[first] * self.known",
        "'/' * name.endswith('/')",
        "(not empty) * ('a',)",
    ],
)
def test_a_text_times_a_truth_value_is_found(code: str) -> None:
    assert idioms(code) == ["a text or list times a truth value"]


@pytest.mark.parametrize(
    "code",
    [
        "x = (*('a', 'b'), *('c',))",
        "x = {'a': 1, **{'b': 2}, **({'c': 3} if more else {})}",
        "x = [*([1] if more else []), *[2]]",
        "f(*(1, 2), **{'a': 3})",
    ],
)
def test_a_spread_literal_is_found(code: str) -> None:
    assert idioms(code) == ["a spread literal"] * 2


@pytest.mark.parametrize(
    "code",
    [
        "'-' * 40",
        "' ' * indent",
        "[None] * len(rows)",
        "'?' * column_count",
        "x = (*known, *(name for name in names), 'a')",
        "f(*values, **options, **(own() if more else {}))",
    ],
)
def test_plain_code_passes(code: str) -> None:
    assert idioms(code) == []


def test_classes_and_type_aliases_are_types_and_constants_are_not() -> None:
    code = (
        "class _Row: pass\nCell = tuple[str, str]\nLIMIT = 3\n_HERE = 1\nrows: Any = []\nURLs = 1\n"
    )
    assert [*SCRIPT["type_names"](ast.parse(code))] == [("Row", 1), ("Cell", 2), ("URLs", 6)]
