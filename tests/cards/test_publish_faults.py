"""Failures while publishing: no partial version, and the same command resumes."""

import os
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from support.buffer_sets import GOLDEN, contents, copy_buffer_set
from support.hub import kill_at
from support.hub_server import HubServer
from support.machine import full_disk
from support.messages import raises
from support.publishing import LESSONS, UNITS, files, publish, tags

from robomme_interference_data import load_buffer_set
from robomme_interference_data.cards import checks
from robomme_interference_data.cards.checks import open_with_lerobot
from robomme_interference_data.errors import HubError, PublishError

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("_somebody")]


PUBLISH = """
import pytest
from support.buffer_sets import GOLDEN
from support.publishing import plain_cards, publish

with pytest.MonkeyPatch.context() as patch:
    plain_cards(patch)
    publish(GOLDEN)
"""


def whole(hub: HubServer) -> bool:
    """Whether both repositories hold a version that is what a first, undisturbed try publishes."""
    for repo_id in (LESSONS, UNITS):
        head = hub.repositories[f"datasets/{repo_id}"].find().oid
        if tags(hub, repo_id) != {"data-1.0.0": head, "v3.0": head}:
            return False
    return len(files(hub, LESSONS)) == 19 and len(files(hub, UNITS)) == 63


STAGES: dict[str, tuple[str, str, int]] = {
    "second repository": ("POST", "/repos/create", 1),
    "large files": ("PUT", "/store/datasets/someone/tiny/", 20),
    "second commit": ("POST", "/commit/", 1),
    "tree": ("GET", "/tiny/tree/[0-9a-f]{40}", 1),
    "tag": ("POST", "/tiny/tag/", 1),
}


@pytest.mark.parametrize(
    ("stage", "status"), [*((stage, 400) for stage in STAGES), ("second commit", 429)]
)
def test_a_failed_publish_resumes(hub: HubServer, stage: str, status: int) -> None:
    method, path, after = STAGES[stage]
    hub.fault(method, path, after=after, status=status)
    with raises(HubError) as caught:
        publish(GOLDEN)
    assert "same command" in str(caught.value.hint)
    assert "data-1.0.0" not in tags(hub, UNITS)
    publish(GOLDEN)
    assert whole(hub)
    assert len(hub.uploads()) == len(set(hub.uploads()))  # no large file is sent twice


@pytest.mark.parametrize("stage", ["second repository", "second commit", "tag"])
def test_a_lost_answer(hub: HubServer, stage: str) -> None:
    method, path, after = STAGES[stage]
    hub.fault(method, path, after=after, lost=True)
    with raises(HubError):
        publish(GOLDEN)
    publish(GOLDEN)
    assert whole(hub)
    own = hub.repositories[f"datasets/{UNITS}"].commits.values()
    assert [one.title for one in own] == ["initial commit", "Version 1.0.0"]


def test_a_connection_that_drops_during_an_upload(hub: HubServer) -> None:
    hub.fault("PUT", "/store/datasets/someone/tiny/", after=20, drop=1000)
    publish(GOLDEN)
    assert whole(hub)


KILLS = {
    "first commit": ("POST", "/tiny-demonstrations/commit/", 0),
    "first tag": ("POST", "/tiny-demonstrations/tag/", 1),
    "large files": ("PUT", "/store/datasets/someone/tiny/", 20),
    "second commit": ("POST", "/tiny/commit/", 0),
    "second tag": ("POST", "/tiny/tag/", 1),
}


@pytest.mark.slow
@pytest.mark.parametrize("stage", KILLS)
def test_publish_after_a_kill(hub: HubServer, stage: str) -> None:
    """Nothing is lost or doubled: commits, tags and uploads are those of one undisturbed try."""
    kill_at(hub, *KILLS[stage], PUBLISH)
    assert "data-1.0.0" not in tags(hub, UNITS)
    publish(GOLDEN)
    assert whole(hub)
    assert len(hub.uploads()) == len(set(hub.uploads()))  # no large file is sent twice
    for name, repo_id in (("demonstrations", LESSONS), ("distractors", UNITS)):
        stored, published = contents(GOLDEN / name), files(hub, repo_id, "data-1.0.0")
        assert {path: published[path] for path in stored} == stored
        commits = hub.repositories[f"datasets/{repo_id}"].commits.values()
        assert [commit.title for commit in commits] == ["initial commit", "Version 1.0.0"]
    published_set = load_buffer_set(UNITS, revision="data-1.0.0")
    assert published_set.revision == load_buffer_set(GOLDEN).revision


