"""Files on a Hub, through the real client and a server on the loopback interface."""

import os
import pickle
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from huggingface_hub import constants
from support.hub_server import HubServer
from support.lerobot_layouts import write_lerobot
from support.messages import raises

from robomme_interference_data.build_dataset.sources import open_source
from robomme_interference_data.errors import (
    FormatError,
    HashMismatchError,
    HubError,
    InvalidOptionError,
    MissingFileError,
)
from robomme_interference_data.storage.files import LocalFiles
from robomme_interference_data.storage.hub import HubFiles, locate

Run = Callable[..., tuple[int, str, str]]
REPO = "someone/small"
DATASET = f"datasets/{REPO}"
FILES = {f"meta/part-{number}.json": b"%d" % number for number in range(4)}
FILES |= {"README.md": b"read me", "meta/deep/a.parquet": b"a"}


# --- where a location leads ----------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        "robomme",
        "a/b/../c",
        "a/b/.c",
        "a/b/c/",
        "/a/b",
        "~/a",
        "a/",
        "./a/b",
        "a//b",
        "a b/c",
        "a/b@",
        "@v1",
    ],
)
def test_invalid_locations_are_never_requested(hub: HubServer, text: str) -> None:
    with raises(InvalidOptionError):
        locate(text, "model")
    assert hub.requests == []


def test_folders_take_precedence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    files = locate("A-1/b.c_d@v1.0")
    assert isinstance(files, HubFiles) and (files.repo_id, files.revision) == ("A-1/b.c_d", "v1.0")
    (tmp_path / REPO).mkdir(parents=True)
    assert isinstance(locate(REPO), LocalFiles)
    assert locate(tmp_path).location == str(tmp_path)


def test_a_folder_of_a_repository(hub: HubServer) -> None:
    commit = hub.push(DATASET, FILES)
    files = locate(f"{REPO}/meta@main")
    assert isinstance(files, HubFiles)
    assert (files.repo_id, files.folder, files.revision) == (REPO, "meta/", "main")
    assert files.path("deep/a.parquet").read_bytes() == b"a"
    assert files.list("deep") == ["deep/a.parquet"]
    assert "README.md" not in files.sizes() and files.sizes()["part-3.json"] == 1
    assert files.location == f"{REPO}/meta@{commit}"
    again = locate(files.location)
    assert again.path("part-3.json") == files.path("part-3.json")
    deep = files.inside("deep")
    assert deep.location == f"{REPO}/meta/deep@{commit}"
    assert deep.path("a.parquet").read_bytes() == b"a"


# --- what is fetched -----------------------------------------------------------------------------


def test_path_and_list(hub: HubServer) -> None:
    commit = hub.push(DATASET, FILES)
    files = HubFiles(REPO)
    assert (files.describe(), hub.requests) == ("someone/small@main", [])  # no request yet
    assert files.path("README.md").read_bytes() == b"read me"
    assert files.list("meta") == sorted(name for name in FILES if name.startswith("meta/"))
    assert files.list("meta", ".parquet") == ["meta/deep/a.parquet"]
    assert files.list("nothing") == []
    assert files.describe() == files.location == f"someone/small@{commit}"
    before = len(hub.requests)
    assert files.path("README.md").read_bytes() == b"read me"
    assert len(hub.requests) == before  # from the cache, without a request


def test_a_revision_is_pinned_once(hub: HubServer) -> None:
    first = hub.push(DATASET, FILES)
    files = HubFiles(REPO)
    assert files.commit == first
    second = hub.push(DATASET, FILES | {"README.md": b"changed"})
    tagged = hub.push(DATASET, {"README.md": b"tagged"}, ref="v1.0")
    copy = pickle.loads(pickle.dumps(files))
    assert copy.path("README.md").read_bytes() == b"read me"
    assert HubFiles(REPO).commit == second
    assert HubFiles(REPO).path("README.md").read_bytes() == b"changed"
    assert HubFiles(REPO, first).path("README.md").read_bytes() == b"read me"
    assert HubFiles(REPO, "v1.0").commit == tagged
    assert HubFiles(REPO, "v1.0").path("README.md").read_bytes() == b"tagged"


@pytest.mark.parametrize("path", ["../../etc/passwd", "/etc/passwd"])
def test_no_path_leads_out(hub: HubServer, path: str) -> None:
    hub.push(DATASET, FILES)
    with raises(FormatError):
        HubFiles(REPO).path(path)
    assert hub.requests == []


# --- errors --------------------------------------------------------------------------------------


