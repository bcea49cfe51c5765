"""`robomme-interference publish-results`."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from support import runs, worlds
from support.hub_server import HubServer
from support.machine import full_disk
from support.publishing import files, tags
from support.splits import GOLDEN

from robomme_interference_data.cards import render
from robomme_interference_data.storage.files import canonical_json

Run = Callable[..., tuple[int, str, str]]
REPO = "someone/results"


@pytest.fixture
def ended(tmp_path: Path, login: Callable[..., None], monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run of one rollout that has ended; who is logged in may publish it."""
    login("someone")
    monkeypatch.setenv(worlds.SPLIT, str(GOLDEN))
    runs.run_one(tmp_path / "run")
    return tmp_path / "run"


def test_results_are_published_once(hub: HubServer, ended: Path, run: Run, tmp_path: Path) -> None:
    asked = ("publish-results", ended, "--repo-id", REPO, "--grid", "given")
    code, out, err = run(*asked, "--dry-run", "--json")
    assert code == 0, err
    assert json.loads(out)[0]["sent_files"] > 0 and tags(hub, REPO) == {}
    code, _, err = run(*asked)
    assert code == 1 and "--yes" in err
    code, _, err = run(*asked, "--yes")
    assert code == 0, err
    assert [*tags(hub, REPO)] == ["data-1.0.0"]
    found = files(hub, REPO)
    assert {"run.json", "rollouts.jsonl", "rollouts.parquet", "score/report.html"} <= found.keys()
    assert {"README.md", "croissant.json", "score/tables/main.csv"} <= found.keys()
    for name in ("run.json", "rollouts.jsonl", "rollouts.parquet", "rollouts.csv"):
        assert found[name] == (ended / name).read_bytes()
    sent = hub.received
    code, _, err = run(*asked, "--yes")
    assert code == 0 and "published, " in err and hub.received == sent
    code, out, err = run("card", REPO)
    assert code == 0 and "results" in out, err


def test_a_full_disk_while_scores_are_written(hub: HubServer, ended: Path, run: Run) -> None:
    asked = ("publish-results", ended, "--repo-id", REPO, "--grid", "given", "--yes")
    with full_disk(1000):
        code, _, err = run(*asked)
    assert code == 1 and "File too large" in err and "space left on the disk" in err
    assert hub.repositories == {}
    assert run(*asked)[0] == 0
    assert [*tags(hub, REPO)] == ["data-1.0.0"]


def test_other_rows_are_another_version(
    hub: HubServer, ended: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(render, "results_files", lambda *_: {"README.md": b"card"})
    asked = ("publish-results", ended, "--repo-id", REPO, "--yes")
    assert run(*asked)[0] == 0
    record = ended / "rollouts.jsonl"
    row = json.loads(record.read_text(encoding="utf-8"))
    record.write_text(canonical_json(row | {"steps": row["steps"] + 1}) + "\n", encoding="utf-8")
    code, _, err = run(*asked)
    assert code == 1 and "--version 2.0.0" in err
    assert run(*asked, "--version", "2.0.0")[0] == 0
    assert [*tags(hub, REPO)] == ["data-1.0.0", "data-2.0.0"]


def test_a_run_that_has_not_ended_is_no_result(
    hub: HubServer, ended: Path, run: Run, tmp_path: Path
) -> None:
    (ended / "rollouts.parquet").unlink()
    for folder in (ended, tmp_path / "nothing"):
        code, _, err = run("publish-results", folder, "--repo-id", REPO)
        assert code == 1 and "no run that has ended" in err
    assert hub.requests == []
