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
from robomme_interference_data.stats.significance import holm

PAGE = (RESULTS / "training.md").read_text(encoding="utf-8")
FOLDER = RESULTS / "training"
RATES = (FOLDER / "rates.csv").read_text(encoding="utf-8")


def cell_of(**cell: str) -> dict[str, str]:
    """Return a line of rates.csv."""
    key = {"shift": "none", "family": "all", "training_seed": "all", **cell}
    [found] = [row for row in csv.DictReader(RATES.splitlines()) if key.items() <= row.items()]
    return found


def counted(**cell: str) -> tuple[int, int]:
    """Return the successes and rollouts of a cell of rates.csv."""
    found = cell_of(**cell)
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
    assert len(listed) >= 3
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
        "61.3%": {"system": "acts-mixture", "condition": "held-k3"},
        "9.3%": {"system": "acts-k0", "condition": "held-k3"},
    }.items():
        assert share == f"{percent(**cell)}%" and share in PAGE, cell
    for condition in ("before-k7", "middle-k7"):
        assert counted(system="acts-mixture", condition=condition) == (0, 75)


def test_rates_in_the_episodes_with_a_still_picture() -> None:
    rows = pq.read_table(FOLDER / "acts-k0.parquet").to_pylist()
    held = pq.read_table(FOLDER / "acts-k0-kinds.parquet").to_pylist()
    episodes = {(row["family"], row["episode"]) for row in held}
    won = Counter(
        row["condition"]
        for row in (*rows, *held)
        if row["training_seed"] == 0 and row["success"]
        if (row["family"], row["episode"]) in episodes
    )
    k0, k3, still = (f"{100 * won[one] / 75:.1f}%" for one in ("k0", "k3", "held-k3"))
    assert f"{k0} at k0, {still} under `held-k3`, {k3} at k3 (one seed, 75 episodes)" in PAGE


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
        ("acts-k0", "acts-mixture", ("k7",)),
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


def test_a_seed_does_not_fix_the_weights() -> None:
    def answers(name: str, seed: int) -> dict[tuple[str, str, int], str]:
        rows = pq.read_table(FOLDER / f"{name}.parquet").to_pylist()
        return {
            (row["family"], row["condition"], row["episode"]): row["answer"]
            for row in rows
            if row["training_seed"] == seed
        }

    again, first = answers("learned-k0-again", 0), answers("learned-k0", 0)
    other = answers("learned-k0", 1)
    repeated = sum(first[at] == answer for at, answer in again.items()) / len(again)
    assert f"{100 * repeated:.1f}% equal answers" in PAGE
    between = sum(other[at] == answer for at, answer in first.items()) / len(first)
    assert f"another seed gives {100 * between:.1f}%" in PAGE


def test_what_of_the_fall_is_content() -> None:
    lines = table(PAGE, "system | from")
    found = []
    for line in lines:
        path = FOLDER / f"{line['system'].strip('`')}.parquet"
        under = (line["from"].strip("`"), line["to"].strip("`"))
        rows = compare(path, conditions=under).table.records()
        [whole] = [row for row in rows if row["family"] == "all"]
        assert interval(whole) == line["points, 95% interval"], line
        found.append(whole["p"])
    corrected = [f"{p:.2f}" for p in holm(found)]
    assert corrected == [line["p"] for line in lines]


@pytest.mark.slow
def test_slopes() -> None:
    paths = (FOLDER / f"{name}.parquet" for name in ("learned-k0", "learned-mixture"))
    tables = made.score(*paths, draws=10_000).tables
    for row in tables["decay"].records():
        assert interval({**row, "difference": row["slope"]}, plus="").replace("−0.0", "0.0") in PAGE
    [row] = tables["interaction"].records()
    assert interval(row, -1, plus="").replace("−0.0", "0.0") in PAGE


def test_how_rollouts_end() -> None:
    k0, k7 = (cell_of(system="acts-k0", condition=condition) for condition in ("k0", "k7"))
    moved = cell_of(system="acts-k0", condition="k7", family="MoveCube")
    assert (
        f"of {k0['n']} rollouts of `acts-k0`, {k0['timeouts']} time out at k0 and "
        f"{k7['timeouts']} at k7, {moved['timeouts']} of them in MoveCube"
    ) in PAGE
    assert f"step {k0['fail_step']} at k0, {k7['fail_step']} at k7" in PAGE


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
