"""What the how-to states about encoders is what the rows say."""

import csv
from pathlib import Path

from support.pages import RESULTS

from robomme_interference_data.schema.shifts import NO_SHIFT, SHIFTS

PAGE = Path(__file__).parents[2] / "docs/how-to/retrieval.md"


def test_numbers_of_encoders_are_those_of_the_rows() -> None:
    with (RESULTS / "tabletop/encoders.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {(row["condition"], row["queries"]) for row in rows} == {("k7", "18")}
    found = {(row["encoder"], row["shift"]): int(row["found"]) for row in rows}
    encoders, shifts = ("thumbnail", "efficientnet"), [str(shift) for shift in SHIFTS]
    assert found.keys() == {(name, shift) for name in encoders for shift in [NO_SHIFT, *shifts]}
    every = [sum(found[name, shift] for shift in shifts) for name in encoders]
    camera, light = ([found[name, shift] for name in encoders] for shift in ("camera:3", "light:3"))
    text = PAGE.read_text(encoding="utf-8")
    assert f"in {every[0]} of {18 * len(shifts)} views with `thumbnail`, and in {every[1]}" in text
    assert f"{camera[0]} and {camera[1]} of 18, at `light:3` {light[0]} and {light[1]}" in text