def test_missing_file(hub: HubServer) -> None:
    commit = hub.push(DATASET, FILES)
    with pytest.raises(MissingFileError) as caught:
        HubFiles(REPO).path("meta/info.json")
    assert f"meta/info.json is missing in someone/small@{commit}" in caught.value.message
    assert f"{hub.endpoint}/{DATASET}/tree/{commit}" in str(caught.value)


@pytest.mark.parametrize(
    ("repo", "revision", "hint"),
    [
        ("someone/smal", None, "hf auth login"),
        (REPO, "v9", "/tree/main"),
        (REPO, "0" * 40, "/tree/main"),
        ("someone/gated", None, "/datasets/someone/gated, then log in: hf auth login"),
    ],
)
def test_errors_of_the_hub(hub: HubServer, repo: str, revision: str, hint: str) -> None:
    hub.push(DATASET, FILES)
    hub.push(REPO, FILES)  # a model of the same name is another repository
    hub.push("datasets/someone/gated", FILES)
    hub.gated.add("datasets/someone/gated")
    with raises(HubError) as caught:
        HubFiles(repo, revision).path("README.md")
    assert hint in str(caught.value.hint)


def test_an_unreachable_hub(hub: HubServer, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        endpoint = f"http://127.0.0.1:{free.getsockname()[1]}"
        monkeypatch.setattr(constants, "ENDPOINT", endpoint)
    with raises(HubError) as caught:
        HubFiles("my/splt").path("README.md")
    assert "same command again" in str(caught.value.hint)


@pytest.mark.parametrize("revision", [None, "0" * 40])
def test_a_revoked_token(hub: HubServer, login: Callable[..., None], revision: str | None) -> None:
    hub.push(DATASET, FILES)
    login("someone")
    hub.tokens.clear()
    with raises(HubError) as caught:
        HubFiles(REPO, revision).path("README.md")
    assert "hf auth login (HF_TOKEN" in str(caught.value.hint)


def test_a_hub_that_is_down(hub: HubServer) -> None:
    commit = hub.push(DATASET, FILES)
    HubFiles(REPO).path("README.md")
    hub.down = True
    files = HubFiles(REPO)
    assert files.commit == commit
    assert files.path("README.md").read_bytes() == b"read me"
    with raises(HubError) as caught:
        HubFiles("someone/else").path("README.md")
    assert "same command again" in str(caught.value.hint)


def test_offline(hub: HubServer, offline: Callable[[], None]) -> None:
    commit = hub.push(DATASET, FILES)
    HubFiles(REPO).path("meta/part-1.json")
    assert HubFiles(REPO).list("meta/deep") == ["meta/deep/a.parquet"]
    offline()
    before = len(hub.requests)
    files = HubFiles(REPO)
    assert files.commit == commit
    assert files.path("meta/part-1.json").read_bytes() == b"1"
    assert files.list("meta/deep") == ["meta/deep/a.parquet"]
    with raises(HubError) as caught:
        files.path("meta/part-2.json")
    assert "unset HF_HUB_OFFLINE" in str(caught.value.hint)
    for ask in (lambda: HubFiles("a/b").commit, lambda: HubFiles("a/b", "0" * 40).list("meta")):
        with raises(HubError):
            ask()
    assert len(hub.requests) == before


def test_a_folder_that_comes_damaged(hub: HubServer) -> None:
    hub.push(DATASET, FILES)
    fault = hub.fault("GET", "/meta/part-1.*", wrong=True)
    with raises(HashMismatchError):
        HubFiles(REPO).list("meta")
    fault.times = 0
    before = len(hub.downloads())
    files = HubFiles(REPO)
    assert all(files.path(path).read_bytes() == FILES[path] for path in files.list("meta"))
    assert len(hub.downloads()) == before + 1  # nothing but what was damaged


@pytest.fixture
def no_links(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the client's cache hold copies, as where Windows allows no links."""
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_SYMLINKS", True)


@pytest.mark.usefixtures("no_links")
@pytest.mark.parametrize("path", ["meta/part-1.json", "data.parquet"])
def test_what_comes_damaged_into_a_cache_without_links(hub: HubServer, path: str) -> None:
    """A small file and a large one, whose digests the cache does not hold."""
    hub.push(DATASET, {"meta/part-1.json": b"{}", "data.parquet": b"PAR1" * 9})
    fault = hub.fault("GET", f".*{path}", wrong=True, times=2)
    for read in (lambda: HubFiles(REPO).path(path), lambda: HubFiles(REPO).snapshot(path)):
        with raises(HashMismatchError):
            read()
    fault.times = 0
    files = HubFiles(REPO)
    assert files.path(path) == files.snapshot(path) / path
    assert not files.path(path).is_symlink()
    before = len(hub.downloads())
    assert HubFiles(REPO).path(path).read_bytes() in (b"{}", b"PAR1" * 9)
    assert len(hub.downloads()) == before


@pytest.mark.usefixtures("no_links")
def test_names_that_look_like_digests(hub: HubServer) -> None:
    """Where the cache has no links, the names of its files are those of the repository."""
    named = [f"blobs/{'ab' * 20}", f"blobs/{'cd' * 32}", f"{'ef' * 20}"]
    hub.push(DATASET, {name: name.encode() for name in named})
    for _ in range(2):
        files = HubFiles(REPO)
        assert [files.path(name).read_bytes() for name in named] == [n.encode() for n in named]
        assert files.list("blobs") == named[:2]


# --- no address of a Hub -------------------------------------------------------------------------


@pytest.mark.parametrize("given", ["", "http://", "http://[", "http://a:b", "ftp://a"])
def test_no_address_of_a_hub(monkeypatch: pytest.MonkeyPatch, run: Run, given: str) -> None:
    monkeypatch.setenv("HF_ENDPOINT", given)
    with pytest.raises(InvalidOptionError, match="HF_ENDPOINT .* such as https://huggingface.co"):
        HubFiles(REPO)
    code, out, err = run("fetch", REPO)
    assert (code, out) == (1, "")
    assert repr(given) in err and "unset HF_ENDPOINT" in err
    monkeypatch.setenv("HF_ENDPOINT", "http://[::1]:80/hub")
    assert HubFiles(REPO).repo_id == REPO


def test_a_client_that_cannot_be_imported(tmp_path: Path) -> None:
    """The client reads the address when it is imported, and ends there."""
    environment = os.environ | {"HF_ENDPOINT": "http://[", "HF_HUB_OFFLINE": "0"}
    command = [sys.executable, "-m", "robomme_interference_data.cli.main", "fetch", REPO]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr and "unset HF_ENDPOINT" in done.stderr


# --- a LeRobot dataset on the Hub ----------------------------------------------------------------


@pytest.mark.parametrize("version", ["v3.0", "v2.1"])
def test_a_source_fetches_what_it_needs_and_opens_offline_again(
    hub: HubServer, tmp_path: Path, offline: Callable[[], None], version: str
) -> None:
    made = write_lerobot(tmp_path / "made", version=version, stored="video")
    (made / "videos/of-no-episode.mkv").write_bytes(b"none")
    commit = hub.push(DATASET, made)
    source = open_source(f"lerobot:{REPO}")
    assert source.provenance == {"kind": "lerobot", "repo": REPO, "revision": commit}
    episodes = source.episodes()
    assert hub.downloads()
    assert all(path.startswith("meta/") for path in hub.downloads())
    before = len(hub.downloads())
    copy, again = pickle.loads(pickle.dumps((source, episodes[1])))
    assert len(list(copy.read(again, ("front",)).frames)) == 7
    assert len(hub.downloads()) == before + 2  # the data file and one video
    offline()
    hub.down = True
    source = open_source(f"lerobot:{REPO}")
    assert source.provenance["revision"] == commit
    assert len(list(source.read(source.episodes()[1], ("front",)).frames)) == 7
    with raises(HubError):
        list(source.read(source.episodes()[1], ("wrist",)).frames)


def test_a_source_in_a_folder_of_a_repository(hub: HubServer, tmp_path: Path) -> None:
    made = write_lerobot(tmp_path / "made")
    files = {path.relative_to(made): path for path in made.rglob("*") if path.is_file()}
    content = {f"arm/pick/{name.as_posix()}": path.read_bytes() for name, path in files.items()}
    commit = hub.push(DATASET, content | {"meta/info.json": b"of another dataset"})
    source = open_source(f"lerobot:{REPO}/arm/pick@main")
    assert source.provenance == {
        **{"kind": "lerobot", "repo": REPO, "revision": commit, "folder": "arm/pick"}
    }
    expected = open_source(f"lerobot:{made}")
    for episode, other in zip(source.episodes(), expected.episodes(), strict=True):
        ours, theirs = (one.read(e, None) for one, e in ((source, episode), (expected, other)))
        for frame, recorded in zip(ours.frames, theirs.frames, strict=True):
            assert np.array_equal(frame.images["front"], recorded.images["front"])


def test_the_known_repositories_are_of_robomme(hub: HubServer, tmp_path: Path) -> None:
    hub.push("datasets/lerobot/robomme", write_lerobot(tmp_path / "made"))
    source = open_source("lerobot:lerobot/robomme")
    assert source.read(source.episodes()[0], None).simulator == "robomme"
