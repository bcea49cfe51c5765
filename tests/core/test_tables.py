"""One renderer of tables: for terminals, Markdown, CSV and JSON."""

import math

from robomme_interference_data.viz.tables import Table

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
        "c                        0.0  0.00    1.000  no",
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
