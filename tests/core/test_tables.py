"""One renderer of tables: for terminals, Markdown, CSV and JSON."""

import math

from robomme_interference_data.viz.tables import Columns, Table, tables_text

TABLE = Table(
    "rates",
    "Rates of systems",
    {
        "system": "text",
        "n": "count",
        "rate": "rate",
        "change": "points",
        "kept": "ratio",
        "p": "p",
        "complete": "flag",
    },
    [
        ("a|b", 1234, 0.4489, -0.0304, 0.666, 0.0004, True),
        ("c", None, math.nan, -0.0000001, -0.001, 1.0, False),
    ],
    "How to read it.",
)


def test_a_terminal_gets_aligned_columns() -> None:
    assert TABLE.text().splitlines() == [
        "Rates of systems",
        "",
        "system      n   rate  change  kept        p  complete",
        "─" * 53,
        "a|b     1,234  44.9%    −3.0  0.67  < 0.001  yes",
        "c                        0.0  0.00   1.000†  no",
        "",
        "How to read it.",
    ]


def test_a_column_without_values_can_be_left_out() -> None:
    columns: Columns = {"family": "text", "difficulty": "text", "n": "count"}
    table = Table("t", "T", columns, [("a", None, 1), ("b", "", 2)]).without_empty("difficulty")
    assert (list(table.columns), table.rows) == (["family", "n"], [("a", 1), ("b", 2)])
    table = Table("t", "T", columns, [("a", None, 1), ("b", "hard", 2)]).without_empty("difficulty")
    assert list(table.columns) == list(columns)


def test_markdown_has_a_title_and_a_note() -> None:
    lines = TABLE.markdown().splitlines()
    assert lines[0] == "# Rates of systems"
    assert lines[3] == "| --- | ---: | ---: | ---: | ---: | ---: | --- |"
    assert lines[4] == "| a\\|b | 1,234 | 44.9% | −3.0 | 0.67 | < 0.001 | yes |"
    assert lines[-1] == "How to read it."


def test_csv_has_fractions_and_json_no_nan() -> None:
    assert TABLE.csv() == (
        "system,n,rate,change,kept,p,complete\n"
        "a|b,1234,0.448900,-0.030400,0.666000,0.0004,yes\n"
        "c,,,0.000000,-0.001000,1,no\n"
    )
    assert TABLE.records()[1] == {
        **{"system": "c", "n": None, "rate": None, "change": -0.0000001, "kept": -0.001},
        **{"p": 1.0, "complete": False},
    }


def test_a_table_fits_the_terminal() -> None:
    """Texts wrap; columns that do not fit continue below, beside the key columns."""
    words = Table(
        "t", "Title " * 30, {"name": "text", "text": "text"}, [("a", "word " * 40)], "note " * 30
    )
    numbers: Columns = {f"column_{n}": "count" for n in range(20)}
    many = Table("t", "", {"name": "text"} | numbers, [("row", *range(20))])
    for table in (words, many):
        assert max(map(len, table.text(80).splitlines())) <= 80
    assert words.text(80).count("word") == 40
    assert sum(line.startswith("row") for line in many.text(80).splitlines()) == 3


def test_a_count_of_a_whole_stays_in_one_line() -> None:
    columns: Columns = {f"found_{n}": "text" for n in range(12)}
    table = Table("t", "", {"name": "text"} | columns, [("row", *["16 of 160"] * 12)])
    text = table.text(80)
    assert max(map(len, text.splitlines())) <= 80 and text.count("16 of 160") == 12


def test_a_note_of_several_tables_is_printed_once() -> None:
    text = tables_text([TABLE, TABLE])
    assert text.count("Rates of systems") == 2 and text.count("How to read it.") == 1
    assert text.endswith("How to read it.")


def test_columns_that_continue_below_repeat_what_tells_rows_apart() -> None:
    """The system is the same in all rows, and the family follows from the other keys."""
    columns: Columns = dict.fromkeys(("system", "family", "condition", "cell"), "text")
    columns |= {f"a_long_column_{n}": "count" for n in range(9)}
    rows = [
        ("mine", family, condition, f"{family}/{condition}", *range(9))
        for family in ("MoveCube", "InsertPeg")
        for condition in ("k0", "k7")
    ]
    table = Table("t", "Title", columns, rows)
    blocks = [block.splitlines() for block in table.text(80).split("\n\n")[1:]]
    assert len(blocks) > 1 and max(len(line) for block in blocks for line in block) <= 80
    heads = [[line.startswith("─") for line in block].index(True) - 1 for block in blocks]
    assert blocks[0][heads[0]].split()[:4] == ["system", "family", "condition", "cell"]
    for block, at in zip(blocks[1:], heads[1:], strict=True):
        head, lines = block[at], block[at + 2 :]
        assert head.split()[:2] == ["family", "condition"] and "system" not in head
        keys = [tuple(line.split()[:2]) for line in lines if line.split()[0].isalpha()]
        assert keys == [(family, condition) for _, family, condition, *_ in rows]


def test_keys_leave_room_for_a_column() -> None:
    rows = [
        (*(letter * 26 for letter in letters), 1, 2) for letters in ("abc", "abd", "aec", "fbc")
    ]
    text = Table(
        "t",
        "",
        {"first": "text", "second": "text", "third": "text", "one": "count", "two": "count"},
        rows,
    ).text(80)
    assert max(map(len, text.splitlines())) <= 80 and "first" in text and "two" in text


def test_bold_is_a_star_in_text_and_bold_elsewhere() -> None:
    table = Table("t", "", {"system": "text", "k0": "text"}, [("mine", "**45.0%** [40.0, 50.0]")])
    assert "45.0%* [40.0, 50.0]" in table.text() and "**" not in table.text()
    assert "**45.0%**" in table.markdown() and "\\textbf{45.0\\%}" in table.latex()
