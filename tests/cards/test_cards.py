"""Cards as files: golden ones, what the Hub's own libraries read of them, and that they load."""

import re
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import yaml
from support.buffer_sets import GOLDEN
from support.cards import CARDS, OF_BUFFER_SET, without_version
from support.tabletop import TABLETOP

from robomme_interference_data import load_buffer_set
from robomme_interference_data.cards.dataset_facts import STRIP, buffer_set_facts
from robomme_interference_data.cards.render import BIBTEX, PAPER, README, card_files, card_text
from robomme_interference_data.cards.tables import columns_of
from robomme_interference_data.constants import RECORDS_PATH
from robomme_interference_data.data.questions import Question
from robomme_interference_data.evaluate.run.row import Rollout
from robomme_interference_data.schema.codec import arrow_schema
from robomme_interference_data.schema.manifest import BufferManifest
from robomme_interference_data.schema.records import EpisodeRecord

NAMES = ("demonstrations", "buffer_set", "results")
ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("name", NAMES)
def test_golden_cards(made: dict[str, dict[str, bytes]], name: str) -> None:
    files = made[name]
    picture = "README-tabletop.png" if name == "results" else STRIP
    assert files.keys() == {README, picture}
    assert files[picture].startswith(b"\x89PNG\r\n\x1a\n")
    golden = (CARDS / f"{name}.md").read_text(encoding="utf-8")
    assert without_version(files[README]) == golden


def test_the_same_data_gives_the_same_bytes(made: dict[str, dict[str, bytes]]) -> None:
    again = card_files(buffer_set_facts(load_buffer_set(GOLDEN)), OF_BUFFER_SET)
    assert again == made["buffer_set"]
    assert again[STRIP] != made["demonstrations"][STRIP]


@pytest.mark.parametrize("name", NAMES)
def test_every_link_of_a_card_leads_somewhere(published: Path, name: str) -> None:
    text = (published / name / README).read_text(encoding="utf-8")
    links = re.findall(r"\]\(([^)]*)\)", text)
    assert PAPER in links
    for link in links:
        assert link == PAPER or (published / name / link).is_file()
    for path in re.findall(r"`((?:manifests|meta)/[\w./]+\.\w+)`", text):
        root = published / ("buffer_set" if path.startswith("manifests") else name)
        assert (root / path).is_file(), path


@pytest.mark.parametrize(
    ("tree", "name", "split", "file"),
    [
        ("buffer_set", "buffers", "test", "manifests/buffers.parquet"),
        ("demonstrations", "episodes", "test", RECORDS_PATH),
    ],
)
def test_load_dataset_gives_the_rows(
    published: Path, tmp_path: Path, tree: str, name: str, split: str, file: str
) -> None:
    from datasets import load_dataset

    root = published / tree
    found = load_dataset(str(root), name, split=split, cache_dir=str(tmp_path))
    assert found.to_list() == pq.read_table(root / file).to_pylist()


def test_load_dataset_gives_rollouts(published: Path, tmp_path: Path) -> None:
    from datasets import load_dataset

    found = load_dataset(str(published / "results"), cache_dir=str(tmp_path))
    assert found.keys() == {"test"}
    assert found["test"]["status"] == ["success", "timeout", "error"]


def test_the_citation_is_the_project_s() -> None:
    found = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    paper = found["preferred-citation"]
    [author] = paper["authors"]
    name = f"{author['family-names']}, {author['given-names']}"
    assert paper["url"] == PAPER
    [preprint] = paper["identifiers"]
    for part in (paper["title"], paper["url"], paper["year"], preprint["value"], name):
        assert f"{{{part}}}" in BIBTEX


@pytest.mark.parametrize("record", [BufferManifest, EpisodeRecord, Question, Rollout])
def test_every_column_is_described(record: type) -> None:
    columns = columns_of(record)
    names = {column.name for column in columns}
    assert names == {*arrow_schema(record).names} - {"feature_sha256"}
    for column in columns:
        for part in (column, *column.parts):
            assert part.meaning.endswith((".", "…")) and "`" not in part.meaning, part.name


@pytest.mark.parametrize(("buffer_set", "has_questions"), [(TABLETOP, True), (GOLDEN, False)])
def test_questions_are_a_table_of_their_own(buffer_set: Path, has_questions: bool) -> None:
    text = card_text(buffer_set_facts(load_buffer_set(buffer_set)), OF_BUFFER_SET)
    assert ("`questions.parquet`" in text) == has_questions
    assert ("config_name: questions" in text) == has_questions
