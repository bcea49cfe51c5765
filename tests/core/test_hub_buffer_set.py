"""Buffer sets on a Hub, through the real client and a server on the loopback interface."""

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import worlds
from support.buffer_sets import GOLDEN, copy_buffer_set
from support.hub import BASE, BUFFER_SET, push_buffer_set, running_hub
from support.hub_server import HubServer
from support.retrieval import make_index

from robomme_interference_data import load_buffer, load_buffer_set
from robomme_interference_data.build_dataset.audit import audit_buffer_set
from robomme_interference_data.build_dataset.verify import verify_buffer_set
from robomme_interference_data.cli.main import app
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


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[HubServer]:
    with running_hub(tmp_path / "cache", monkeypatch) as server:
        push_buffer_set(server, GOLDEN, tmp_path / "work")
        yield server


def test_a_buffer_is_the_one_on_disk(hub: HubServer) -> None:
    here = load_buffer(QUERY, "k3", buffer_set=GOLDEN)
    there = load_buffer(QUERY, "k3", buffer_set=BUFFER_SET, revision=VERSION, verify=True)
    assert there.manifest == here.manifest
    for camera in here.cameras:
        assert np.array_equal(there.frames(camera), here.frames(camera))
    assert np.array_equal(there.states, here.states)
    assert np.array_equal(there.query.frame(), here.query.frame())


def test_no_more_is_downloaded_than_the_buffer_needs(hub: HubServer) -> None:
    buffer = load_buffer(QUERY, "k1", buffer_set=BUFFER_SET, revision=VERSION, cameras=["front"])
    found = set(hub.downloads())
    small = {"meta/info.json", "meta/interference.json", "meta/interference.parquet"}
    numbers = {0} | {entry.episode_index for entry in buffer.manifest.sessions[1:]}
    assert {path for path in found if "/observation.images.wrist/" in path} == set()
    assert {path for path in found if path.startswith("meta/")} == small
    videos = [path for path in hub.downloads() if path.startswith("videos/")]
    assert len(videos) == len(buffer.sessions) and len(numbers) <= len(videos)
    before = len(hub.requests)
    buffer.frames("front")
    _ = buffer.states
    assert len(hub.requests) == before


def test_what_is_published_is_not_planned_again(hub: HubServer) -> None:
    with pytest.raises(UnknownNameError, match="condition 'k2' is not in") as caught:
        load_buffer(QUERY, "k2", buffer_set=BUFFER_SET)
    command = str(caught.value.command)
    assert f"new-buffer-set BUFFER_SET --demonstrations {BASE}@" in command and command.endswith(
        "k7,k2"
    )


def test_no_hint_says_to_build_what_is_published(hub: HubServer, tmp_path: Path, run: Any) -> None:
    """Where manifests and data are not of each other, only their publisher can mend it."""
    damaged = copy_buffer_set(tmp_path / "damaged")
    header = damaged / MANIFEST_PATH
    text, revision = (
        header.read_text(),
        load_buffer_set(damaged).header.datasets["distractors"].revision,
    )
    header.write_text(text.replace(revision, "0" * 64))
    push_buffer_set(hub, damaged, tmp_path / "units", UNITS_WRONG)
    with pytest.raises(HashMismatchError) as caught:
        load_buffer_set(UNITS_WRONG).load(QUERY, "k3")
    hint = str(caught.value.hint)
    assert f"hf cache rm dataset/{BASE} dataset/{UNITS_WRONG}," in hint and "publisher" in hint
    assert "build manifests" not in hint
    with pytest.raises(HashMismatchError) as caught:
        load_buffer_set(damaged).load(QUERY, "k3")
    assert "build the manifests again" in str(caught.value.hint)


def test_a_second_load_makes_no_request(hub: HubServer) -> None:
    load_buffer(QUERY, "k3", buffer_set=BUFFER_SET, revision=VERSION)
    before = len(hub.requests)
    load_buffer(QUERY, "k3", buffer_set=f"{BUFFER_SET}@{VERSION}", verify=True)
    assert len(hub.requests) == before


def test_a_version_stays_when_its_tag_is_moved_or_gone(hub: HubServer, tmp_path: Path) -> None:
    first = load_buffer_set(BUFFER_SET, revision=VERSION)
    hub.push(f"datasets/{BUFFER_SET}", {"README.md": b"another"}, VERSION)
    again = load_buffer_set(BUFFER_SET, revision=VERSION)
    assert again.location == first.location and again.location.startswith(f"{BUFFER_SET}@")


def test_a_buffer_set_has_one_revision_wherever_it_lies(hub: HubServer, tmp_path: Path) -> None:
    published, local = load_buffer_set(BUFFER_SET), load_buffer_set(GOLDEN)
    assert published.revision == local.revision
    assert (published.name, local.name) == (BUFFER_SET, "buffer_set")
    assert [*published.manifests()] == [*local.manifests()]


def test_verify_and_audit_take_a_repository(hub: HubServer) -> None:
    buffer_set = load_buffer_set(BUFFER_SET, revision=VERSION)
    assert [*verify_buffer_set(buffer_set)] == []
    assert audit_buffer_set(buffer_set).leaks == []


def test_a_place_that_leads_elsewhere(tmp_path: Path) -> None:
    root = shutil.copytree(GOLDEN, tmp_path / "buffer_set")
    header = root / "manifests" / "manifest.json"
    value = json.loads(header.read_text(encoding="utf-8"))
    for place in ("..", "/etc", "a/b", "a/b@main", "https://somewhere/a/b"):
        value["datasets"]["distractors"]["location"] = place
        header.write_text(json.dumps(value), encoding="utf-8")
        with pytest.raises(FormatError, match="location"):
            load_buffer_set(root)


# --- fetch ---------------------------------------------------------------------------------------


