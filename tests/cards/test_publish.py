"""Publish over real HTTP, with the Hub's own client: buffer sets, their versions, permissions."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.buffer_sets import GOLDEN, contents, copy_buffer_set, stored_frames
from support.hub_server import HubServer
from support.messages import raises
from support.publishing import LESSONS, UNITS, files, plan, publish, tags, writes
from support.tabletop import TABLETOP, copy_tabletop

from robomme_interference_data import load_buffer, load_buffer_set
from robomme_interference_data.build_dataset.questions import write_questions
from robomme_interference_data.build_dataset.verify.buffer_set import verify_buffer_set
from robomme_interference_data.cards import checks
from robomme_interference_data.data.questions import read_questions
from robomme_interference_data.errors import HubError, PublishError

QUERY = "MoveCube/test/0"
CARD = {"README.md", "README-strip.png"}
Login = Callable[..., None]
Run = Callable[..., tuple[int, str, str]]

pytestmark = pytest.mark.usefixtures("_somebody")


# --- a buffer set --------------------------------------------------------------------------------


def test_a_published_buffer_set_is_the_one_on_disk(hub: HubServer, tmp_path: Path) -> None:
    planned = plan(GOLDEN)[1]
    for planned_repo in planned:
        report = planned_repo.to_dict()
        assert report["new_repository"] and report["commit"] is None
        assert (report["sent_files"], report["sent_bytes"]) == (report["files"], report["bytes"])
    assert (writes(hub), hub.received, hub.repositories) == ([], 0, {})  # planning sends nothing

    lessons, units = publish(GOLDEN)
    # Planned before the commit of the demonstrations exists: the same files of the same sizes.
    for before, after in zip(planned, (lessons, units), strict=True):
        assert {path: file.size for path, file in before.files.items()} == {
            path: file.size for path, file in after.files.items()
        }
    golden, published = load_buffer_set(GOLDEN), load_buffer_set(UNITS, revision="data-1.0.0")
    assert published.revision == golden.revision
    assert published.location == f"{UNITS}@{units.published}"
    assert [*published.manifests()] == [*golden.manifests()]
    mine = load_buffer(QUERY, "k3", buffer_set=golden)
    theirs = load_buffer(QUERY, "k3", buffer_set=published, verify=True)
    for camera in mine.cameras:
        assert np.array_equal(theirs.frames(camera), mine.frames(camera))
    for done, name in ((lessons, "demonstrations"), (units, "distractors")):
        repo_id, held = done.repository.repo_id, contents(GOLDEN / name)
        found = files(hub, repo_id)
        assert {path: found[path] for path in held} == held
        manifests = {"manifests/manifest.json", "manifests/buffers.parquet"} & found.keys()
        assert found.keys() - held.keys() - manifests == CARD
        assert tags(hub, repo_id) == {"data-1.0.0": done.published, "v3.0": done.published}
        own = hub.repositories[f"datasets/{repo_id}"]
        assert [one.title for one in own.commits.values()] == ["initial commit", "Version 1.0.0"]
    base = f"{LESSONS}@{lessons.published}"
    places = json.loads(files(hub, UNITS)["manifests/manifest.json"])["datasets"]
    assert [one["location"] for one in places.values()] == [base, "."]
    assert base.encode() in files(hub, UNITS)["README.md"]

    # The tag comes last, and nothing is sent a second time.
    sent = [one.split("/")[4:6] for one in writes(hub) if "/commit/" in one or "/tag/" in one]
    once = ["commit", "tag", "tag"]
    assert sent == [[name, what] for name in ("tiny-demonstrations", "tiny") for what in once]
    made = [one.json()["tag"] for one in hub.asked if "/tag/" in one.path]
    assert made == ["v3.0", "data-1.0.0"] * 2
    hub.asked.clear()
    again = publish(GOLDEN)
    assert [one.published for one in again] == [lessons.published, units.published]
    assert (writes(hub), hub.received) == ([], 0)


@pytest.mark.slow
def test_private_repositories(hub: HubServer, login: Login) -> None:
    publish(GOLDEN, private=True)
    assert all(one.private for one in hub.repositories.values())
    assert len(load_buffer_set(UNITS)) == 15
    login("stranger")
    with raises(HubError):
        load_buffer_set(UNITS)


@pytest.mark.slow
def test_questions_are_parts_of_a_buffer_set(hub: HubServer, tmp_path: Path, run: Run) -> None:
    publish(TABLETOP)
    assert files(hub, UNITS)["questions.parquet"] == (TABLETOP / "questions.parquet").read_bytes()
    published = load_buffer_set(UNITS, revision="data-1.0.0")
    questions = read_questions(published)
    assert questions == read_questions(load_buffer_set(TABLETOP))
    assert [*verify_buffer_set(published)] == []
    part = ("--families", "MoveCube")
    for options, comes in ((part, False), ((*part, "--questions"), True), ((), True)):
        out = tmp_path / str(len(options))
        assert run("fetch", f"{UNITS}@data-1.0.0", *options, "--to", out)[0] == 0
        assert (out / "questions.parquet").exists() == comes
    buffer_set = copy_tabletop(tmp_path / "buffer_set")
    first, *others = questions.values()
    turned = replace(first, right=(first.right + 1) % len(first.options))
    write_questions([turned, *others], buffer_set)
    with pytest.raises(PublishError):
        plan(buffer_set)


@pytest.mark.slow
def test_lerobot_opens_what_was_published(hub: HubServer, run: Run, tmp_path: Path) -> None:
    code, out, err = run("publish", GOLDEN, "--repo-id", UNITS, "--yes", "--json")  # all checks
    assert code == 0, err
    assert [one["repo_id"] for one in json.loads(out)] == [LESSONS, UNITS]
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    for repo_id, name in ((LESSONS, "demonstrations"), (UNITS, "distractors")):
        opened = LeRobotDataset(repo_id, root=tmp_path / name, video_backend="pyav")
        record = next(iter(load_buffer_set(GOLDEN).datasets[name].records()))
        frame = opened[3]["observation.images.front"].numpy().transpose(1, 2, 0)
        stored = stored_frames(name, record.episode_id, "front")[3]
        assert np.array_equal(np.round(frame * 255).astype(np.uint8), stored)


# --- versions ------------------------------------------------------------------------------------


def test_a_published_version_never_changes(hub: HubServer, extended: Path) -> None:
    lessons, units = publish(GOLDEN)
    hub.asked.clear()
    for version in (None, "1.0.0", "0.9.0"):
        with pytest.raises(PublishError):
            publish(extended, version=version)
    assert writes(hub) == []
    kept, new = publish(extended, version="1.1.0")
    assert hub.uploads() == [new.files["manifests/buffers.parquet"].sha256]  # only what changed
    assert kept.published == lessons.published
    assert tags(hub, UNITS) == {
        "data-1.0.0": units.published,
        "data-1.1.0": new.published,
        "v3.0": new.published,
    }
    for version, root in (("1.0.0", GOLDEN), ("1.1.0", extended)):
        published = load_buffer_set(UNITS, revision=f"data-{version}")
        assert [*published.manifests()] == [*load_buffer_set(root).manifests()]


def test_an_older_version_is_not_published_after_a_newer_one(
    hub: HubServer, tmp_path: Path
) -> None:
    root, path = copy_buffer_set(tmp_path / "indexed"), "index/thumbnail/index.json"
    (root / "distractors" / path).parent.mkdir(parents=True)
    (root / "distractors" / path).write_text("{}")
    publish(root, version="2.0.0")
    assert path in files(hub, UNITS)
    with pytest.raises(PublishError):
        publish(GOLDEN, version="1.0.0")
    _, units = publish(GOLDEN, version="2.0.1")
    assert units.difference.removed == (path,)
    assert path not in files(hub, UNITS) and path in files(hub, UNITS, "data-2.0.0")


@pytest.mark.slow
def test_demonstrations_count_their_own_versions(hub: HubServer, tmp_path: Path) -> None:
    lessons, units = publish(GOLDEN)
    # Equal data keeps its version, so that another buffer set does not change what this one names.
    kept, _ = publish(GOLDEN, "someone/other", demonstrations_id=LESSONS, license="cc-by-4.0")
    assert (str(kept.version), kept.published) == ("1.0.0", lessons.published)
    header = load_buffer_set("someone/other").header.datasets["demonstrations"]
    assert header.location == f"{LESSONS}@{lessons.published}"
    assert [done.published for done in publish(GOLDEN)] == [lessons.published, units.published]
    # With other data, the buffer set has to be another version, too.
    root = copy_buffer_set(tmp_path / "buffer_set")
    (root / "demonstrations" / "index").mkdir()
    (root / "demonstrations" / "index" / "more").write_bytes(b"more")
    sent = writes(hub)
    with pytest.raises(PublishError):
        publish(root)
    assert writes(hub) == sent
    new, units = publish(root, version="3.0.0")
    assert (str(new.version), str(units.version)) == ("2.0.0", "3.0.0")
    header = load_buffer_set(UNITS).header.datasets["demonstrations"]
    assert header.location == f"{LESSONS}@{new.published}"


def placed(hub: HubServer, tmp_path: Path, commit: str | None = None) -> Path:
    """Return a buffer set whose manifests name demonstrations on the Hub."""
    commit = commit or hub.push("datasets/others/lessons", GOLDEN / "demonstrations")
    root = copy_buffer_set(tmp_path / "placed")
    path = root / "manifests" / "manifest.json"
    header = json.loads(path.read_text(encoding="utf-8"))
    header["datasets"]["demonstrations"]["location"] = f"others/lessons@{commit}"
    path.write_text(json.dumps(header), encoding="utf-8")
    return root


@pytest.mark.slow
def test_a_buffer_set_of_published_demonstrations(hub: HubServer, tmp_path: Path) -> None:
    root = placed(hub, tmp_path)
    assert len(publish(root)) == 1
    assert hub.repositories.keys() == {"datasets/others/lessons", f"datasets/{UNITS}"}
    assert len(load_buffer(QUERY, "k1", buffer_set=UNITS, verify=True).sessions) == 2
    lessons, _ = publish(root, "someone/again", demonstrations_id="someone/mine")
    header = load_buffer_set("someone/again").header.datasets["demonstrations"]
    assert header.location == f"someone/mine@{lessons.published}"


def test_published_demonstrations_that_cannot_be_used(hub: HubServer, tmp_path: Path) -> None:
    commit = hub.push("datasets/others/lessons", GOLDEN / "distractors")
    with raises(PublishError):
        publish(placed(hub, tmp_path / "other", commit))
    with raises(HubError):
        publish(placed(hub, tmp_path / "missing", commit="a" * 40))
    root = placed(hub, tmp_path / "gated")
    hub.gated.add("datasets/others/lessons")
    with raises(HubError):
        publish(root)
    assert UNITS not in str(hub.repositories)


# --- permissions and existing repositories --------------------------------------------------------


@pytest.mark.parametrize(
    ("who", "exists"), [({"name": "stranger"}, False), ({"name": "someone", "write": False}, True)]
)
def test_a_token_without_rights(
    hub: HubServer, login: Login, who: dict[str, object], exists: bool
) -> None:
    if exists:
        hub.push(f"datasets/{LESSONS}", {"README.md": b"to come"})
        hub.push(f"datasets/{UNITS}", {"README.md": b"to come"})
    login(**who)
    with raises(HubError) as caught:
        publish(GOLDEN)
    assert "hf auth login" in str(caught.value.hint)
    assert hub.uploads() == [] and tags(hub, LESSONS) == {}


@pytest.mark.parametrize("token", ["hf_unknown", ""])
def test_invalid_login(
    hub: HubServer, run: Run, monkeypatch: pytest.MonkeyPatch, token: str
) -> None:
    monkeypatch.setenv("HF_TOKEN", token)
    monkeypatch.setattr(checks, "check_buffer_set", lambda *_: pytest.fail("checks take hours"))
    code, _, err = run("publish", GOLDEN, "--repo-id", UNITS, "--yes")
    assert (code, len(hub.requests) <= 1) == (1, True)
    assert "rejects your login" in err and "hf auth login" in err
    assert "was sent" not in err


def test_what_a_repository_may_hold(hub: HubServer) -> None:
    other = {"data/train.csv": b"1,2", "README.md": b"mine"}
    hub.push("datasets/someone/other", other)
    with raises(PublishError):
        publish(GOLDEN, "someone/other")
    assert writes(hub) == []
    hub.push(f"datasets/{UNITS}", {"README.md": b"to come", "LICENSE": b"free"})
    publish(GOLDEN)
    assert files(hub, UNITS)["LICENSE"] == b"free"
    assert files(hub, UNITS)["README.md"] != b"to come"
    hub.renamed[f"datasets/{UNITS}"] = "datasets/someone/new"
    hub.repositories["datasets/someone/new"] = hub.repositories.pop(f"datasets/{UNITS}")
    hub.repositories["datasets/someone/new"].name = "datasets/someone/new"
    with raises(HubError):
        publish(GOLDEN)
