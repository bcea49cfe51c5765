"""One renderer of tables: for terminals, Markdown, CSV and JSON."""

import math

from robomme_interference_data.viz.tables import Table, tables_text

TABLE = Table.make(
    "rates",
    "Rates of systems",
    "system n:count rate:rate change:points kept:ratio p:p complete:flag",
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
        "------  -----  -----  ------  ----  -------  --------",
        "a|b     1,234  44.9%    −3.0  0.67  < 0.001  yes",
        "c                        0.0  0.00   1.000†  no",
        "",
        "How to read it.",
    ]


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
    """Texts wrap; columns that do not fit continue below, beside the first column."""
    words = Table.make("t", "Title " * 30, "name text", [("a", "word " * 40)], "note " * 30)
    numbers = " ".join(f"column_{n}:count" for n in range(20))
    many = Table.make("t", "", f"name {numbers}", [("row", *range(20))])
    for table in (words, many):
        assert max(map(len, table.text(80).splitlines())) <= 80
    assert words.text(80).count("word") == 40
    assert sum(line.startswith("row") for line in many.text(80).splitlines()) == 3


def test_a_note_of_several_tables_is_printed_once() -> None:
    text = tables_text([TABLE, TABLE])
    assert text.count("Rates of systems") == 2 and text.count("How to read it.") == 1
    assert text.endswith("How to read it.")
