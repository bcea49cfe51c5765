"""How fast rows are scored, against pandas computing the same tables.

Each way reads the rows, checks them, and writes the same rates, intervals, exact tests and
bootstrap intervals. With pandas the bootstrap is done twice: as one would write it down, a call of
scipy.stats.bootstrap for each statistic, and by hand, all statistics of a system from one set of
draws. pandas is no dependency of the package: install it for this.
"""

import argparse
import math
import sys
import tempfile
import warnings
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from operator import mul
from pathlib import Path
from typing import Any

import numpy as np
from common import interleave, positive, print_machine, print_table
from support import scoring as made
from support.full_grid import full_grid

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.evaluate.score.config import Settings
from robomme_interference_data.evaluate.score.scoring import score
from robomme_interference_data.stats.bootstrap import drawn_counts

CONDITIONS = ("no-history", "k0", "k1", "k3", "k7")
KS = (0, 1, 3, 7)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rounds", type=positive, default=3, help="repetitions of the full grid")
    parser.add_argument("--draws", type=positive, default=10_000, help="of each bootstrap")
    options = parser.parse_args()
    if not find_spec("pandas"):
        sys.exit("pandas is needed to compare with: pip install pandas")
    print_machine("pyarrow", "pandas", "numpy", "scipy")
    np.seterr(all="ignore")  # with pandas, some draws divide by a lift of 0
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory(prefix="interference-score-") as name:
        folder = Path(name)
        grid = made.changed(full_grid(), evidence_kept=None)  # pandas computes nothing of that
        rows = made.write_parquet(folder / "grid.parquet", grid)
        calls = {w: partial(c, rows, folder / "out", options.draws) for w, c in WAYS.items()}
        times = interleave(calls, options.rounds)
        lines = [
            [f"{len(grid):,}", way, f"{times.median(way):.2f}", f"{times.ratio(way, 'score'):.1f}"]
            for way in WAYS
        ]
        print_table(
            f"The full grid, all tables, {options.draws:,} bootstrap draws; medians of "
            f"{options.rounds} rounds.",
            [">rows", "<way", ">s", ">× score"],
            lines,
        )


def ours(rows: Path, out: Path, draws: int) -> None:
    """Score with the package, the draws made anew: it keeps them from one call to the next."""
    drawn_counts.cache_clear()
    out.mkdir(exist_ok=True)
    for name, found in score(Settings((rows,)), draws).tables.items():
        (out / f"{name}.csv").write_text(found.csv())
        (out / f"{name}.md").write_text(found.markdown())


Interval = tuple[float, float, float]
Compute = Callable[..., Any]


