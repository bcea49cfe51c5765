"""What docs/results/training.md states is what its rows say."""

import csv
import json
import runpy
from collections import Counter
from collections.abc import Mapping
from typing import Any

import pyarrow.parquet as pq
import pytest
from support import scoring as made
from support.pages import RESULTS, table

from robomme_interference_data.constants import PROTOCOL_VERSION
from robomme_interference_data.evaluate.score.compare import compare
from robomme_interference_data.simulators.tabletop import SUITE_VERSION

PAGE = (RESULTS / "training.md").read_text(encoding="utf-8")
FOLDER = RESULTS / "training"
RATES = (FOLDER / "rates.csv").read_text(encoding="utf-8")


def counted(**cell: str) -> tuple[int, int]:
    """Return the successes and rollouts of a cell of rates.csv."""
    key = {"shift": "none", "family": "all", "training_seed": "all", **cell}
    [found] = [row for row in csv.DictReader(RATES.splitlines()) if key.items() <= row.items()]
    return int(found["successes"]), int(found["n"])


def percent(**cell: str) -> str:
    successes, n = counted(**cell)
    return f"{100 * successes / n:.1f}"


def test_rows_are_of_the_current_versions() -> None:
    assert json.loads((FOLDER / "versions.json").read_text(encoding="utf-8")) == {
        "protocol_version": PROTOCOL_VERSION,
        "suite_version": str(SUITE_VERSION),
    }
    assert f"(suite version {SUITE_VERSION})" in PAGE


@pytest.mark.slow
def test_rates_are_those_of_the_rows() -> None:
    assert runpy.run_path(str(RESULTS / "make_rates.py"))["rates"]() == RATES


@pytest.mark.parametrize("first", ["policy", "system"])
def test_rates_by_condition(first: str) -> None:
    listed = [line for line in table(PAGE, first) if line[first].startswith("`")]
    assert len(listed) >= 5
    for line in listed:
        system = line.pop(first).strip("`")
        for condition, rate in line.items():
            if rate:
                assert rate == percent(system=system, condition=condition), (system, condition)
        runs = {
            row["training_seed"]
            for row in csv.DictReader(RATES.splitlines())
            if row["system"] == system and row["condition"] in ("k0", "k7")
        }
        assert runs == {"all", "0", "1", "2"}  # "three seeds"


def test_rates_in_sentences() -> None:
    for share, cell in {
        "72.0%": {"system": "acts-mixture", "condition": "same-k3"},
        "61.3%": {"system": "acts-mixture", "condition": "held-k3"},
        "17.3%": {"system": "acts-mixture", "condition": "parts-k3"},
        "60.4%": {"system": "acts-wide", "condition": "parts-k3"},
        "9.3%": {"system": "acts-k0", "condition": "held-k3"},
        "44.0%": {"system": "acts-wide", "condition": "k0", "shift": "light:2"},
        "49.1%": {"system": "acted-k0", "condition": "k0"},
    }.items():
        assert share == f"{percent(**cell)}%" and share in PAGE, cell
    for text, system, family in (
        ("36.0 and 26.0% at k0", "learned-k0", ("VideoUnmask", "VideoUnmaskSwap")),
        ("(72.0 and 77.3%)", "learned-window-k0", ("MoveCube", "InsertPeg")),
    ):
        rates = [percent(system=system, condition="k0", family=one) for one in family]
        assert text.strip("()").startswith(" and ".join(rates)) and text in PAGE
    for text, system in (("33.3 to 0.0%", "acts-gru-k0"), ("34.0 to 28.0%", "acts-gru-mixture")):
        rates = [percent(system=system, condition=condition) for condition in ("k0", "k7")]
        assert f"{' to '.join(rates)}%" == text and text in PAGE
    for condition in ("k0", "k1", "k3", "k7", "k15", "k31"):  # "worse at every k"
        assert counted(system="learned-long", condition=condition) < counted(
            system="learned-mixture", condition=condition
        )
    for condition in ("before-k7", "middle-k7"):
        assert counted(system="acts-mixture", condition=condition) == (0, 75)


def interval(row: Mapping[str, Any], sign: int = 1, plus: str = "+") -> str:
    """Return a difference and its interval as the page prints them, in points."""
    ends = (row["difference"], *sorted((row["low"], row["high"]), key=lambda end: sign * end))
    value, low, high = (f"{100 * sign * end:{plus}.1f}".replace("-", "−") for end in ends)
    return f"{value} ({low} to {high})"


