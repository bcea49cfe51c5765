"""Publish a split: over real HTTP, with the Hub's own client, and with whatever can go wrong."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from huggingface_hub import constants
from support.hub_server import HubServer
from support.publishing import (
    LESSONS,
    UNITS,
    files,
    plain_cards,
    plan_again,
    publish,
    publisher,
    tags,
)
from support.splits import CONDITIONS, GOLDEN, contents, copy_split

from robomme_interference_data import load_buffer, load_split
from robomme_interference_data.cards import render
from robomme_interference_data.errors import HubError, InvalidOptionError, PublishError

QUERY = "MoveCube/test/0"
Login = Callable[..., None]


@pytest.fixture(autouse=True)
def _somebody(login: Login, monkeypatch: pytest.MonkeyPatch) -> None:
    login("someone")
    plain_cards(monkeypatch)


def writes(hub: HubServer) -> list[str]:
    """Return what was asked of the Hub beside reading."""
    return [one for one in hub.requests if not one.startswith(("GET", "HEAD"))]


# --- what is published ---------------------------------------------------------------------------


def test_a_published_split_is_the_one_on_disk(hub: HubServer) -> None:
    lessons, units = publish(GOLDEN)
    assert (lessons.repository.repo_id, units.repository.repo_id) == (LESSONS, UNITS)
    here, there = load_split(GOLDEN), load_split(UNITS, revision="data-1.0.0")
    assert (there.revision, there.location) == (here.revision, f"{UNITS}@{units.published}")
    assert [*there.manifests()] == [*here.manifests()]
    mine = load_buffer(QUERY, "k3", split=here)
    theirs = load_buffer(QUERY, "k3", split=there, verify=True)
    for camera in mine.cameras:
        assert np.array_equal(theirs.frames(camera), mine.frames(camera))
    assert np.array_equal(theirs.query.frame(), mine.query.frame())


def test_what_repositories_hold(hub: HubServer) -> None:
    lessons, units = publish(GOLDEN)
    card = {"README.md", "README-strip.png", "croissant.json"}
    for step, name in ((lessons, "demonstrations"), (units, "distractors")):
        repo_id, held = step.repository.repo_id, contents(GOLDEN / name)
        found = files(hub, repo_id)
        assert {path: found[path] for path in held} == held
        assert found.keys() - held.keys() - card <= {
            "manifests/manifest.json",
            "manifests/buffers.parquet",
        }
        assert tags(hub, repo_id) == {"data-1.0.0": step.published, "v3.0": step.published}
        own = hub.repositories[f"datasets/{repo_id}"]
        assert [one.title for one in own.commits.values()] == ["initial commit", "Version 1.0.0"]
    places = json.loads(files(hub, UNITS)["manifests/manifest.json"])["datasets"]
    assert {name: one["place"] for name, one in places.items()} == {
        "demonstrations": f"{LESSONS}@{lessons.published}",
        "distractors": ".",
    }
    assert f"{LESSONS}@{lessons.published}".encode() in files(hub, UNITS)["README.md"]


def test_the_tag_comes_last(hub: HubServer) -> None:
    publish(GOLDEN)
    asked = [one for one in writes(hub) if "/commit/" in one or "/tag/" in one]
    places = [one.split("/")[4] + " " + one.split("/")[5] for one in asked]
    once = ["commit", "tag", "tag"]
    assert places == [f"{name} {what}" for name in ("tiny-demonstrations", "tiny") for what in once]
    made = [one.json()["tag"] for one in hub.asked if "/tag/" in one.path]
    assert made == ["v3.0", "data-1.0.0"] * 2


def test_a_plan_sends_nothing(hub: HubServer) -> None:
    _, units = publisher(GOLDEN).plan()
    assert (writes(hub), hub.received, hub.repositories) == ([], 0, {})
    told = units.as_dict()
    assert told["new_repository"] and told["commit"] is None
    assert (told["sent_files"], told["sent_bytes"]) == (told["files"], told["bytes"])
    publish(GOLDEN)
    assert told["bytes"] == sum(map(len, files(hub, UNITS).values()))


def test_a_second_time_sends_no_bytes(hub: HubServer) -> None:
    first = publish(GOLDEN)
    hub.asked.clear()
    again = publish(GOLDEN)
    assert [one.published for one in again] == [one.published for one in first]
    assert (writes(hub), hub.received) == ([], 0)
    assert [one.as_dict()["sent_files"] for one in again] == [0, 0]


def test_private_repositories(hub: HubServer, login: Login) -> None:
    publish(GOLDEN, private=True)
    assert all(one.private for one in hub.repositories.values())
    assert len(load_split(UNITS)) == 15
    login("stranger")
    with pytest.raises(HubError, match="no dataset repository"):
        load_split(UNITS)


# --- versions ------------------------------------------------------------------------------------


def changed(tmp_path: Path, how: str) -> tuple[Path, dict[str, str]]:
    """Return a split that is not the golden one any more, and options that go with it."""
    root = copy_split(tmp_path / "changed")
    if how == "index":
        (root / "distractors" / "index" / "thumbnail").mkdir(parents=True)
        (root / "distractors" / "index" / "thumbnail" / "index.json").write_text("{}")
    elif how == "added":
        plan_again(root, [*CONDITIONS, "k2"])
    elif how == "fewer":
        plan_again(root, CONDITIONS[:-1])
    elif how == "drawn":
        plan_again(root, CONDITIONS, seed=1)
    return root, {"license": "cc-by-4.0"} if how == "card" else {}


@pytest.mark.parametrize(
    ("how", "following"),
    [
        ("card", "1.0.1"),
        ("index", "1.0.1"),
        ("added", "1.1.0"),
        ("fewer", "2.0.0"),
        ("drawn", "2.0.0"),
    ],
)
def test_a_version_never_changes(hub: HubServer, tmp_path: Path, how: str, following: str) -> None:
    lessons, units = publish(GOLDEN)
    root, options = changed(tmp_path, how)
    hub.asked.clear()
    for version in (None, "1.0.0"):
        with pytest.raises(PublishError, match=r"1\.0\.0 already") as caught:
            publish(root, version=version, **options)
        assert f"--version {following}" in str(caught.value.hint)
    if following != "1.0.1":
        with pytest.raises(PublishError, match="how much has changed") as caught:
            publish(root, version="1.0.1", **options)
        assert f"--version {following}" in str(caught.value.hint)
    assert writes(hub) == []
    kept, new = publish(root, version=following, **options)
    # The demonstrations are as they were; with another licence, their card is not.
    assert (kept.published == lessons.published) == (how != "card")
    assert load_split(UNITS).header.datasets["demonstrations"].place == (
        f"{LESSONS}@{lessons.published}"
    )
    assert tags(hub, UNITS) == {
        "data-1.0.0": units.published,
        f"data-{following}": new.published,
        "v3.0": new.published,
    }
    old = load_split(UNITS, revision="data-1.0.0")
    assert [*old.manifests()] == [*load_split(GOLDEN).manifests()]
    now = load_split(UNITS, revision=f"data-{following}")
    assert [*now.manifests()] == [*load_split(root).manifests()]


def test_an_older_version_is_not_published_after_a_newer_one(hub: HubServer) -> None:
    publish(GOLDEN, version="2.0.0")
    with pytest.raises(PublishError, match="how much has changed") as caught:
        publish(GOLDEN, version="1.0.0")
    assert "--version 2.0.1" in str(caught.value.hint)


def test_only_what_has_changed_is_sent(hub: HubServer, tmp_path: Path) -> None:
    publish(GOLDEN)
    root, _ = changed(tmp_path, "added")
    hub.asked.clear()
    _, units = publish(root, version="1.1.0")
    rows = units.tree["manifests/buffers.parquet"]
    assert hub.uploads() == [rows.sha256]


def test_files_that_are_no_more_are_removed(hub: HubServer, tmp_path: Path) -> None:
    root, _ = changed(tmp_path, "index")
    publish(root)
    path = "index/thumbnail/index.json"
    assert path in files(hub, UNITS)
    _, units = publish(GOLDEN, version="1.0.1")
    assert units.difference.removed == (path,)
    assert path not in files(hub, UNITS)
    assert path in files(hub, UNITS, "data-1.0.0")


def test_demonstrations_count_their_own_versions(hub: HubServer, tmp_path: Path) -> None:
    publish(GOLDEN)
    root = copy_split(tmp_path / "split")
    (root / "demonstrations" / "index").mkdir()
    (root / "demonstrations" / "index" / "more").write_bytes(b"more")
    with pytest.raises(PublishError):
        publish(root)
    lessons, units = publish(root, version="1.0.1")
    assert (str(lessons.version), str(units.version)) == ("1.0.1", "1.0.1")
    (root / "demonstrations" / "index" / "most").write_bytes(b"most")
    lessons, units = publish(root, version="3.0.0")
    assert (str(lessons.version), str(units.version)) == ("1.0.2", "3.0.0")


def test_their_card_alone_is_a_version_of_theirs(
    hub: HubServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    lessons, units = publish(GOLDEN)
    told = {"README.md": b"---\nlicense: mit\n---\nmore", "README-strip.png": b"a"}
    for card, version in ((told, "1.0.1"), (told | {"croissant.json": b"{}"}, "1.0.2")):
        monkeypatch.setattr(render, "demonstrations_files", lambda *_, card=card: card)
        new, kept = publish(GOLDEN)
        assert (str(new.version), files(hub, LESSONS)["README.md"]) == (version, card["README.md"])
        assert tags(hub, LESSONS)[f"data-{version}"] == new.published != lessons.published
        assert kept.published == units.published  # it names the first commit, which holds the data
        hub.asked.clear()
        again = publish(GOLDEN)
        assert [one.published for one in again] == [new.published, units.published]
        assert writes(hub) == []
    # What is for them from now on names the commit of their data, too.
    publish(GOLDEN, "someone/other", demonstrations_id=LESSONS)
    header = load_split("someone/other").header.datasets["demonstrations"]
    assert header.place == f"{LESSONS}@{lessons.published}"


# --- published demonstrations --------------------------------------------------------------------


def placed(hub: HubServer, tmp_path: Path, commit: str | None = None) -> Path:
    """Return a split whose manifests name demonstrations on the Hub."""
    commit = commit or hub.push("datasets/others/lessons", GOLDEN / "demonstrations")
    root = copy_split(tmp_path / "placed")
    path = root / "manifests" / "manifest.json"
    header = json.loads(path.read_text(encoding="utf-8"))
    header["datasets"]["demonstrations"]["place"] = f"others/lessons@{commit}"
    path.write_text(json.dumps(header), encoding="utf-8")
    return root


def test_a_split_of_published_demonstrations(hub: HubServer, tmp_path: Path) -> None:
    root = placed(hub, tmp_path)
    [units] = publish(root)
    assert units.repository.repo_id == UNITS
    assert hub.repositories.keys() == {"datasets/others/lessons", f"datasets/{UNITS}"}
    assert len(load_buffer(QUERY, "k1", split=UNITS, verify=True).sessions) == 2


def test_they_may_be_published_again_elsewhere(hub: HubServer, tmp_path: Path) -> None:
    root = placed(hub, tmp_path)
    lessons, _ = publish(root, demonstrations_id="someone/mine")
    header = load_split(UNITS).header.datasets["demonstrations"]
    assert header.place == f"someone/mine@{lessons.published}"


def test_demonstrations_that_are_not_there(hub: HubServer, tmp_path: Path) -> None:
    hub.push("datasets/others/lessons", GOLDEN / "demonstrations")
    with pytest.raises(HubError, match="no revision"):
        publish(placed(hub, tmp_path, commit="a" * 40))


def test_demonstrations_that_are_gated(hub: HubServer, tmp_path: Path) -> None:
    root = placed(hub, tmp_path)
    hub.gated.add("datasets/others/lessons")
    with pytest.raises(HubError, match="gated"):
        publish(root)
    assert UNITS not in str(hub.repositories)


def test_demonstrations_that_are_others(hub: HubServer, tmp_path: Path) -> None:
    commit = hub.push("datasets/others/lessons", GOLDEN / "distractors")
    with pytest.raises(PublishError, match="other demonstrations"):
        publish(placed(hub, tmp_path, commit))


# --- who may -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("who", "told"),
    [
        ({"name": "stranger"}, "may not write to someone/"),
        ({"name": "someone", "write": False}, "may not write to someone/"),
    ],
)
@pytest.mark.parametrize("there", [False, True])
def test_a_token_without_rights(
    hub: HubServer, login: Login, who: dict[str, object], told: str, there: bool
) -> None:
    if there:
        hub.push(f"datasets/{LESSONS}", {"README.md": b"to come"})
        hub.push(f"datasets/{UNITS}", {"README.md": b"to come"})
    login(**who)
    with pytest.raises(HubError, match=told) as caught:
        publish(GOLDEN)
    assert "hf auth login" in str(caught.value.hint)
    assert hub.uploads() == []
    assert tags(hub, LESSONS) == {}


@pytest.mark.parametrize("token", ["hf_unknown", None])
def test_nobody_is_logged_in(
    hub: HubServer, monkeypatch: pytest.MonkeyPatch, token: str | None
) -> None:
    if token is None:
        monkeypatch.delenv("HF_TOKEN")
    else:
        monkeypatch.setenv("HF_TOKEN", token)
    with pytest.raises(HubError, match="does not know this login") as caught:
        publish(GOLDEN)
    assert "hf auth login" in str(caught.value.hint)
    assert writes(hub) == []


def test_members_publish_for_an_organization(hub: HubServer, login: Login) -> None:
    login("member", orgs=("someone",))
    publish(GOLDEN)
    assert "data-1.0.0" in tags(hub, UNITS)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"repo_id": "tiny"}, "--repo-id 'tiny'"),
        ({"demonstrations_id": "a/b/c"}, "--demonstrations-id 'a/b/c'"),
        ({"demonstrations_id": UNITS}, "are both"),
        ({"repo_id": "someone/" + "a" * 90}, "--demonstrations-id 'someone/a*-demonstrations'"),
        ({"version": "1.0"}, "--version '1.0'"),
        ({"version": ""}, "--version ''"),
        ({"license": "MIT License"}, "--license"),
    ],
)
def test_options(hub: HubServer, options: dict[str, str], told: str) -> None:
    with pytest.raises(InvalidOptionError, match=told):
        publisher(GOLDEN, **options)
    assert hub.requests == []


# --- what is there -------------------------------------------------------------------------------


def test_a_repository_of_something_else(hub: HubServer) -> None:
    hub.push(f"datasets/{UNITS}", {"data/train.csv": b"1,2", "README.md": b"mine"})
    with pytest.raises(PublishError, match=r"something else, such as data/train\.csv"):
        publish(GOLDEN)
    assert writes(hub) == []


def test_a_repository_made_by_hand(hub: HubServer) -> None:
    hub.push(f"datasets/{UNITS}", {"README.md": b"to come", "LICENSE": b"free"})
    publish(GOLDEN)
    assert files(hub, UNITS)["LICENSE"] == b"free"
    assert files(hub, UNITS)["README.md"] != b"to come"


def test_a_renamed_repository(hub: HubServer) -> None:
    publish(GOLDEN)
    hub.renamed[f"datasets/{UNITS}"] = "datasets/someone/new"
    hub.repositories["datasets/someone/new"] = hub.repositories.pop(f"datasets/{UNITS}")
    hub.repositories["datasets/someone/new"].name = "datasets/someone/new"
    with pytest.raises(HubError, match="is now called someone/new"):
        publish(GOLDEN)


def test_offline(hub: HubServer, offline: Callable[[], None]) -> None:
    offline()
    with pytest.raises(HubError, match="HF_HUB_OFFLINE is set"):
        publish(GOLDEN)
    assert hub.requests == [] and constants.HF_HUB_OFFLINE