def with_scipy(values: Any, draws: int, columns: tuple[int, ...], compute: Compute) -> Interval:
    """Return a statistic of means with its BCa interval."""
    from scipy.stats import bootstrap

    chosen = tuple(values[:, column] for column in columns)
    found = bootstrap(
        chosen,
        lambda *samples, axis: compute(*(sample.mean(axis=axis) for sample in samples)),
        n_resamples=draws,
        paired=True,
        vectorized=True,
        method="BCa",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return float(compute(*(c.mean() for c in chosen))), float(found.low), float(found.high)


class ByHand:
    """The same, called in the same way, from draws that all statistics of a system share."""

    def __init__(self) -> None:
        self._means: tuple[Any, Any, Any] | None = None
        self._values: Any = None

    def __call__(
        self, values: Any, draws: int, columns: tuple[int, ...], compute: Compute
    ) -> Interval:
        """Return a statistic of means with its BCa interval."""
        from scipy.stats import norm

        if self._means is None or self._values is not values:
            count = len(values)
            picked = np.random.default_rng(0).integers(0, count, (draws, count))
            self._values = values
            self._means = (
                values.mean(axis=0),
                np.stack([column[picked].mean(axis=1) for column in values.T], axis=1),
                (values.sum(axis=0) - values) / (count - 1),
            )
        value, drawn, left = (compute(*m.T[list(columns)]) for m in self._means)
        bias = norm.ppf(((drawn < value).mean() + (drawn <= value).mean()) / 2)
        shift = left.mean() - left
        skew = (shift**3).sum() / (6 * (shift**2).sum() ** 1.5)
        zs = bias + norm.ppf([0.025, 0.975])
        low, high = np.quantile(drawn, norm.cdf(bias + zs / (1 - skew * zs)))
        return float(value), float(low), float(high)


def with_pandas(rows: Path, out: Path, draws: int, *, scipy: bool) -> None:
    """Score with pandas."""
    import pandas as pd
    from scipy.stats import binomtest, norm

    bca = with_scipy if scipy else ByHand()
    out.mkdir(exist_ok=True)
    frame = pd.read_parquet(
        rows,
        columns=[
            *("system", "simulator", "revision", "family", "condition", "split"),
            *("episode", "model_seed", "seed", "difficulty", "status", "success", "steps"),
        ],
    )
    key = ["simulator", "system", "condition", "family", "split", "episode", "model_seed"]
    assert not frame.duplicated(key).any()
    assert frame["family"].isin(FAMILIES).all() and frame["condition"].isin(CONDITIONS).all()
    assert frame["status"].isin(["success", "fail", "timeout", "error"]).all()
    assert (frame["success"] == (frame["status"] == "success")).all()
    assert frame.groupby("simulator")["revision"].nunique().max() == 1
    assert frame["steps"].between(0, 1300).all()
    scenes = frame.groupby(["simulator", "family", "split", "episode"])
    assert scenes[["seed", "difficulty"]].nunique().max().max() == 1

    episode = ["system", "condition", "family", "difficulty", "episode"]
    means = frame.groupby(episode)["success"].mean().reset_index()
    for name, by in (("main", []), ("family", ["family"]), ("difficulty", ["difficulty"])):
        cells = means.groupby(["system", "condition", *by])["success"].agg(["mean", "count"])
        z, p, n = norm.ppf(0.975), cells["mean"], cells["count"]
        middle, half = p + z * z / (2 * n), z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
        cells["low"] = (middle - half) / (1 + z * z / n)
        cells["high"] = (middle + half) / (1 + z * z / n)
        cells.to_csv(out / f"{name}.csv")
    coverage = frame.groupby(["system", "condition", "family", "status"]).size()
    coverage.unstack(fill_value=0).to_csv(out / "coverage.csv")

    first = frame[frame["model_seed"] == frame["model_seed"].min()]
    x = np.log2(np.array(KS) + 1)
    weights = (x - x.mean()) / ((x - x.mean()) ** 2).sum()
    records = []
    for system, group in means.groupby("system"):
        if group["condition"].nunique() < len(CONDITIONS):
            continue  # π0.5 has nothing to compare
        wide = group.pivot_table(index=["family", "episode"], columns="condition", values="success")
        once = first[first["system"] == system].pivot_table(
            index=["family", "episode"], columns="condition", values="success"
        )
        values = wide[list(CONDITIONS)].to_numpy()
        pairs = [(k, 0) for k in range(1, 5)] + [(k, 1) for k in range(2, 5)]
        for here, there in pairs:
            a, b = once[CONDITIONS[here]] > 0, once[CONDITIONS[there]] > 0
            gained, lost = int((a & ~b).sum()), int((~a & b).sum())
            p = binomtest(gained, gained + lost).pvalue if gained + lost else 1.0
            interval = bca(values, draws, (here, there), lambda one, other: one - other)
            records.append((system, CONDITIONS[here], CONDITIONS[there], *interval, p))
        for k in range(2, 5):
            interval = bca(values, draws, (0, 1, k), lambda n, s, e: (e - n) / (s - n))
            records.append((system, CONDITIONS[k], "retention", *interval, math.nan))
        interval = bca(values, draws, (1, 2, 3, 4), lambda *rates: sum(map(mul, weights, rates)))
        records.append((system, "", "slope", *interval, math.nan))
    columns = ["system", "condition", "against", "value", "low", "high", "p"]
    effects = pd.DataFrame(records, columns=columns)
    ordered = effects["p"].dropna().sort_values()
    effects["p_holm"] = (
        (ordered * np.arange(len(ordered), 0, -1)).clip(upper=1).cummax().reindex(effects.index)
    )
    effects.to_csv(out / "effects.csv", index=False)


SCIPY = "pandas, scipy.stats.bootstrap"
WAYS: dict[str, Callable[[Path, Path, int], None]] = {
    "score": ours,
    "pandas, draws shared by hand": partial(with_pandas, scipy=False),
    SCIPY: partial(with_pandas, scipy=True),
}


if __name__ == "__main__":
    main()
