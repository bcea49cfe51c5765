"""Buffer sets on a Hub, through the real client and a server on the loopback interface."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import worlds
from support.buffer_sets import GOLDEN, copy_buffer_set
from support.hub import BASE, BUFFER_SET, push_buffer_set, running_hub
from support.hub_server import HubServer
from support.messages import raises
from support.retrieval import make_index

from robomme_interference_data import load_buffer, load_buffer_set
from robomme_interference_data.build_dataset.verify.audit import audit_buffer_set
from robomme_interference_data.build_dataset.verify.buffer_set import verify_buffer_set
from robomme_interference_data.constants import MANIFEST_PATH
from robomme_interference_data.errors import (
    FormatError,
    HashMismatchError,
    MissingFileError,
    UnknownNameError,
)
from robomme_interference_data.evaluate.run.config import RunConfig
from robomme_interference_data.evaluate.run.evaluation import run_evaluation
from robomme_interference_data.retrieval.encoders.thumbnail import Thumbnail
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.storage.hub import locate

QUERY = "MoveCube/test/0"
VERSION = "data-1.0.0"
UNITS_WRONG = "someone/wrong-units"
PART = ("--families", "MoveCube", "--conditions", "k0", "--cameras", "front")


@pytest.fixture
def hub(hub: HubServer, tmp_path: Path) -> HubServer:
    push_buffer_set(hub, GOLDEN, tmp_path / "work")
    return hub


def test_a_buffer_equals_the_one_on_disk_and_a_second_load_makes_no_request(hub: HubServer) -> None:
    local = load_buffer(QUERY, "k3", buffer_set=GOLDEN)
    remote = load_buffer(QUERY, "k3", buffer_set=BUFFER_SET, revision=VERSION, verify=True)
    assert remote.manifest == local.manifest
    for camera in local.cameras:
        assert np.array_equal(remote.frames(camera), local.frames(camera))
    assert np.array_equal(remote.states, local.states)
    assert np.array_equal(remote.query.frame(), local.query.frame())
    before = len(hub.requests)
    load_buffer(QUERY, "k3", buffer_set=f"{BUFFER_SET}@{VERSION}", verify=True)
    assert len(hub.requests) == before


def test_no_more_is_downloaded_than_the_buffer_needs(hub: HubServer) -> None:
    buffer = load_buffer(QUERY, "k1", buffer_set=BUFFER_SET, revision=VERSION, cameras=["front"])
    downloads = hub.downloads()
    small = {"meta/info.json", "meta/interference.json", "meta/interference.parquet"}
    assert not any("/observation.images.wrist/" in path for path in downloads)
    assert {path for path in downloads if path.startswith("meta/")} == small
    assert sum(path.startswith("videos/") for path in downloads) == len(buffer.sessions)
    before = len(hub.requests)
    buffer.frames("front")
    _ = buffer.states
    assert len(hub.requests) == before


def test_what_is_published_is_not_planned_again(hub: HubServer) -> None:
    with raises(UnknownNameError) as caught:
        load_buffer(QUERY, "k2", buffer_set=BUFFER_SET)
    command = str(caught.value.command)
    assert f"build BUFFER_SET --demonstrations {BASE}@" in command and command.endswith("k7,k2")


def test_no_hint_says_to_build_what_is_published(hub: HubServer, tmp_path: Path, run: Any) -> None:
    """Where manifests and data are not of each other, only their publisher can mend it."""
    damaged = copy_buffer_set(tmp_path / "damaged")
    header = damaged / MANIFEST_PATH
    revision = load_buffer_set(damaged).header.datasets["distractors"].revision
    header.write_text(header.read_text().replace(revision, "0" * 64))
    push_buffer_set(hub, damaged, tmp_path / "units", UNITS_WRONG)
    with pytest.raises(HashMismatchError) as caught:
        load_buffer_set(UNITS_WRONG).load(QUERY, "k3")
    hint = str(caught.value.hint)
    assert f"hf cache rm dataset/{BASE} dataset/{UNITS_WRONG}," in hint and "publisher" in hint
    assert "--only manifests" not in hint
    with pytest.raises(HashMismatchError) as caught:
        load_buffer_set(damaged).load(QUERY, "k3")
    assert "build the manifests again" in str(caught.value.hint)


def test_a_version_stays_when_its_tag_is_moved_or_gone(hub: HubServer, tmp_path: Path) -> None:
    first = load_buffer_set(BUFFER_SET, revision=VERSION)
    hub.push(f"datasets/{BUFFER_SET}", {"README.md": b"another"}, VERSION)
    again = load_buffer_set(BUFFER_SET, revision=VERSION)
    assert again.location == first.location and again.location.startswith(f"{BUFFER_SET}@")


@pytest.mark.slow
def test_a_buffer_set_has_one_revision_wherever_it_lies(hub: HubServer, tmp_path: Path) -> None:
    published, local = load_buffer_set(BUFFER_SET), load_buffer_set(GOLDEN)
    assert published.revision == local.revision
    assert (published.name, local.name) == (BUFFER_SET, "buffer_set")
    assert [*published.manifests()] == [*local.manifests()]
    assert [*verify_buffer_set(published)] == []
    assert audit_buffer_set(published).leaks == []


def test_a_location_that_leads_elsewhere(own_buffers: Path) -> None:
    header = own_buffers / MANIFEST_PATH
    value = json.loads(header.read_text(encoding="utf-8"))
    for location in ("..", "/etc", "a/b", "a/b@main", "https://somewhere/a/b"):
        value["datasets"]["distractors"]["location"] = location
        header.write_text(json.dumps(value), encoding="utf-8")
        with raises(FormatError):
            load_buffer_set(own_buffers)


# --- fetch ---------------------------------------------------------------------------------------


Fetched = Callable[..., tuple[int, str]]


@pytest.fixture
def fetch(run: Any) -> Fetched:
    def call(*arguments: object) -> tuple[int, str]:
        code, out, err = run("fetch", *arguments)
        return code, err + out

    return call


def test_fetch_the_whole_buffer_set(hub: HubServer, fetch: Fetched, tmp_path: Path) -> None:
    code, output = fetch(f"{BUFFER_SET}@{VERSION}", "--to", tmp_path / "out", "--json")
    assert code == 0
    hub.down = True
    buffer_set = load_buffer_set(tmp_path / "out")
    assert [*verify_buffer_set(buffer_set)] == []
    assert len(buffer_set) == len(load_buffer_set(GOLDEN))
    folders = {path.name for path in (tmp_path / "out").iterdir()}
    assert folders >= {"demonstrations", "manifests", "meta", "data", "videos"}
    answer = json.loads(output[output.index("{\n") :])
    assert [one["missing_files"] for one in answer["repositories"]] == [
        one["files"] - known for one, known in zip(answer["repositories"], (6, 4), strict=True)
    ]


def test_fetch_a_part_twice(hub: HubServer, fetch: Fetched) -> None:
    part = (f"{BUFFER_SET}@{VERSION}", *PART)
    assert fetch(*part, "--dry-run")[0] == 0
    assert not [path for path in hub.downloads() if path.endswith(".mp4")]
    assert fetch(*part)[0] == 0
    videos = [path for path in hub.downloads() if path.endswith(".mp4")]
    assert len(videos) == 1 and "front" in videos[0]
    count = len(hub.downloads())
    code, output = fetch(*part)
    assert code == 0 and len(hub.downloads()) == count and "to fetch: 0 files" in output


def test_a_part_does_not_need_datasets_that_its_buffers_do_not_use(
    hub: HubServer, fetch: Fetched, tmp_path: Path
) -> None:
    work = tmp_path / "work"
    shutil.copytree(GOLDEN / "demonstrations", work / "shifted")
    header = json.loads((work / MANIFEST_PATH).read_text(encoding="utf-8"))
    stale = header["datasets"]["demonstrations"] | {"revision": "0" * 64, "location": None}
    header["datasets"] |= {"shifted": stale, "contradictions": stale}
    (work / MANIFEST_PATH).write_text(json.dumps(header), encoding="utf-8")
    hub.push(f"datasets/{BUFFER_SET}", work)
    assert fetch(BUFFER_SET, *PART, "--dry-run")[0] == 0
    code, output = fetch(BUFFER_SET, "--dry-run")
    assert code == 1 and "contradictions" in output


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--families", "MoveCub"], "MoveCub"),
        (["--cameras", "side"], "side"),
        (["--episodes", "40-49"], "no buffer"),
        (["--index", "thumbnail"], "lacks index"),
    ],
)
def test_what_cannot_be_fetched(
    hub: HubServer, fetch: Fetched, options: list[str], words: str
) -> None:
    code, output = fetch(f"{BUFFER_SET}@{VERSION}", *options)
    assert code == 1 and words in output


def test_fetch_is_for_repositories_and_mixes_no_buffer_sets(
    hub: HubServer, fetch: Fetched, tmp_path: Path
) -> None:
    assert fetch(GOLDEN)[0] == 1
    (tmp_path / "other" / "manifests").mkdir(parents=True)
    (tmp_path / "other" / "manifests" / "manifest.json").write_text("{}", encoding="utf-8")
    code, output = fetch(BUFFER_SET, "--to", tmp_path / "other")
    assert code == 1 and "no copy of a buffer set" in output


def test_only_text_can_name_a_repository(hub: HubServer, run: Any) -> None:
    with raises(MissingFileError):
        load_buffer_set(Path(BUFFER_SET))
    files = locate(BUFFER_SET, revision=VERSION)
    assert load_buffer_set(files.location).location == files.location
    with raises(MissingFileError):
        load_buffer_set(BASE)
    code, _, error = run("verify", BASE)
    assert code == 1 and f"{BASE}@" in error  # the command reads it as a repository


@pytest.mark.slow
@pytest.mark.parametrize("centered", [True, False])
def test_a_part_comes_with_its_embeddings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Any, centered: bool
) -> None:
    root, out, encoder = copy_buffer_set(tmp_path / "units"), tmp_path / "part", Thumbnail()
    encoder.centered = centered
    make_index(root, encoder)
    with running_hub(tmp_path / "cache", monkeypatch) as server:
        push_buffer_set(server, root, tmp_path / "work")
        assert run("fetch", BUFFER_SET, *PART, "--index", "thumbnail", "--to", out)[0] == 0
    found, expected = (
        load_buffer_set(one).load("MoveCube/test/0", "k0", cameras=["front"]) for one in (out, root)
    )
    assert np.array_equal(found.embeddings("thumbnail"), expected.embeddings("thumbnail"))
    (partial, _), (whole, _) = (
        run("retrieval-score", one, *PART[:4], "--json")[1:] for one in (out, root)
    )
    assert json.loads(partial)["cells"] == json.loads(whole)["cells"] != []


# --- every command takes a repository -------------------------------------------------------------


@pytest.mark.slow
def test_commands_print_the_same_for_a_repository_and_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Any
) -> None:
    root = copy_buffer_set(tmp_path / "units")
    make_index(root)
    commands = (
        ("list", "{}", "--json"),
        ("show", "{}", QUERY, "k3", "--json"),
        ("retrieve", "{}", QUERY, "k3", "--json"),
        ("retrieval-score", "{}", "--json"),
    )
    with running_hub(tmp_path / "cache", monkeypatch) as server:
        push_buffer_set(server, root, tmp_path / "work")
        for command in commands:
            results = [
                run(*(word.format(location) for word in command))
                for location in (root, f"{BUFFER_SET}@{VERSION}")
            ]
            assert results[0][0] == results[1][0] == 0, results
            local, remote = (
                json.loads(out.replace(f'"{BUFFER_SET}"', '"units"')) for _, out, _ in results
            )
            assert local == remote, command  # except for the buffer set's name


def test_a_run_on_a_repository_keeps_its_commit(
    hub: HubServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(worlds.BUFFER_SET, str(GOLDEN))
    config = {"simulator": "support.worlds:World", "families": ("MoveCube",), "episodes": "0"}
    rows = []
    for number, buffer_set in enumerate((BUFFER_SET, str(GOLDEN))):
        out = tmp_path / f"run-{number}"
        settings = RunConfig("replay", buffer_set, out, conditions=("k1",), **config)
        rows.append(run_evaluation(settings, executor=Serial()).rows[0])
    assert rows[0].revision == rows[1].revision and rows[0].status == rows[1].status
    header = json.loads((tmp_path / "run-0" / "run.json").read_text(encoding="utf-8"))
    commit = hub.repositories[f"datasets/{BUFFER_SET}"].find().oid
    assert header["invocations"][0]["settings"]["buffer_set"] == f"{BUFFER_SET}@{commit}"