@pytest.mark.parametrize(
    ("first", "second", "under"),
    [
        ("acts-k0", None, ("k0", "k7")),
        ("acts-k0", "acts-k0-retrieval", ("k0", "k7")),
        ("acts-mixture", None, ("k0", "k7")),
        ("acts-k0", "acts-mixture", ("k0", "k7", "k15")),
        ("acts-mixture", "acts-wide", ("k7",)),
        ("learned-k0", "learned-mixture", ("k0", "k7", "parts-k3")),
    ],
)
def test_differences(first: str, second: str | None, under: tuple[str, ...]) -> None:
    """Of one system, or with retrieval, k7 − k0; of two trainings, under each condition."""
    falls = second is None or second == f"{first}-retrieval"
    paths = [FOLDER / f"{name}.parquet" for name in (first, second) if name is not None]
    rows = compare(*paths, conditions=under if falls else ()).table.records()
    whole = {row["condition"]: row for row in rows if row["family"] == "all"}
    for condition in under[1:] if falls else under:
        assert interval(whole[condition]) in PAGE, condition
        assert whole[condition]["scope"].value == "training runs"


@pytest.mark.slow
def test_slopes() -> None:
    def tables(first: str, second: str) -> dict[str, Any]:
        paths = (FOLDER / f"{name}.parquet" for name in (first, second))
        return {**made.score(*paths, draws=10_000).tables}

    both = tables("learned-k0", "learned-mixture")
    for row in both["decay"].records():
        assert interval({**row, "difference": row["slope"]}, plus="").replace("−0.0", "0.0") in PAGE
    for pair in (
        both,
        tables("learned-gru-k0", "learned-gru-mixture"),
        tables("learned-full-k0", "learned-sampled-k0"),
    ):
        [row] = pair["interaction"].records()
        assert interval(row, -1, plus="").replace("−0.0", "0.0") in PAGE


def test_execution_collapses_in_move_cube() -> None:
    rows = pq.read_table(FOLDER / "acts-k0.parquet").to_pylist()
    timeouts = Counter(
        row["condition"]
        for row in rows
        if row["family"] == "MoveCube" and row["status"] == "timeout"
    )
    assert f"{timeouts['k0']} time out at k0 and {timeouts['k31']} at k31" in PAGE


def test_what_shifts_cost() -> None:
    """Seed 0 of `acts-wide` at k0, in the episodes that ran under shifts."""

    def won(name: str, shift: str) -> dict[tuple[str, int], bool]:
        return {
            (row["family"], row["episode"]): row["success"]
            for row in pq.read_table(FOLDER / f"{name}.parquet").to_pylist()
            if (row["condition"], row["shift"], row["training_seed"]) == ("k0", shift, 0)
        }

    plain = won("acts-wide", "none")
    changed = {}
    for kind in ("light", "camera", "clutter"):
        shifted = won("acts-wide-shifts", f"{kind}:2")
        assert len(shifted) == 75
        lost = sum(plain[at] and not shifted[at] for at in shifted)
        gained = sum(shifted[at] and not plain[at] for at in shifted)
        changed[kind] = (lost, gained)
        assert f"{100 * sum(plain[at] for at in shifted) / 75:.1f} to" in PAGE
    assert changed == {"light": (31, 5), "camera": (9, 5), "clutter": (0, 0)}
    assert "(31 lost, 5 gained)" in PAGE and "loses 9 and gains 5" in PAGE


def test_learned_systems_differ_in_a_quarter_of_the_episodes() -> None:
    """What `power` plans two learned systems with, and its help and how-to say."""
    flips = []
    for first, second in (
        ("acts-k0", "acts-mixture"),
        ("learned-k0", "learned-mixture"),
        ("learned-k0", "learned-gru-k0"),
    ):
        paths = (FOLDER / f"{name}.parquet" for name in (first, second))
        rows = compare(*paths).table.records()
        [at_k0] = [r for r in rows if (r["condition"], r["family"]) == ("k0", "all")]
        flips.append(round(100 * at_k0["flips"]))
    assert (min(flips), max(flips)) == (22, 28)