Fetched = Callable[..., tuple[int, str]]


@pytest.fixture
def fetch(capfd: pytest.CaptureFixture[str]) -> Fetched:
    from typer.testing import CliRunner

    def run(*arguments: object) -> tuple[int, str]:
        result = CliRunner().invoke(app, ["fetch", *map(str, arguments)])
        return result.exit_code, result.output + str(result.exception or "")

    return run


def test_fetch_the_whole_buffer_set(hub: HubServer, fetch: Fetched, tmp_path: Path) -> None:
    code, told = fetch(f"{BUFFER_SET}@{VERSION}", "--to", tmp_path / "here", "--json")
    assert code == 0
    hub.down = True
    buffer_set = load_buffer_set(tmp_path / "here")
    assert [*verify_buffer_set(buffer_set)] == [] and len(buffer_set) == len(
        load_buffer_set(GOLDEN)
    )
    found = {p.name for p in (tmp_path / "here").iterdir()}
    assert found >= {"demonstrations", "manifests", "meta", "data", "videos"}
    answer = json.loads(told[told.index("{\n") :])
    assert [one["missing_files"] for one in answer["repositories"]] == [
        one["files"] - known for one, known in zip(answer["repositories"], (5, 3), strict=True)
    ]


def test_fetch_a_part_twice(hub: HubServer, fetch: Fetched) -> None:
    wanted = (
        f"{BUFFER_SET}@{VERSION}",
        "--families",
        "MoveCube",
        "--conditions",
        "k0",
        "--cameras",
        "front",
    )
    assert fetch(*wanted, "--dry-run")[0] == 0
    assert not [path for path in hub.downloads() if path.endswith(".mp4")]
    assert fetch(*wanted)[0] == 0
    videos = [path for path in hub.downloads() if path.endswith(".mp4")]
    assert len(videos) == 1 and "front" in videos[0]
    count = len(hub.downloads())
    code, told = fetch(*wanted)
    assert code == 0 and len(hub.downloads()) == count and "to fetch: 0 files" in told


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
    part = ("--families", "MoveCube", "--conditions", "k0", "--cameras", "front", "--dry-run")
    assert fetch(BUFFER_SET, *part)[0] == 0
    code, output = fetch(BUFFER_SET, "--dry-run")
    assert code == 1 and "contradictions" in output


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--families", "MoveCub"], "MoveCub"),
        (["--conditions", "k1,k9"], "Planned there: no-history k0 k1 k3 k7"),
        (["--cameras", "side"], "side"),
        (["--episodes", "40-49"], "no buffer"),
        (["--index", "thumbnail"], "lacks index"),
    ],
)
def test_what_cannot_be_fetched(
    hub: HubServer, fetch: Fetched, options: list[str], words: str
) -> None:
    code, told = fetch(f"{BUFFER_SET}@{VERSION}", *options)
    assert code == 1 and words in told


def test_fetch_is_for_repositories_and_mixes_no_splits(
    hub: HubServer, fetch: Fetched, tmp_path: Path
) -> None:
    assert fetch(GOLDEN)[0] == 1
    (tmp_path / "other" / "manifests").mkdir(parents=True)
    (tmp_path / "other" / "manifests" / "manifest.json").write_text("{}", encoding="utf-8")
    code, told = fetch(BUFFER_SET, "--to", tmp_path / "other")
    assert code == 1 and "another buffer set" in told


def test_only_text_can_name_a_repository(hub: HubServer, run: Any) -> None:
    with pytest.raises(MissingFileError, match="there is no folder"):
        load_buffer_set(Path(BUFFER_SET))
    files = locate(BUFFER_SET, revision=VERSION)
    assert locate(files.location).location == files.location
    assert load_buffer_set(files.location).location == files.location
    code, _, error = run("verify", BASE)
    assert code == 1 and f"{BASE}@" in error  # the command takes it for a repository


def test_a_repository_that_is_no_buffer_set(hub: HubServer) -> None:
    with pytest.raises(MissingFileError, match="is not a buffer set"):
        load_buffer_set(BASE)


@pytest.mark.parametrize("centred", [True, False])
def test_a_part_comes_with_its_embeddings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Any, centred: bool
) -> None:
    root, out, encoder = copy_buffer_set(tmp_path / "units"), tmp_path / "part", Thumbnail()
    encoder.centred = centred
    make_index(root, encoder)
    part = ("--families", "MoveCube", "--conditions", "k1", "--cameras", "front")
    with running_hub(tmp_path / "cache", monkeypatch) as server:
        push_buffer_set(server, root, tmp_path / "work")
        assert run("fetch", BUFFER_SET, *part, "--index", "thumbnail", "--to", out)[0] == 0
    found, expected = (
        load_buffer_set(one).load("MoveCube/test/0", "k1", cameras=["front"]) for one in (out, root)
    )
    assert np.array_equal(found.embeddings("thumbnail"), expected.embeddings("thumbnail"))
    (told, _), (whole, _) = (
        run("retrieval-score", one, *part[:4], "--json")[1:] for one in (out, root)
    )
    assert json.loads(told)["cells"] == json.loads(whole)["cells"] != []


# --- every command takes a repository -------------------------------------------------------------


def test_commands_say_the_same_of_a_repository_as_of_a_folder(
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
            told = [
                run(*(word.format(place) for word in command))
                for place in (root, f"{BUFFER_SET}@{VERSION}")
            ]
            assert told[0][0] == told[1][0] == 0, told
            here, there = (
                json.loads(out.replace(f'"{BUFFER_SET}"', '"units"')) for _, out, _ in told
            )
            assert here == there, command  # but for the buffer set's name


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
    assert header["starts"][0]["settings"]["buffer_set"] == f"{BUFFER_SET}@{commit}"
