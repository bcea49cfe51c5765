"""`croissant.json`: what the reference library reads of it, and what dataset tracks ask for."""

import json
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from support.buffer_sets import GOLDEN
from support.cards import OF_BUFFER_SET
from support.tabletop import TABLETOP

from robomme_interference_data import load_buffer_set
from robomme_interference_data.cards.dataset_facts import buffer_set_facts
from robomme_interference_data.cards.render import CROISSANT, card_text, croissant
from robomme_interference_data.cards.tables import columns_of
from robomme_interference_data.constants import RECORDS_PATH
from robomme_interference_data.data.questions import Question
from robomme_interference_data.evaluate.run.row import Rollout
from robomme_interference_data.schema.codec import arrow_schema
from robomme_interference_data.schema.manifest import BufferManifest
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.storage.files import sha256_file

NAMES = ("demonstrations", "buffer_set", "results")


@pytest.mark.parametrize("name", NAMES)
def test_files_and_their_hashes(published: Path, name: str) -> None:
    found = json.loads((published / name / CROISSANT).read_text(encoding="utf-8"))
    files = {one["@id"]: one for one in found["distribution"] if one["@type"] == "cr:FileObject"}
    files.pop("repository")
    assert files
    for path, one in files.items():
        assert sha256_file(published / name / path) == one["sha256"]
        assert one["contentUrl"].endswith(f"/{path}")
    for one in found["distribution"]:
        if one["@type"] == "cr:FileSet":
            assert [*(published / name).glob(one["includes"])], one["@id"]


def read(path: Path, mapping: dict[str, Path] | None = None) -> Any:
    import mlcroissant

    given = {name: str(path) for name, path in (mapping or {}).items()}
    return mlcroissant.Dataset(jsonld=json.loads(path.read_text("utf-8")), mapping=given)


@pytest.mark.parametrize("name", NAMES)
def test_the_reference_library_finds_no_fault(published: Path, name: str) -> None:
    dataset = read(published / name / CROISSANT)
    issues = dataset.metadata.ctx.issues
    assert not issues.errors
    assert all("datePublished" in warning for warning in issues.warnings)  # cards have no clock
    assert dataset.metadata.version in ("1.0.0", "1.2.0", "1.0.1")
    assert dataset.metadata.to_json()["name"] == f"tiny-{name}"


def test_the_reference_library_reads_the_rows(published: Path) -> None:
    root = published / "buffer_set"
    files = {path: root / path for path in ("manifests/buffers.parquet", RECORDS_PATH)}
    dataset = read(root / CROISSANT, files)
    table = pq.read_table(root / "manifests" / "buffers.parquet")
    rows = list(dataset.records("buffers"))
    assert len(rows) == len(table)
    conditions = [row["buffers/condition"].decode() for row in rows]
    assert conditions == table["condition"].to_pylist()
    episodes = [row["episodes/episode_id"].decode() for row in dataset.records("episodes")]
    assert episodes == pq.read_table(root / RECORDS_PATH)["episode_id"].to_pylist()


@pytest.mark.parametrize("record", [BufferManifest, EpisodeRecord, Question, Rollout])
def test_every_column_is_described(record: type) -> None:
    columns = columns_of(record)
    assert {one.name for one in columns} == {*arrow_schema(record).names} - {"feature_sha256"}
    for column in (part for one in columns for part in (one, *one.parts)):
        assert column.meaning.endswith((".", "…")) and "`" not in column.meaning, column.name


@pytest.mark.parametrize(("buffer_set", "has_questions"), [(TABLETOP, True), (GOLDEN, False)])
def test_questions_are_a_table_of_their_own(buffer_set: Path, has_questions: bool) -> None:
    facts = buffer_set_facts(load_buffer_set(buffer_set))
    sets = {one["name"]: one for one in json.loads(croissant(facts, OF_BUFFER_SET))["recordSet"]}
    text = card_text(facts, OF_BUFFER_SET)
    assert ("`questions.parquet`" in text) == ("questions" in sets) == has_questions
    assert ("config_name: questions" in text) == has_questions
    if has_questions:
        types = {one["name"]: one["dataType"] for one in sets["questions"]["field"]}
        assert (types["picture"], types["text"]) == ("sc:ImageObject", "sc:Text")
