"""Entries of a leaderboard: the command that adds one, and the file that lists them."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from support import boards
from support.boards import BOARD, SYSTEM, Files
from support.hub_server import HubServer
from support.messages import raises
from support.scoring import ROOT

from robomme_interference_data.errors import FormatError, InvalidOptionError
from robomme_interference_data.evaluate.leaderboard.entries import (
    PublishedRun,
    Submission,
    add_submission,
    read_entries,
)

Run = Callable[..., tuple[int, str, str]]
REPOSITORY = "someone/results"


def test_submit(published_run: Files, hub: HubServer, tmp_path: Path, run: Run) -> None:
    commit = hub.push(f"datasets/{REPOSITORY}", published_run, "data-1.0.0")
    path = boards.write_board(tmp_path / "results.yaml")
    before = path.read_text(encoding="utf-8")
    (tmp_path / "policy.py").write_text("pass\n")
    words = ["submit", path, "--results", f"{REPOSITORY}@data-1.0.0", "--memory", "frames"]
    code, _, err = run(*words)
    assert code == 1
    for option in ("--checkpoint", "--weights", "--trained-on"):
        assert option in err
    words += ["--checkpoint", "someone/model", "--weights", tmp_path / "policy.py"]
    words += ["--trained-on", "nothing"]
    code, _, err = run(*words, "--check")
    assert code == 0 and path.read_text(encoding="utf-8") == before, err
    code, _, err = run(*words)
    assert code == 0, err
    [added] = yaml.safe_load(path.read_text(encoding="utf-8"))["submissions"]
    assert (added["system"], added["board"]) == (SYSTEM, BOARD)
    assert added["runs"][0]["results"] == f"{REPOSITORY}@{commit}"
    assert len(added["runs"][0]["checkpoint_sha256"]) == 64
    assert run("submit", path, "--check")[0] == 0
    # The same name a second time.
    after = path.read_text(encoding="utf-8")
    assert run(*words)[0] == 1 and path.read_text(encoding="utf-8") == after
    assert run("submit", path)[0] == 1


ENTRY = Submission(
    system="mine",
    board=BOARD,
    memory="none",
    trained_on="other",
    runs=(PublishedRun("a/b@" + "0" * 40, "weights", "ab" * 32),),
    contact="me: @example",
)


@pytest.mark.parametrize("end", ["submissions:\n", "submissions: []\n", "submissions: [] ", ""])
def test_an_entry_is_added_at_the_end(tmp_path: Path, end: str) -> None:
    path = tmp_path / "results.yaml"
    head = f"# Kept.\nboards:\n- name: {BOARD}  # as it is\n  simulator: tabletop\n"
    path.write_text(head + end)
    for number in range(1, 3):
        add_submission(path, ENTRY)
        assert read_entries(path).submissions == (ENTRY,) * number
        assert path.read_text().startswith(head)


def test_an_entry_is_not_added_in_the_middle(tmp_path: Path) -> None:
    path = tmp_path / "results.yaml"
    text = f"submissions: []\nboards:\n- name: {BOARD}\n  simulator: tabletop\n"
    path.write_text(text)
    with raises(InvalidOptionError):
        add_submission(path, ENTRY)
    assert path.read_text() == text


OWN_BOARD = "boards:\n- {name: a, simulator: b}\n"
WRONG_FIELDS = (
    "boards: 3",
    "boards:\n- name: a",
    "boards:\n- name: a\n  simulator: b\n  more: c",
    f"{OWN_BOARD}references:\n- {{board: a, rows: [b], standing: submission}}",
    f"{OWN_BOARD}other: 1",
)


def test_the_json_schema() -> None:
    schema = json.loads(boards.SCHEMA.read_text(encoding="utf-8"))
    assert schema == boards.json_schema()
    jsonschema = pytest.importorskip("jsonschema")
    check = jsonschema.Draft202012Validator(schema)
    whole = yaml.safe_load((ROOT / "docs" / "leaderboard" / "results.yaml").read_text("utf-8"))
    assert check.is_valid(whole)
    assert check.is_valid({**whole, "submissions": [boards.submission("a/b@" + "0" * 40)]})
    assert not check.is_valid({**whole, "submissions": [boards.submission("a", memory="good")]})
    assert not any(check.is_valid(yaml.safe_load(text)) for text in WRONG_FIELDS)


@pytest.mark.parametrize(
    "text",
    [
        *WRONG_FIELDS,
        "boards: [",
        "- a",
        "boards:\n- {name: a b, simulator: c}",
        "boards: 2026-13-45",
        "boards: 0001-01-01T00:00:00+23:59",
        "boards: &x [*x]",
        "? [a]\n: b",
        pytest.param("[" * 5000, id="deep"),
        "boards:\n- &a {name: a, simulator: b}\n- *a",
        "boards: []",
        f"{OWN_BOARD}references:\n- {{board: c, rows: [d], standing: control}}",
        f"{OWN_BOARD}references:\n- {{board: a, rows: [], standing: control}}",
        # YAML would keep the second list, and so lose the entries of the first.
        f"{OWN_BOARD}submissions: []\nsubmissions: []",
        "boards:\n- {name: a, simulator: b, name: c}",
    ],
)
def test_a_wrong_file(tmp_path: Path, text: str) -> None:
    path = tmp_path / "results.yaml"
    path.write_text(text)
    with raises(FormatError):
        read_entries(path)
