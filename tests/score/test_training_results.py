"""The tables of docs/results/training.md are those of its rows."""

import pyarrow.parquet as pq
import pytest
from support.pages import RESULTS, table

from robomme_interference_data.schema.shifts import NO_SHIFT

PAGE = (RESULTS / "training.md").read_text(encoding="utf-8")
Rows = dict[tuple[str, str, str, int], list[bool]]


@pytest.fixture(scope="module")
def rows() -> Rows:
    """Outcomes by system, condition (with the shift, if there is one), family and model seed."""
    outcomes: Rows = {}
    for path in sorted((RESULTS / "training").glob("*.parquet")):
        for row in pq.read_table(path).to_pylist():
            shift = "" if row["shift"] == NO_SHIFT else f" {row['shift']}"
            key = row["system"], row["condition"] + shift, row["family"], row["model_seed"]
            outcomes.setdefault(key, []).append(row["success"])
    return outcomes


def percent(
    rows: Rows, system: str, condition: str, family: str | None = None, seed: int | None = None
) -> str:
    """Return the rate of successes as the page prints it; empty without rows."""
    chosen = [
        one
        for (name, under, of, trained), outcomes in rows.items()
        if (name, under) == (system, condition) and family in (None, of) and seed in (None, trained)
        for one in outcomes
    ]
    return f"{100 * sum(chosen) / len(chosen):.1f}" if chosen else ""


@pytest.mark.slow
@pytest.mark.parametrize(
    "first", ["system", "policy", "further conditions", "under shifts", "carried out"]
)
def test_rates_by_condition(rows: Rows, first: str) -> None:
    listed = table(PAGE, first)
    assert listed
    for line in listed:
        system = line.pop(first).strip("`")
        line.pop("seeds", None)
        for condition, rate in line.items():
            assert rate == percent(rows, system, condition), (system, condition)


def test_rates_by_training_seed(rows: Rows) -> None:
    for line in table(PAGE, "by seed"):
        system, seed = line.pop("by seed").split()
        for condition, rate in line.items():
            found = percent(rows, system.strip("`"), condition, seed=int(seed))
            assert rate == found, (system, seed, condition)


@pytest.mark.parametrize("first", ["family", "acting in"])
def test_rates_by_family(rows: Rows, first: str) -> None:
    for line in table(PAGE, first):
        family = line.pop(first)
        for title, rate in line.items():
            system, condition = title.split()
            assert rate == percent(rows, system.strip("`"), condition, family), (title, family)


@pytest.mark.parametrize(("first", "learner"), [("condition", "learned"), ("under", "acts")])
def test_what_training_with_interference_changes(rows: Rows, first: str, learner: str) -> None:
    for line in table(PAGE, first):
        with_, without = (
            float(percent(rows, f"{learner}-{trained}", line[first]))
            for trained in ("mixture", "k0")
        )
        assert float(line["mixture − k0"].split()[0].replace("−", "-")) == pytest.approx(
            with_ - without, abs=0.11
        )
