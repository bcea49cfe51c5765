"""`robomme-interference publish`."""

import io
import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from support.hub_server import HubServer
from support.publishing import LESSONS, UNITS, plain_cards, plan_again, publish, tags
from support.splits import CONDITIONS, GOLDEN, contents, copy_split

from robomme_interference_data import load_split
from robomme_interference_data.cards import checks
from robomme_interference_data.cards.checks import check_split
from robomme_interference_data.errors import PublishError

Run = Callable[..., tuple[int, str, str]]
ASKED = ("publish", GOLDEN, "--repo-id", UNITS)


@pytest.fixture(autouse=True)
def _somebody(login: Callable[..., None], monkeypatch: pytest.MonkeyPatch) -> None:
    login("someone")
    plain_cards(monkeypatch)


@pytest.fixture
def unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the checks, which decode everything and import lerobot."""
    monkeypatch.setattr(checks, "check_split", lambda *_: None)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def written(hub: HubServer) -> bool:
    return any(not one.startswith(("GET", "HEAD")) for one in hub.requests)


@pytest.mark.usefixtures("unchecked")
def test_publish(hub: HubServer, run: Run) -> None:
    code, out, err = run(*ASKED, "--yes", "--json", "--license", "cc-by-4.0", "--version", "1.2.3")
    assert code == 0, err
    told = json.loads(out)
    assert [one["repo_id"] for one in told] == [LESSONS, UNITS]
    for one in told:
        assert one["version"] == "1.2.3"
        assert tags(hub, one["repo_id"]) == {"data-1.2.3": one["commit"], "v3.0": one["commit"]}
        assert one["sent_files"] == one["files"] > 0
    code, out, err = run(*ASKED, "--license", "cc-by-4.0")
    assert (code, out) == (0, "")
    assert err.count("published, ") == 2
    assert f'load_split("{UNITS}", revision="data-1.2.3")' in err


@pytest.mark.usefixtures("unchecked")
def test_a_dry_run_sends_nothing(hub: HubServer, run: Run) -> None:
    code, out, err = run(*ASKED, "--dry-run", "--json")
    assert (code, written(hub)) == (0, False)
    assert [one["commit"] for one in json.loads(out)] == [None, None]
    assert err.count("new repository") == 2


@pytest.mark.usefixtures("unchecked")
def test_it_says_if_the_demonstrations_have_no_embeddings(
    hub: HubServer, run: Run, tmp_path: Path
) -> None:
    root = copy_split(tmp_path / "split")
    command = f"robomme-interference index {root}"
    for options in ((), ("--to", tmp_path / "out")):
        given = ("publish", root, "--repo-id", UNITS, "--dry-run", *options)
        assert command in run(*given)[2]
    (root / "demonstrations/index/thumbnail").mkdir(parents=True)
    (root / "demonstrations/index/thumbnail/index.json").write_text("{}")
    assert command not in run("publish", root, "--repo-id", UNITS, "--dry-run")[2]


@pytest.mark.usefixtures("unchecked")
def test_without_a_terminal_it_has_to_be_said(hub: HubServer, run: Run) -> None:
    code, _, err = run(*ASKED)
    assert (code, written(hub)) == (1, False)
    assert "--yes" in err


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("answer", "code"), [("y\n", 0), ("n\n", 1), ("\n", 1), ("", 1)])
def test_it_asks(
    hub: HubServer, run: Run, monkeypatch: pytest.MonkeyPatch, answer: str, code: int
) -> None:
    monkeypatch.setattr(sys, "stdin", Terminal(answer))
    assert run(*ASKED)[0] == code
    assert written(hub) == (code == 0)


@pytest.mark.usefixtures("unchecked")
def test_a_refusal_names_the_next_version(hub: HubServer, run: Run, tmp_path: Path) -> None:
    publish(GOLDEN)
    root = copy_split(tmp_path / "split")
    plan_again(root, [*CONDITIONS, "k2"])
    code, _, err = run("publish", root, "--repo-id", UNITS, "--yes")
    assert (code, "--version 1.1.0" in err) == (1, True)
    assert run("publish", root, "--repo-id", UNITS, "--yes", "--version", "1.1.0")[0] == 0
    assert len(load_split(UNITS, revision="data-1.1.0")) == 18


# --- into a folder -------------------------------------------------------------------------------


@pytest.mark.usefixtures("unchecked")
def test_into_a_folder(hub: HubServer, run: Run, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert run(*ASKED, "--to", out, "--dry-run")[0] == 0
    assert not out.exists()
    code, told, _ = run(*ASKED, "--to", out, "--json")
    assert code == 0
    found = contents(out)
    assert json.loads(told) == {
        "to": str(out),
        "files": len(found),
        "bytes": sum(map(len, found.values())),
        "written": True,
    }
    assert "was there" in run(*ASKED, "--to", out)[2]
    assert hub.requests == []


@pytest.mark.usefixtures("unchecked")
def test_not_into_the_data_of_a_split(run: Run, tmp_path: Path) -> None:
    root = copy_split(tmp_path / "split")
    before = contents(root)
    code, _, err = run("publish", root, "--repo-id", UNITS, "--to", root / "distractors" / "out")
    assert (code, "inside" in err) == (1, True)
    assert contents(root) == before


# --- what is checked first -----------------------------------------------------------------------


def test_a_damaged_split_is_not_published(hub: HubServer, run: Run, tmp_path: Path) -> None:
    root = copy_split(tmp_path / "split")
    (root / "distractors" / "meta" / "build_report.json").write_text("{}\n")
    code, _, err = run("publish", root, "--repo-id", UNITS, "--yes")
    assert (code, written(hub)) == (1, False)
    assert "build_report.json" in err
    assert f"robomme-interference verify {root}" in err


@pytest.mark.parametrize("token", ["hf_unknown", ""])
def test_who_is_not_logged_in_does_not_wait_for_the_checks(
    hub: HubServer, run: Run, monkeypatch: pytest.MonkeyPatch, token: str
) -> None:
    monkeypatch.setattr(checks, "check_split", lambda *_: pytest.fail("it was checked"))
    monkeypatch.setenv("HF_TOKEN", token)
    code, _, err = run(*ASKED, "--yes")
    assert (code, len(hub.requests) <= 1) == (1, True)
    assert "does not know this login" in err and "hf auth login" in err


def test_a_split_that_leaks_is_not_published(monkeypatch: pytest.MonkeyPatch) -> None:
    from robomme_interference_data.build_dataset.audit import Audit, Leak

    audit = Audit({}, leaks=[Leak("same scene", "unit MoveCube/train/0"), Leak("other", "b")])
    monkeypatch.setattr(checks, "audit_split", lambda _: audit)
    with pytest.raises(PublishError, match="2 leaks, such as same scene: unit MoveCube") as caught:
        check_split(load_split(GOLDEN))
    assert "robomme-interference audit" in str(caught.value.hint)
