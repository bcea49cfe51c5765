"""Cards follow from the data: exactness, protocol and limits; untrusted text stays text."""

import json
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest
from support import scoring
from support.buffer_sets import plan_again
from support.cards import OF_BUFFER_SET, OF_DEMONSTRATIONS, OF_RESULTS, RUN
from support.made_up import SHAPES, record, write_metadata
from support.messages import raises

from robomme_interference_data import load_buffer_set
from robomme_interference_data.cards.dataset_facts import (
    buffer_set_facts,
    count_same_family,
    demonstrations_facts,
)
from robomme_interference_data.cards.publication import Publication
from robomme_interference_data.cards.render import card_files, card_text
from robomme_interference_data.cards.results import results_facts
from robomme_interference_data.constants import IDENTITY_PATH, RECORDS_PATH, REPORT_PATH, SUMS_PATH
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.errors import FormatError, InvalidOptionError
from robomme_interference_data.evaluate.score.config import Settings
from robomme_interference_data.evaluate.score.scoring import Score, score
from robomme_interference_data.schema.manifest import BufferManifest
from robomme_interference_data.storage.files import format_sums, write_json
from robomme_interference_data.storage.text import read_json

COMMIT = "0123456789" * 4


def made_up(
    root: Path,
    *,
    query: dict[str, Any] | None = None,
    unit: dict[str, Any] | None = None,
    identity: dict[str, Any] | None = None,
    report: dict[str, Any] | None = None,
    unit_values: int = 8,
    **options: Any,
) -> BufferSet:
    """A buffer set of metadata alone: one query, and two units of each of three families."""
    asked = [record("demonstrations", "MoveCube/test/0", **(query or {}))]
    pool = [
        record("distractors", f"{family}/train/{number}", **(unit or {}))
        for family in ("MoveCube", "InsertPeg", "PatternLock")
        for number in range(2)
    ]
    for kind, records in (("demonstrations", asked), ("distractors", pool)):
        values = unit_values if kind == "distractors" else 8
        write_metadata(root / kind, kind, records, SHAPES | {"observation.state": (values,)})
        sums = format_sums(root / kind, [RECORDS_PATH])
        (root / kind / SUMS_PATH).write_text(sums)
        path, digest = root / kind / IDENTITY_PATH, sha256(sums.encode()).hexdigest()
        write_json(path, {**read_json(path), **(identity or {}), "sums": digest})
        write_json(root / kind / REPORT_PATH, {"skipped": [], **(report or {})})
    plan_again(root, **{"conditions": ("no-history", "k0", "k1", "k3"), **options})
    return load_buffer_set(root)


def buffer_set_text(buffer_set: BufferSet, about: Publication) -> str:
    return card_text(buffer_set_facts(buffer_set), about)


def demonstrations_text(buffer_set: BufferSet) -> str:
    return card_text(demonstrations_facts(buffer_set.datasets["demonstrations"]), OF_DEMONSTRATIONS)


def results_text(results: Score | Path, about: Publication) -> str:
    return card_text(results_facts(results), about)


@pytest.mark.parametrize(("part", "inexact"), [("query", 4), ("unit", 2)])
def test_lossy_data_is_called_so(tmp_path: Path, part: str, inexact: int) -> None:
    buffer_set = made_up(tmp_path, **{part: {"exact": False}})  # no-history and k0 hold no unit
    text = buffer_set_text(buffer_set, OF_BUFFER_SET)
    assert "**Exact.**" not in text
    assert f"**Lossy.** {inexact} of 4 buffers" in text
    demonstrations = demonstrations_text(buffer_set)
    assert ("**Lossy.** 1 of 1 episodes" in demonstrations) == (part == "query")


def test_the_pace_is_that_of_the_recordings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Dataset, "fps", 12.5)
    assert "frames at 12.5 frames per second" in demonstrations_text(made_up(tmp_path))


