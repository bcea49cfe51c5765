"""What every error promises: a fitting builtin, a message, a hint; and the nearest names."""

import pickle
import re
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.package import ROOT, module_files

from robomme_interference_data import errors
from robomme_interference_data.constants import DOCS_URL
from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    counted,
    named,
    naming_options,
    nearest,
)
from robomme_interference_data.schema.rollouts import Status

CLASSES = [
    value
    for value in vars(errors).values()
    if isinstance(value, type)
    and issubclass(value, InterferenceError)
    and value is not InterferenceError
]


@pytest.mark.parametrize("error", CLASSES, ids=lambda error: error.__name__)
def test_each_is_a_builtin_too_and_travels_between_processes(
    error: type[InterferenceError],
) -> None:
    builtins = [base for base in error.__mro__ if base.__module__ == "builtins"]
    assert len(builtins) > 3  # a specific one, besides Exception, BaseException and object
    raised = error("what was found", "what to do", "verify my-buffers")
    for one in (raised, pickle.loads(pickle.dumps(raised))):
        assert type(one) is error
        lines = ["what was found", "what to do", "Run: robomme-interference verify my-buffers"]
        assert str(one).splitlines() == lines
        assert (one.hint, one.command) == ("what to do", "verify my-buffers")
    assert str(error("only this")) == "only this"


def test_an_error_about_something_keeps_the_rest() -> None:
    error = InvalidOptionError.expected("workers", 0, "1 or more", "a hint")
    about = error.about("episode 7")
    assert about.message == "episode 7: workers 0; expected 1 or more"
    assert (about.hint, about.option) == ("a hint", "workers")


@pytest.mark.parametrize(
    ("given_name", "known", "sentence"),
    [
        ("VideoRepik", ["VideoRepick", "MoveCube"], "Did you mean 'VideoRepick'?"),
        ("wirst", ["wrist", "waist"], "Did you mean 'wrist' or 'waist'?"),
        ("xyz", ["front", "wrist"], "Known: front, wrist"),
        ("failed", list(Status), "Did you mean 'fail'?"),
        ("anything", [], ""),
        ("#", list("abcdefghijkl"), "Known: a, b, c, d, e, f, g, h, i, j, … (12 in all)"),
    ],
)
def test_nearest(given_name: str, known: list[str], sentence: str) -> None:
    assert nearest(given_name, known) == sentence


@given(st.text(max_size=8), st.lists(st.text(max_size=8), max_size=12))
def test_nearest_offers_only_known_names(given_name: str, known: list[str]) -> None:
    sentence = nearest(given_name, known)
    if sentence.startswith("Did you mean "):
        assert any(repr(name) in sentence for name in known)
    else:
        assert sentence.startswith("Known: ") or not known


def test_nearest_of_very_many_names_is_quick() -> None:
    known = [f"VideoRepick/test/{index}" for index in range(10_000)]
    started = time.perf_counter()
    sentence = nearest("VideoRepick/test/1234x", known)
    assert time.perf_counter() - started < 60
    assert "'VideoRepick/test/1234'" in sentence


@pytest.mark.parametrize(
    ("count", "nouns", "text"),
    [
        (0, ("row",), "0 rows"),
        (1, ("row",), "1 row"),
        (1200, ("row",), "1,200 rows"),
        (1, ("query", "queries"), "1 query"),
        (2, ("query", "queries"), "2 queries"),
    ],
)
def test_counted(count: int, nouns: tuple[str, ...], text: str) -> None:
    assert counted(count, *nouns) == text


def test_settings_are_named_as_the_reader_writes_them() -> None:
    assert (named("fps"), named("executor", "ray")) == ("`fps`", 'executor="ray"')
    assert named("workers", 2) == "workers=2"
    with naming_options({"fps": "--fps", "buffer_set": "BUFFER_SET"}):
        assert (named("fps"), named("fps", "1 0")) == ("--fps", "--fps '1 0'")
        assert (named("buffer_set"), named("workers")) == ("BUFFER_SET", "`workers`")
        error = InvalidOptionError.expected("fps", 0, "a positive number")
        assert error.message == "--fps 0; expected a positive number" and error.option == "fps"
    assert named("fps") == "`fps`"


def test_pages_in_hints_are_addresses() -> None:
    error = InterferenceError("docs/my.md is no prompt", "See docs/how-to/connect-a-policy.md.")
    assert error.message == "docs/my.md is no prompt"
    assert error.hint == f"See {DOCS_URL}/how-to/connect-a-policy.html."
    assert error.about("x").hint == error.hint


def test_every_page_that_the_code_names_exists() -> None:
    named = {
        page
        for path in module_files().values()
        if path.suffix == ".py"
        for page in re.findall(r"\bdocs/[\w/-]+\.md", path.read_text(encoding="utf-8"))
    }
    named -= {"docs/PAGE.md"}  # in a docstring
    assert len(named) > 5
    assert [page for page in named if not (ROOT / page).is_file()] == []
