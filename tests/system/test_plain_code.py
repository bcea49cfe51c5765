"""The check of dense idioms finds them, and nothing that reads plainly."""

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
