"""Untrusted text is shown literally in Markdown."""

import ast
import unicodedata
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from markdown_it import MarkdownIt

from robomme_interference_data.cards.markdown import Raw, block, code, escape, quoted, table
from robomme_interference_data.viz.tables import Table

READER = MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"])
NASTY = st.text(st.sampled_from(" \t\n#+-=*_~`|<>&$![](){}\\:/@.1aB\u202e\x00\ud800é"), max_size=40)


def one_line(text: str) -> str:
    kept = (one if unicodedata.category(one)[0] != "C" else " " for one in text)
    return " ".join("".join(kept).split())


def inline(tokens: Any) -> list[Any]:
    return [child for token in tokens if token.type == "inline" for child in token.children]


@pytest.mark.slow
@given(st.one_of(st.text(max_size=60), NASTY))
def test_escaped_text_is_shown_as_it_is(text: str) -> None:
    expected = one_line(text)
    for before in ("", "word ", "- "):
        found = inline(READER.parse(f"{before}{escape(text)}"))
        assert {token.type for token in found} <= {"text", "text_special"}
        shown = "".join(token.content for token in found)
        assert shown == (before.removeprefix("- ") + expected).strip()


@given(st.one_of(st.text(max_size=60), NASTY))
def test_texts_in_tables_stay_in_their_cells(text: str) -> None:
    rows = [(escape(text), code(text), "last")]
    read = READER.parse(table(Table("t", "T", {"a": "text", "b": "text", "c": "text"}, rows)))
    cells = [token for token in read if token.type == "td_open"]
    assert len(cells) == 3
    content = [token.children for token in read if token.type == "inline"][3:]
    assert "".join(one.content for one in content[0]) == one_line(text)
    assert content[2][0].content == "last"


@given(st.one_of(st.text(max_size=60), NASTY))
def test_code_in_a_line_shows_the_text(text: str) -> None:
    found = inline(READER.parse(f"a {code(text)} b"))
    if found[1].type == "code_inline":
        assert found[1].content == one_line(text)
    else:
        assert [found[1].content, found[-2].content] == ["<code>", "</code>"]
        shown = "".join(token.content for token in found[2:-2])
        assert shown == one_line(text)


@given(st.one_of(st.text(max_size=60), NASTY), st.integers(0, 9))
def test_a_block_of_code_is_one_block(text: str, fence: int) -> None:
    [token] = READER.parse(block(text + "\n" + "`" * fence, "bash"))
    assert (token.type, token.info) == ("fence", "bash")


@given(st.one_of(st.text(max_size=60), NASTY))
def test_quoted_text_is_a_literal_in_a_block_of_code(text: str) -> None:
    line = f"load({quoted(text)})"
    assert "\n" not in line
    assert "`" not in line
    assert ast.literal_eval(line.removeprefix("load")) == text


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("VideoRepick/test/7", "VideoRepick/test/7"),
        ("# a", "&#35; a"),
        ("- b", "&#45; b"),
        ("a_b", "a\\_b"),
        (12, "12"),
        (Raw("**a**"), "**a**"),
    ],
)
def test_ordinary_texts_stay_readable(text: Any, expected: str) -> None:
    assert escape(text) == expected


def test_long_texts_are_cut() -> None:
    assert escape("a" * 100_000).endswith("a…")
    assert len(escape("a" * 100_000)) == len(code("a" * 100_000)) - 2 == 400