CHANGED = """
import sys
from pathlib import Path

import pytest
from support.publishing import plain_cards, publish

with pytest.MonkeyPatch.context() as patch:
    plain_cards(patch)
    publish(Path(sys.argv[1]), version="2.0.0")
"""


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["first tag", "second commit", "second tag"])
def test_a_further_version_after_a_kill(hub: HubServer, stage: str, tmp_path: Path) -> None:
    before = publish(GOLDEN)
    root = copy_buffer_set(tmp_path / "buffer_set")
    (root / "demonstrations" / "index").mkdir()
    (root / "demonstrations" / "index" / "more").write_bytes(b"more")
    kill_at(hub, *KILLS[stage], CHANGED, str(root))
    assert "data-2.0.0" not in tags(hub, UNITS)
    publish(root, version="2.0.0")
    for repo_id, first in zip((LESSONS, UNITS), before, strict=True):
        head = hub.repositories[f"datasets/{repo_id}"].find().oid
        expected = {"data-1.0.0": first.published, "data-2.0.0": head, "v3.0": head}
        assert tags(hub, repo_id) == expected
        commits = hub.repositories[f"datasets/{repo_id}"].commits.values()
        titles = [commit.title for commit in commits]
        assert titles == ["initial commit", "Version 1.0.0", "Version 2.0.0"]
    location = load_buffer_set(UNITS).header.datasets["demonstrations"].location
    assert location == f"{LESSONS}@{tags(hub, LESSONS)['data-2.0.0']}"


def test_concurrent_commit_by_another_user(hub: HubServer) -> None:
    other = {"README.md": b"to come", "notes.txt": b"other"}
    hub.fault("POST", "/tiny/commit/", call=lambda: hub.push(f"datasets/{UNITS}", other))
    with raises(HubError) as caught:
        publish(GOLDEN)
    assert "commits/main" in str(caught.value.hint)
    assert tags(hub, UNITS) == {}
    assert files(hub, UNITS) == other


def test_a_tag_that_came_first(hub: HubServer) -> None:
    def tagged() -> None:
        repository = hub.repositories[f"datasets/{UNITS}"]
        repository.tags["data-1.0.0"] = next(iter(repository.commits))

    hub.fault("POST", "/tiny/tag/", after=1, call=tagged)
    with raises(HubError):
        publish(GOLDEN)


def test_what_arrived_is_compared(hub: HubServer) -> None:
    def lose() -> None:
        repository = hub.repositories[f"datasets/{UNITS}"]
        head = repository.find()
        repository.commits[head.oid].files.pop("meta/info.json", None)

    hub.fault("GET", "/tiny/tree/[0-9a-f]{40}", after=1, call=lose)
    with raises(HubError):
        publish(GOLDEN)
    assert tags(hub, UNITS) == {}
    publish(GOLDEN)
    assert whole(hub)


@pytest.mark.slow
def test_a_full_disk_while_lerobot_looks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from datasets import config

    open_with_lerobot("distractors", GOLDEN / "distractors")  # imports, and writes their bytecode
    monkeypatch.setattr(config, "HF_DATASETS_CACHE", str(tmp_path))
    with full_disk(12_000), raises(OSError) as caught:
        open_with_lerobot("distractors", GOLDEN / "distractors")
    assert str(caught.value.filename).startswith(str(tmp_path))
    open_with_lerobot("distractors", GOLDEN / "distractors")


def test_lerobot_cannot_open_anything(tmp_path: Path) -> None:
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text("{}")
    with raises(PublishError):
        open_with_lerobot("distractors", tmp_path)


def test_stopped_while_publishing(
    hub: HubServer, run: Callable[..., tuple[int, str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checks, "check_buffer_set", lambda *_: None)
    interrupt = partial(os.kill, os.getpid(), signal.SIGINT)
    hub.fault("PUT", "/store/datasets/someone/tiny/", after=20, call=interrupt)
    command = ("publish", GOLDEN, "--repo-id", UNITS, "--yes")
    code, _, err = run(*command)
    assert code == 130 and "resume with:\nrobomme-interference publish" in err
    assert "data-1.0.0" in tags(hub, LESSONS) and tags(hub, UNITS) == {}
    assert run(*command)[0] == 0
    assert whole(hub)
