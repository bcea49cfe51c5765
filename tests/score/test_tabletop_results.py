"""What docs/results/tabletop.md states is what its rows say, of the versions that the code has."""

import json

import pyarrow.parquet as pq
import pytest
from support import scoring as made
from support.pages import RESULTS, table

from robomme_interference_data.constants import FAMILIES, PROTOCOL_VERSION
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.simulators.tabletop import SUITE_VERSION

PAGE = (RESULTS / "tabletop.md").read_text(encoding="utf-8")
FOLDER = RESULTS / "tabletop"
FILES = sorted(FOLDER.glob("*.parquet"))


@pytest.fixture(scope="module")
def score() -> Score:
    return made.score(*FILES)


def test_rows_are_of_the_current_versions() -> None:
    versions = json.loads((FOLDER / "versions.json").read_text(encoding="utf-8"))
    assert versions.keys() == {path.stem for path in FILES}
    for version in versions.values():
        assert version == {
            "protocol_version": PROTOCOL_VERSION,
            "suite_version": str(SUITE_VERSION),
        }
    for path in RESULTS.rglob("*.parquet"):
        rows = pq.read_table(path)
        if "protocol_version" in rows.column_names:
            assert set(rows["protocol_version"].to_pylist()) == {PROTOCOL_VERSION}, path


def test_ceilings_are_those_of_the_file() -> None:
    file = json.loads((FOLDER / "ceilings.json").read_text(encoding="utf-8"))
    assert file["suite_version"] == str(SUITE_VERSION)
    ceilings = {
        (row["memory"], row["part"], row["condition"]): f"{100 * row['success']:.1f}%"
        for row in file["ceilings"]
    }
    listed = table(PAGE, "condition | `framesamp`")
    assert len(listed) == 13
    for line in listed:
        condition = line.pop("condition").strip("`")
        for memory, rate in line.items():
            assert rate == ceilings[memory.strip("`"), "all", condition], (memory, condition)
        empty = condition in ("no-history", "absent-k7")
        assert ceilings["full", "all", condition] == ("18.3%" if empty else "100.0%")


def test_successes_are_those_of_the_rows(score: Score) -> None:
    cells = {(cell.system, cell.condition, cell.part): cell for cell in score.cells if cell.n}
    listed = table(PAGE, "family")
    for line in listed:
        family = line.pop("family")
        for title, text in line.items():
            system, condition = title.replace("`", "").split()
            cell = cells[system, condition, "" if family == "all" else family]
            if family != "all":
                assert (text, cell.n) == (str(cell.counts[0]), 10), (family, title)
                continue
            low, high = (round(100 * end) for end in cell.interval)
            assert text == f"{cell.counts[0]} of {cell.n}, {low} to {high}%", title
    assert [row["family"] for row in table(PAGE, "family")] == [*FAMILIES, "all"]


def test_effects_are_those_of_the_score(score: Score) -> None:
    told = {
        "sessions": "loses {:.1f} points ({:.1f} to {:.1f}; {} episodes gained, {} lost",
        "retrieval": "gains {:.1f} points at k7 ({:.1f} to {:.1f}; {} gained, {} lost",
    }
    effects = {row["effect"]: row for row in score.tables["effects"].records()}
    assert effects.keys() == told.keys()
    for name, sentence in told.items():
        row = effects[name]
        ends = [100 * row[column] for column in ("difference", "low", "high")]
        if name == "sessions":
            ends = [-ends[0], -ends[2], -ends[1]]
        assert sentence.format(*ends, row["gained"], row["lost"]) in PAGE
        assert f"corrected p = {row['p_holm']:.2g}" in PAGE