def test_the_lossy_copy_of_the_recordings_is_named(tmp_path: Path) -> None:
    source = {"kind": "lerobot", "repo": "lerobot/robomme", "revision": COMMIT}
    buffer_set = made_up(tmp_path, query={"exact": False}, identity={"sources": [source]})
    text = buffer_set_text(buffer_set, Publication("people/tiny", "1.0.0"))
    assert "It was built from `lerobot/robomme`, a copy of RoboMME" in text
    assert f"`lerobot/robomme@{COMMIT}`" in text
    assert "source_datasets:\n- lerobot/robomme\n" in text


def test_what_was_changed_of_recordings_is_a_limit(tmp_path: Path) -> None:
    source = {"kind": "lerobot", "resize": "6x4:pad"}
    resized = made_up(tmp_path / "resized", identity={"sources": [source]})
    assert "frames of the distractors are resized: 6x4:pad" in buffer_set_text(
        resized, OF_BUFFER_SET
    )
    assert "frames of the demonstrations are resized: 6x4:pad" in demonstrations_text(resized)
    wider = buffer_set_text(made_up(tmp_path / "wider", unit_values=14), OF_BUFFER_SET)
    assert "states of the distractors have 14 values, those of the lessons 8" in wider
    assert "resized:" not in wider


HOSTILE = (
    "{{ about }} | `x` <script>alert(1)</script>\n\n---\n# A title [a](http://b.c) " + "y" * 999
)


def test_hostile_goals_are_text(tmp_path: Path) -> None:
    buffer_set = made_up(tmp_path, query={"goals": (HOSTILE,), "difficulty": HOSTILE})
    for text in (buffer_set_text(buffer_set, OF_BUFFER_SET), demonstrations_text(buffer_set)):
        assert "{{ about }} &#124; \\`x\\` &lt;script&gt;" in text
        assert "<script" not in text
        assert "http://b.c" not in text
        assert "# A title [a]" not in text
        assert "y" * 400 not in text
        assert text.count("\n---\n") == 1  # the end of the front matter


@pytest.mark.parametrize(
    "source",
    [
        {"kind": "```\n# x", "repo": "../../x", "revision": "main"},
        {"repo": "a/b", "revision": "javascript:x"},
    ],
)
def test_hostile_sources_are_text(tmp_path: Path, source: dict[str, Any]) -> None:
    text = buffer_set_text(made_up(tmp_path, identity={"sources": [source]}), OF_BUFFER_SET)
    assert "\n# x" not in text
    front = text.split("---\n")[1]
    assert "../" not in front
    assert ("- a/b\n" in front) == (source["repo"] == "a/b")
    assert "`a/b@" not in text


def test_a_buffer_set_of_the_own_family_is_labelled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    buffer_set = made_up(tmp_path, conditions=("k0", "k1"))
    [k0, k1] = buffer_set.manifests()
    lesson, unit = k1.sessions
    own = replace(unit, family="MoveCube", source=lesson.source)
    other = BufferManifest(**{**vars(k1), "sessions": (lesson, own)})
    assert (count_same_family([k0, k1]), count_same_family([k0, other])) == (0, 1)
    assert "own family" not in buffer_set_text(buffer_set, OF_BUFFER_SET)
    monkeypatch.setattr(buffer_set, "manifests", lambda: [k0, other])
    text = buffer_set_text(buffer_set, OF_BUFFER_SET)
    assert "**Not the paper's protocol: 1 of 2 buffers hold" in text
    assert any("own family" in one for one in buffer_set_facts(buffer_set).limits)


def test_conditions_and_limits_beyond_the_paper(tmp_path: Path) -> None:
    buffer_set = made_up(tmp_path, conditions=("k0", "k2"), position_limit=None, seed=3)
    text = buffer_set_text(buffer_set, OF_BUFFER_SET)
    assert "- Beyond the paper's conditions, `k2`: lesson, n units." in text
    assert "no length limit" in text
    assert "seed 3" in text
    assert "| k0 | paper |" in text
    assert "| k2 | extension |" in text


