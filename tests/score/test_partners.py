"""Systems are paired by their facts: a label is only a label."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support import scoring as made

from robomme_interference_data.errors import FormatError
from robomme_interference_data.evaluate.score.partners import base_of, ceilings_of, control_of
from robomme_interference_data.evaluate.score.rows.reading import read_rows
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.systems import SystemFacts, name_system
from robomme_interference_data.schema.codec import to_dict

CELLS = {
    ("replay-framesamp", "k0"): "sssssf",
    ("replay-framesamp", "k7"): "ssffff",
    ("replay-window", "k7"): "sfffff",
    ("retrieval-replay-framesamp", "k0"): "sssssf",
    ("retrieval-replay-framesamp", "k7"): "ssssff",
    ("recall-framesamp", "k0"): "ssssss",
    ("recall-framesamp", "k7"): "ssssff",
    ("retrieval-recall-framesamp", "k7"): "sssssf",
    ("oracle", "k0"): "sssssf",
}


def rows() -> list[Any]:
    return made.changed(made.cells(CELLS), evidence_kept=1.0)


def scored(folder: Path, given: list[Any]) -> Score:
    return made.score(made.write_parquet(folder / "rows.parquet", given))


def partners(found: Score) -> dict[str, Any]:
    (outcomes,) = found.outcomes.values()
    return {
        name: (
            base_of(outcomes, name),
            ceilings_of(outcomes, name)[:1],
            control_of(outcomes, name),
            outcomes.is_reference(name),
        )
        for name in outcomes.systems
    }


def test_a_retrieval_step_has_its_base_its_ceiling_and_its_control(tmp_path: Path) -> None:
    found = partners(scored(tmp_path, rows()))
    step = "retrieval-replay-framesamp"
    assert found[step] == ("replay-framesamp", ["retrieval-recall-framesamp"], "oracle", False)
    assert found["replay-framesamp"] == (None, ["recall-framesamp"], "oracle", False)
    assert found["replay-window"] == (None, [], "oracle", False)  # nobody observed its memory
    assert found["recall-framesamp"][1:] == ([], "oracle", True)
    assert found["retrieval-recall-framesamp"][0] == "recall-framesamp"


def test_other_labels_give_the_same_pairs_and_figures(tmp_path: Path) -> None:
    names = [*dict.fromkeys(system for system, _ in CELLS)]
    # In the same alphabetical order as in the order of tables, which is that of known names.
    scores = [scored(tmp_path, rows())]
    order = scores[0].outcomes["tabletop"].systems
    labels = {name: f"label-{order.index(name)}" for name in names}
    scores.append(scored(tmp_path, made.renamed(rows(), labels)))

    def content(found: Score, names: dict[str, str]) -> Any:
        return {
            name: [tuple(names.get(str(cell), cell) for cell in row) for row in table.rows]
            for name, table in found.tables.items()
        }

    shown = [repr(content(found, labels)) for found in scores]  # NaN equals itself in text
    assert shown[0] == shown[1]
    assert {"effects", "evidence_use"} <= {*scores[0].tables}
    assert made.records(scores[0], "effects", effect="ideal observer")


def test_runs_of_several_weights_are_one_system(tmp_path: Path) -> None:
    facts = SystemFacts(policy="python", memory="window:32")
    step = replace(facts, retrieval="thumbnail/max/adaptive")
    given = []
    for seed in (0, 1):
        for name, of in (("a", facts), ("b", step)):
            columns = to_dict(replace(of, policy_id=f"weights {seed}"))
            given += made.changed(made.cells({(name, "k7"): "sf"}, seed), **columns)
    assert partners(scored(tmp_path, given))["b"][0] == "a"
    unknown = made.changed(given, policy_id=None)
    assert partners(scored(tmp_path, unknown))["b"][0] is None


def test_one_label_has_one_set_of_facts(tmp_path: Path) -> None:
    given = made.cells({("a", "k7"): "sss"})
    given[1] = replace(given[1], memory="full")
    path = made.write_parquet(tmp_path / "rows.parquet", given)
    with pytest.raises(FormatError) as error:
        read_rows([path])
    assert "memory 'full' beside None" in str(error.value)
    assert len(read_rows([path], lenient=True)) == 2


def test_rows_with_a_name_alone_get_the_facts_of_the_table(tmp_path: Path) -> None:
    lines = [f"{name},MoveCube,k0,0,7,easy,success,1,100" for name in (made.BASE, made.OWN)]
    path = made.released(tmp_path / "a.csv", lines)
    (outcomes,) = made.score(path).outcomes.values()
    assert outcomes.facts_of(made.BASE) == {name_system(made.BASE).facts}
    assert outcomes.facts_of(made.OWN) == {SystemFacts()}
