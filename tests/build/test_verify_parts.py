"""`verify` of what is not yet, or not only, a buffer set: datasets without manifests."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from support.buffer_sets import build, plan_again, violations
from support.tabletop import PROVENANCE, Drawn

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.sources.sample import SampleSource
from robomme_interference_data.cards.dataset_facts import buffer_set_facts
from robomme_interference_data.cards.publication import Publication
from robomme_interference_data.cards.render import card_text
from robomme_interference_data.data.loading import next_build


@pytest.mark.parametrize(
    ("gone", "following"),
    [
        (("manifests",), "--only manifests"),
        (("manifests", "distractors"), "--only distractors --source KIND:PATH"),
        (("manifests", "demonstrations"), "--only demonstrations --source KIND:PATH"),
    ],
)
def test_what_is_there_is_verified(
    gone: tuple[str, ...], following: str, own_buffers: Path, run: Any
) -> None:
    for name in gone:
        shutil.rmtree(own_buffers / name)
    code, out, err = run("verify", own_buffers, "--json")
    error = json.loads(err.splitlines()[-1])
    assert (code, json.loads(out)) == (1, {"violations": []})
    assert error["type"] == "MissingFileError"
    assert error["command"] == f"robomme-interference build {own_buffers} {following}"
    kept = "demonstrations" if "distractors" in gone else "distractors"
    path = next((own_buffers / kept).glob("data/*/*.parquet"))
    path.write_bytes(path.read_bytes()[:-1])
    code, out, _ = run("verify", own_buffers, "--no-decode", "--json")
    found = {violation["where"] for violation in json.loads(out)["violations"]}
    assert code == 1 and str(path.relative_to(own_buffers)) in found


def test_damaged_metadata_and_files_of_nobody(own_buffers: Path, run: Any) -> None:
    shutil.rmtree(own_buffers / "manifests")
    (own_buffers / "notes.txt").write_text("mine")
    (own_buffers / "distractors/meta/interference.json").write_text("{}")
    code, out, _ = run("verify", own_buffers, "--no-decode", "--json")
    found = {violation["where"] for violation in json.loads(out)["violations"]}
    assert code == 1 and found == {"notes.txt", "distractors"}


def test_a_dataset_without_buffers_is_one_violation(own_buffers: Path, run: Any) -> None:
    source = SampleSource(size=32)
    build(own_buffers, "executions", source, families=("MoveCube",), split="test", numbers=(0,))
    code, out, _ = run("verify", own_buffers, "--no-decode", "--json")
    [violation] = json.loads(out)["violations"]
    assert code == 1 and violation["where"] == "executions"
    assert f"build {own_buffers} --only manifests" in violation["what"]
    assert run("build", own_buffers, "--only", "manifests")[0] == 0
    assert run("verify", own_buffers, "--no-decode")[0] == 0


def test_a_planned_set_is_planned_again_wherever_its_demonstrations_are(own_buffers: Path) -> None:
    shutil.rmtree(own_buffers / "demonstrations")
    assert next_build(own_buffers) == f"build {own_buffers} --only manifests"


def test_lessons_and_units_from_different_renderers_are_a_warning(tmp_path: Path, run: Any) -> None:
    lessons, units = PROVENANCE, PROVENANCE | {"renderer": "a GPU"}
    build(tmp_path, "demonstrations", Drawn(lessons), split="test", families=("MoveCube",))
    build(tmp_path, "distractors", Drawn(units), split="train", families=("InsertPeg",))
    plan_again(tmp_path, ("k0", "k1"))
    differ = f"demonstrations from {PROVENANCE['renderer']}; distractors from a GPU."
    code, out, _ = run("verify", tmp_path, "--no-decode", "--json")
    report = json.loads(out)
    assert (code, report["violations"]) == (0, [])
    assert [differ in warning for warning in report["warnings"]] == [True]
    code, _, err = run("verify", tmp_path, "--no-decode")
    assert code == 0 and "Warning: Images come from different renderers" in err
    card = card_text(buffer_set_facts(load_buffer_set(tmp_path)), Publication("a/b", "1.0.0"))
    for row in (
        f"| renderer of the demonstrations | `{PROVENANCE['renderer']}` |",
        "| renderer of the distractors | `a GPU` |",
        f"- Images come from different renderers: {differ}",
        '"sapien": "3.0.3"',
    ):
        assert row in card


def test_extended_demonstrations_need_new_manifests(own_buffers: Path) -> None:
    """One line with the command, not one for each buffer that is planned in another way."""
    build(own_buffers, "demonstrations", SampleSource(size=32), families=("InsertPeg",))
    command = f"robomme-interference build {own_buffers} --only manifests"
    expected = f"demonstrations: changed after the buffers were planned: run {command}"
    assert violations(own_buffers, decode=False) == [expected]
    plan_again(own_buffers)
    assert violations(own_buffers, decode=False) == []