@pytest.mark.parametrize(
    ("query", "unit", "simulated"),
    [
        (None, None, False),
        (None, "tabletop", False),
        ("mine", "robomme", True),
        ("tabletop", "robomme", True),
    ],
)
def test_nothing_unknown_is_asserted(
    tmp_path: Path, query: Any, unit: Any, simulated: bool
) -> None:
    lesson = {"simulator": query, "difficulty": "easy"}
    buffer_set = made_up(tmp_path, query=lesson, unit={"simulator": unit})
    facts = buffer_set_facts(buffer_set)
    text = card_text(facts, OF_BUFFER_SET)
    assert ("The simulator defines the difficulty" in text) == simulated
    tags = text.split("---\n")[1].splitlines()
    assert ("- RoboMME" in tags) == ("robomme" in (query, unit))


def test_the_base_comes_from_the_manifests(tmp_path: Path) -> None:
    buffer_set = made_up(tmp_path)
    header = buffer_set.header
    place = f"people/demonstrations@{COMMIT}"
    placed = replace(header.datasets["demonstrations"], location=place)
    buffer_set.header = replace(header, datasets={**header.datasets, "demonstrations": placed})
    assert f"| published demonstrations | `{place}` |" in buffer_set_text(
        buffer_set, Publication("people/tiny", "1.0.0")
    )
    assert "| published demonstrations | none |" not in buffer_set_text(buffer_set, OF_BUFFER_SET)
    buffer_set.header = header
    assert "| published demonstrations | none |" in buffer_set_text(
        buffer_set, Publication("people/tiny", "1.0.0")
    )


def test_a_buffer_set_without_buffers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    buffer_set = made_up(tmp_path)
    monkeypatch.setattr(buffer_set, "manifests", list)
    with raises(FormatError):
        buffer_set_facts(buffer_set)


def test_results_are_those_of_the_score(made: dict[str, dict[str, bytes]]) -> None:
    found = score(Settings(rows=(RUN,)))
    assert card_files(results_facts(found), OF_RESULTS) == made["results"]


def test_results_of_several_runs_are_an_error(tmp_path: Path) -> None:
    copy = tmp_path / "rollouts.jsonl"
    copy.write_bytes((RUN / "rollouts.jsonl").read_bytes().replace(b"replay-full", b"my-memory"))
    found = score(Settings(rows=(RUN, copy)))
    with raises(InvalidOptionError):
        results_text(found, OF_RESULTS)


def test_results_of_rows_without_a_run(tmp_path: Path) -> None:
    (tmp_path / "rows.jsonl").write_bytes((RUN / "rollouts.jsonl").read_bytes())
    text = results_text(tmp_path / "rows.jsonl", Publication("people/rows", "1.0.0"))
    assert "path: rows.jsonl" in text
    assert "The run is" not in text


def test_results_name_the_buffer_set_that_the_run_names(tmp_path: Path) -> None:
    place = f"people/tiny@{COMMIT}"
    (tmp_path / "rollouts.jsonl").write_bytes((RUN / "rollouts.jsonl").read_bytes())
    header = json.loads((RUN / "run.json").read_text())
    header["invocations"][0]["settings"]["buffer_set"] = place
    header["identity"]["policy"] = "a | `b`"
    write_json(tmp_path / "run.json", header)
    text = results_text(tmp_path, Publication("people/results", "1.0.0"))
    assert f"| published buffer set | `{place}` |" in text
    assert "source_datasets:\n- people/tiny\n" in text
    assert "| policy | <code>a &#124; &#96;b&#96;</code> |" in text


def test_results_of_an_offline_run(tmp_path: Path) -> None:
    """Two recordings of a policy of an arm; the second one broke under k0."""
    errors = {("no-history", 0): 0.5, ("no-history", 1): 0.25, ("k0", 0): 0.125, ("k0", 1): None}
    rows = [
        scoring.recording(condition, number, None if error is None else (error,))
        for (condition, number), error in errors.items()
    ]
    facts = results_facts(scoring.write_parquet(tmp_path / "rollouts.parquet", rows))
    assert (facts.simulators, facts.simulated) == (("recordings",), False)
    files = card_files(facts, Publication("people/results", "1.0.0"))
    assert files["README-recordings.png"].startswith(b"\x89PNG")
    text = files["README.md"].decode()
    assert "| my-memory | 0.3750 n=2 | 0.1250† n=1, errors: 1 |" in text
    assert "1 error, 3 measured" in text and "recordings, played back" in text
    assert "success rate" not in text.partition("## Limits")[0].lower()
