"""The commands `publish` and `publish-results`, over real HTTP with the Hub's own client."""

import io
import json
import logging
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from support import runs, worlds
from support.buffer_sets import GOLDEN, contents, copy_buffer_set
from support.hub_server import HubServer
from support.machine import full_disk
from support.messages import raises
from support.publishing import LESSONS, UNITS, files, publish, tags, writes

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.verify.audit import Audit, Leak
from robomme_interference_data.cards import checks, results
from robomme_interference_data.cards.checks import check_buffer_set
from robomme_interference_data.errors import PublishError
from robomme_interference_data.storage.text import canonical_json

Login = Callable[..., None]
Run = Callable[..., tuple[int, str, str]]

pytestmark = pytest.mark.usefixtures("_somebody")


@pytest.mark.slow
def test_a_dry_run_needs_the_light_core_only(
    hub: HubServer, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    publish(GOLDEN)
    sent = writes(hub)
    for name in ("lerobot", "datasets", "jinja2", "matplotlib"):
        monkeypatch.setitem(sys.modules, name, None)
    words = ("publish", GOLDEN, "--repo-id", UNITS, "--demonstrations-id", LESSONS, "--json")
    code, out, err = run(*words, "--dry-run")
    assert code == 0 and 'pip install "robomme-interference-data[build,score]"' in err
    assert [(one["sent_files"], one["removed_files"]) for one in json.loads(out)] == [(0, [])] * 2
    code, out, err = run(*words, "--yes")  # before the checks, which may take hours
    assert (code, out) == (1, "") and "[build,score]" in err
    assert writes(hub) == sent


def test_each_message_is_printed_once(hub: HubServer, run: Run, _unchecked: None) -> None:
    other = logging.StreamHandler(sys.stderr)  # as libraries add one
    logging.root.addHandler(other)
    try:
        words = ("publish", GOLDEN, "--repo-id", UNITS, "--demonstrations-id", LESSONS)
        code, _, err = run(*words, "--yes")
    finally:
        logging.root.removeHandler(other)
    assert code == 0 and err.count(f"{UNITS}: sending") == 1


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.slow
@pytest.mark.usefixtures("_unchecked")
def test_the_command(
    hub: HubServer, run: Run, monkeypatch: pytest.MonkeyPatch, extended: Path
) -> None:
    asked = ("publish", GOLDEN, "--repo-id", UNITS, "--license", "cc-by-4.0")
    code, out, err = run(*asked, "--dry-run", "--json")
    assert (code, writes(hub)) == (0, [])
    assert [one["commit"] for one in json.loads(out)] == [None, None]
    assert err.count("new repository") == 2
    assert f"robomme-interference index {GOLDEN}" in err  # the demonstrations have no embeddings
    code, _, err = run(*asked)
    assert (code, "--yes" in err, writes(hub)) == (1, True, [])  # nobody can answer
    for answer in ("n\n", "\n", ""):
        monkeypatch.setattr(sys, "stdin", Terminal(answer))
        assert run(*asked)[0] == 1 and writes(hub) == []
    code, out, err = run(*asked, "--yes", "--json", "--version", "1.2.3")
    assert code == 0, err
    for one in json.loads(out):
        assert one["version"] == "1.2.3"
        assert tags(hub, one["repo_id"]) == {"data-1.2.3": one["commit"], "v3.0": one["commit"]}
        assert one["sent_files"] == one["files"] > 0
    code, out, err = run(*asked)
    assert (code, out, err.count("published, ")) == (0, "", 2)
    assert f'load_buffer_set("{UNITS}", revision="data-1.2.3")' in err
    asked = ("publish", extended, *asked[2:])
    code, _, err = run(*asked, "--yes")
    assert (code, "--version" in err) == (1, True)
    monkeypatch.setattr(sys, "stdin", Terminal("y\n"))
    assert run(*asked, "--version", "1.3.0")[0] == 0
    assert len(load_buffer_set(UNITS, revision="data-1.3.0")) == 18


@pytest.mark.usefixtures("_unchecked")
def test_the_command_into_a_folder(hub: HubServer, run: Run, tmp_path: Path) -> None:
    out, asked = tmp_path / "out", ("publish", GOLDEN, "--repo-id", UNITS)
    assert run(*asked, "--to", out, "--dry-run")[0] == 0 and not out.exists()
    code, text, _ = run(*asked, "--to", out, "--json")
    found = contents(out)
    size = sum(map(len, found.values()))
    expected = {"to": str(out), "files": len(found), "bytes": size, "written": True}
    assert (code, json.loads(text)) == (0, expected)
    assert "unchanged" in run(*asked, "--to", out)[2]
    assert hub.requests == []
    root = copy_buffer_set(tmp_path / "buffer_set")
    before = contents(root)
    code, _, err = run("publish", root, "--repo-id", UNITS, "--to", root / "distractors" / "out")
    assert (code, "inside" in err, contents(root)) == (1, True, before)


@pytest.mark.slow
def test_a_buffer_set_that_fails_a_check_is_not_published(
    hub: HubServer, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = copy_buffer_set(tmp_path / "buffer_set")
    (root / "distractors" / "meta" / "build_report.json").write_text("{}\n")
    code, _, err = run("publish", root, "--repo-id", UNITS, "--yes")
    assert (code, writes(hub)) == (1, [])
    assert "build_report.json" in err and f"robomme-interference verify {root}" in err
    audit = Audit({}, leaks=[Leak("same scene", "unit MoveCube/train/0"), Leak("other", "b")])
    monkeypatch.setattr(checks, "audit_buffer_set", lambda _: audit)
    with raises(PublishError) as caught:
        check_buffer_set(load_buffer_set(GOLDEN))
    assert caught.value.command == f"verify {GOLDEN} --audit"


# --- results -------------------------------------------------------------------------------------


@pytest.fixture
def ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run of one rollout that has ended."""
    monkeypatch.setenv(worlds.BUFFER_SET, str(GOLDEN))
    runs.run_one(tmp_path / "run")
    return tmp_path / "run"


@pytest.mark.slow
def test_results(hub: HubServer, ended: Path, run: Run, tmp_path: Path) -> None:
    repo = "someone/results"
    asked = ("publish-results", ended, "--repo-id", repo, "--expected", "observed")
    code, out, err = run(*asked, "--dry-run", "--json")
    assert code == 0, err
    assert json.loads(out)[0]["sent_files"] > 0 and tags(hub, repo) == {}
    with full_disk(1000):
        code, _, err = run(*asked, "--yes")
    assert code == 1 and "File too large" in err and hub.repositories == {}
    code, _, err = run(*asked, "--yes")
    assert code == 0, err
    found = files(hub, repo)
    assert {"run.json", "rollouts.jsonl", "rollouts.parquet", "score/report.html"} <= found.keys()
    assert {"README.md", "score/tables/main.csv"} <= found.keys()
    for name in ("run.json", "rollouts.jsonl", "rollouts.parquet", "rollouts.csv"):
        assert found[name] == (ended / name).read_bytes()
    sent = hub.received
    code, _, err = run(*asked, "--yes")
    assert code == 0 and "published, " in err and hub.received == sent
    assert run(*asked, "--to", tmp_path / "out")[0] == 0
    assert contents(tmp_path / "out") == found
    code, out, err = run("card", repo)
    assert code == 0 and "results" in out, err


@pytest.mark.slow
def test_other_rows_are_another_version(
    hub: HubServer, ended: Path, run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(results, "card_files", lambda *_: {"README.md": b"card"})
    repo = "someone/results"
    asked = ("publish-results", ended, "--repo-id", repo, "--yes")
    assert run(*asked)[0] == 0
    record = ended / "rollouts.jsonl"
    row = json.loads(record.read_text(encoding="utf-8"))
    record.write_text(canonical_json(row | {"steps": row["steps"] + 1}) + "\n", encoding="utf-8")
    code, _, err = run(*asked)
    assert code == 1
    assert run(*asked, "--version", "2.0.0")[0] == 0
    assert [*tags(hub, repo)] == ["data-1.0.0", "data-2.0.0"]
    (ended / "rollouts.parquet").unlink()
    for folder in (ended, tmp_path / "nothing"):
        code, _, err = run("publish-results", folder, "--repo-id", repo)
        assert code == 1 and "no finished run" in err
