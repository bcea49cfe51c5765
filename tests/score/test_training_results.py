"""What docs/results/training.md states is what its rows say."""

import pyarrow.parquet as pq
import pytest
from support.pages import RESULTS, table

from robomme_interference_data.evaluate.score.compare import compare
from robomme_interference_data.schema.shifts import NO_SHIFT

TRAINING = (RESULTS / "training.md").read_text(encoding="utf-8")

Outcomes = dict[tuple[str, str, str, int], list[bool]]


@pytest.fixture(scope="module")
def trained() -> Outcomes:
    """Outcomes by system, condition (with the shift, if there is one), family and model seed."""
    outcomes: Outcomes = {}
    for path in sorted((RESULTS / "training").glob("*.parquet")):
        for row in pq.read_table(path).to_pylist():
            shift = "" if row["shift"] == NO_SHIFT else f" {row['shift']}"
            key = row["system"], row["condition"] + shift, row["family"], row["model_seed"]
            outcomes.setdefault(key, []).append(row["success"])
    return outcomes


def percent(
    trained: Outcomes,
    system: str,
    condition: str,
    family: str | None = None,
    seed: int | None = None,
) -> str:
    """Return the rate of successes as the page prints it; empty without rows."""
    chosen = [
        one
        for (name, under, of, weights), outcomes in trained.items()
        if (name, under) == (system, condition) and family in (None, of) and seed in (None, weights)
        for one in outcomes
    ]
    return f"{100 * sum(chosen) / len(chosen):.1f}" if chosen else ""


@pytest.mark.slow
@pytest.mark.parametrize(
    "first", ["system", "policy", "further conditions", "under shifts", "carried out"]
)
def test_rates_by_condition(trained: Outcomes, first: str) -> None:
    listed = table(TRAINING, first)
    assert listed
    for line in listed:
        system = line.pop(first).strip("`")
        line.pop("seeds", None)
        for condition, rate in line.items():
            assert rate == percent(trained, system, condition), (system, condition)


@pytest.mark.slow
def test_rates_by_training_seed(trained: Outcomes) -> None:
    for line in table(TRAINING, "by seed"):
        system, seed = line.pop("by seed").split()
        for condition, rate in line.items():
            found = percent(trained, system.strip("`"), condition, seed=int(seed))
            assert rate == found, (system, seed, condition)


@pytest.mark.parametrize("first", ["family", "acting in"])
def test_rates_by_family(trained: Outcomes, first: str) -> None:
    for line in table(TRAINING, first):
        family = line.pop(first)
        for title, rate in line.items():
            system, condition = title.split()
            assert rate == percent(trained, system.strip("`"), condition, family), (title, family)


@pytest.mark.parametrize(("first", "learner"), [("condition", "learned"), ("under", "acts")])
def test_what_training_with_interference_changes(
    trained: Outcomes, first: str, learner: str
) -> None:
    for line in table(TRAINING, first):
        with_, without = (
            float(percent(trained, f"{learner}-{mixture}", line[first]))
            for mixture in ("mixture", "k0")
        )
        assert float(line["mixture − k0"].split()[0].replace("−", "-")) == pytest.approx(
            with_ - without, abs=0.11
        )


def test_learned_systems_differ_in_a_quarter_of_the_episodes() -> None:
    """What `power` plans two learned systems with, and its help and how-to say."""
    flips = []
    for first, second in (
        ("acts-k0", "acts-mixture"),
        ("learned-k0", "learned-mixture"),
        ("learned-k0", "learned-gru-k0"),
    ):
        paths = (RESULTS / "training" / f"{name}.parquet" for name in (first, second))
        rows = compare(*paths).table.records()
        [at_k0] = [r for r in rows if (r["condition"], r["family"]) == ("k0", "all")]
        flips.append(round(100 * at_k0["flips"]))
    assert (min(flips), max(flips)) == (22, 28)
