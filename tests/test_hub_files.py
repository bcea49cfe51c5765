"""Files of datasets on a Hub, through the real client and a server on the loopback interface."""

import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hub_server import HubServer
from huggingface_hub import constants
from lerobot_factory import (
    MOVE,
    SMALL,
    write_small_families,
    write_v3_metadata,
    write_v21,
    write_video,
)

from robomme_interference_data.build_dataset.sources.lerobot import LeRobotSource
from robomme_interference_data.errors import HubError, MissingFileError
from robomme_interference_data.hub import HubFiles, is_repo_id

REPO = "someone/small"
FILES = {f"meta/part-{number}.json": b"%d" % number for number in range(8)}
FILES |= {"README.md": b"read me", "meta/deep/a.parquet": b"a"}


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[HubServer]:
    with HubServer().running() as server:
        template = server.endpoint + "/{repo_id}/resolve/{revision}/{filename}"
        monkeypatch.setattr(constants, "ENDPOINT", server.endpoint)
        monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
        monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
        monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
        yield server


@pytest.fixture
def offline(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    return lambda: monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)


@pytest.mark.parametrize("text", ["lerobot/robomme", "a/b", "A-1/b.c_d"])
def test_repo_id(text: str) -> None:
    assert is_repo_id(text)


@pytest.mark.parametrize("text", ["robomme", "a/b/c", "./a", "/a/b", "~/a", "a/", "a b/c", ""])
def test_no_repo_id(text: str) -> None:
    assert not is_repo_id(text)


def test_nothing_is_asked_before_it_is_needed(hub: HubServer) -> None:
    files = HubFiles(REPO)
    assert files.describe() == "someone/small@main"
    assert hub.requests == []


def test_path_and_list(hub: HubServer) -> None:
    commit = hub.push(REPO, FILES)
    files = HubFiles(REPO)
    assert files.path("README.md").read_bytes() == b"read me"
    assert files.list("meta") == sorted(name for name in FILES if name.startswith("meta/"))
    assert files.list("meta", ".parquet") == ["meta/deep/a.parquet"]
    assert files.list("nothing") == []
    assert files.describe() == f"someone/small@{commit}"
    assert hub.downloads() == ["README.md"]
    before = len(hub.requests)
    assert files.path("README.md").read_bytes() == b"read me"
    assert len(hub.requests) == before  # from the cache, without a request


def test_revision_is_pinned_once(hub: HubServer) -> None:
    first = hub.push(REPO, FILES)
    files = HubFiles(REPO)
    assert files.commit == first
    second = hub.push(REPO, FILES | {"README.md": b"changed"})
    copy = pickle.loads(pickle.dumps(files))
    assert copy.path("README.md").read_bytes() == b"read me"
    assert HubFiles(REPO).commit == second
    assert HubFiles(REPO).path("README.md").read_bytes() == b"changed"
    assert HubFiles(REPO, first).path("README.md").read_bytes() == b"read me"


def test_branches_and_tags(hub: HubServer) -> None:
    hub.push(REPO, FILES)
    tagged = hub.push(REPO, {"README.md": b"tagged"}, ref="v1.0")
    assert HubFiles(REPO, "v1.0").commit == tagged
    assert HubFiles(REPO, "v1.0").path("README.md").read_bytes() == b"tagged"


def test_missing_file(hub: HubServer) -> None:
    commit = hub.push(REPO, FILES)
    with pytest.raises(MissingFileError) as caught:
        HubFiles(REPO).path("meta/info.json")
    assert f"meta/info.json is missing in someone/small@{commit}" in str(caught.value)
    assert f"{hub.endpoint}/datasets/{REPO}/tree/{commit}" in str(caught.value)


def test_unknown_repository(hub: HubServer) -> None:
    with pytest.raises(HubError) as caught:
        HubFiles("someone/smal").path("README.md")
    assert f"there is no dataset repository 'someone/smal' on {hub.endpoint}" in str(caught.value)
    assert "hf auth login" in str(caught.value)


def test_unknown_revision(hub: HubServer) -> None:
    hub.push(REPO, FILES)
    with pytest.raises(HubError, match="has no revision 'v9'"):
        HubFiles(REPO, "v9").path("README.md")
    with pytest.raises(HubError, match="has no revision '0000"):
        HubFiles(REPO, "0" * 40).path("README.md")


def test_gated_repository(hub: HubServer) -> None:
    hub.push(REPO, FILES)
    hub.gated.add(REPO)
    for ask in (lambda: HubFiles(REPO).commit, lambda: HubFiles(REPO, "0" * 40).path("README.md")):
        with pytest.raises(HubError) as caught:
            ask()
        assert "is gated" in str(caught.value)
        assert f"{hub.endpoint}/datasets/{REPO}" in str(caught.value)
        assert "hf auth login" in str(caught.value)


def test_offline_with_a_cache(hub: HubServer, offline: Callable[[], None]) -> None:
    commit = hub.push(REPO, FILES)
    HubFiles(REPO).path("meta/part-1.json")
    offline()
    asked = len(hub.requests)
    files = HubFiles(REPO)
    assert files.commit == commit
    assert files.path("meta/part-1.json").read_bytes() == b"1"
    assert files.list("meta") == ["meta/part-1.json"]
    with pytest.raises(HubError) as caught:
        files.path("meta/part-2.json")
    text = str(caught.value)
    assert "meta/part-2.json of the dataset repository 'someone/small'" in text
    assert "HF_HUB_OFFLINE is set" in text
    command = f"hf download --repo-type dataset {REPO} --revision {commit} meta/part-2.json"
    assert f"HF_HUB_OFFLINE=0 {command}" in text
    assert len(hub.requests) == asked


def test_offline_without_a_cache(hub: HubServer, offline: Callable[[], None]) -> None:
    offline()
    for ask in (lambda: HubFiles(REPO).commit, lambda: HubFiles(REPO, "0" * 40).list("meta")):
        with pytest.raises(HubError, match="not in the cache, and HF_HUB_OFFLINE is set"):
            ask()


def test_hub_that_is_down(hub: HubServer) -> None:
    commit = hub.push(REPO, FILES)
    HubFiles(REPO).path("README.md")
    hub.down = True
    files = HubFiles(REPO)
    assert files.commit == commit
    assert files.path("README.md").read_bytes() == b"read me"
    with pytest.raises(HubError, match=r"the Hub cannot be reached: .*503(.|\n)*Try again"):
        HubFiles("someone/else").commit  # noqa: B018  # the property asks the Hub


def test_client_settings_are_honoured(hub: HubServer, tmp_path: Path) -> None:
    commit = hub.push(REPO, FILES)
    code = (
        "from robomme_interference_data.hub import HubFiles\n"
        f"files = HubFiles({REPO!r})\nprint(files.commit, files.path('README.md').read_text())"
    )
    settings = {
        "HF_ENDPOINT": hub.endpoint,
        "HF_HOME": str(tmp_path / "home"),
        "HF_HUB_OFFLINE": "0",
    }
    for offline in ("0", "1"):
        environment = os.environ | settings | {"HF_HUB_OFFLINE": offline}
        done = subprocess.run(
            [sys.executable, "-c", code],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stdout == f"{commit} read me\n"
    assert hub.downloads() == ["README.md"]
    assert list((tmp_path / "home").rglob("README.md"))


# --- a LeRobot dataset on the Hub ------------------------------------------------------------


def test_only_what_is_needed_is_downloaded_v3(hub: HubServer, tmp_path: Path) -> None:
    write_v3_metadata(tmp_path, ["fold it"] * 4, family=["Towel"] * 4)
    frames = np.zeros((4, 256, 256, 3), np.uint8)
    frames[2] = 200
    video = "videos/image/chunk-000/file-000.mp4"
    write_video(tmp_path / video, frames, "mpeg4", "yuv420p")
    (tmp_path / "videos/image/chunk-000/file-001.mp4").write_bytes(b"of no episode")
    commit = hub.push(REPO, tmp_path)
    source = LeRobotSource(REPO)
    assert hub.requests == []
    episodes = source.episodes()
    assert source.provenance == {"kind": "lerobot", "repo": REPO, "revision": commit}
    assert sorted(hub.downloads()) == [
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/info.json",
        "meta/tasks.parquet",
    ]
    assert {episode.key.files for episode in episodes} == {(commit,)}
    (frame,) = source.read(episodes[2])
    assert 190 < frame.images["front"].mean() < 210
    assert hub.downloads()[3:] == ["data/chunk-000/file-000.parquet", video]


def test_only_what_is_needed_is_downloaded_v21(hub: HubServer, tmp_path: Path) -> None:
    write_v21(tmp_path / "v21", SMALL)
    hub.push(REPO, tmp_path / "v21")
    source = LeRobotSource(REPO, families_file=write_small_families(tmp_path))
    episodes = source.episodes()
    assert [episode.demonstration_length for episode in episodes] == [5, 0, 9]
    assert sorted(hub.downloads()) == [
        "data/chunk-000/episode_000000.parquet",  # are its images PNG?
        "meta/episodes.jsonl",
        "meta/episodes_stats.jsonl",
        "meta/info.json",
        "meta/tasks.jsonl",
    ]
    copy, again = pickle.loads(pickle.dumps((source, episodes[2])))
    assert len(list(copy.read(again))) == 9
    assert hub.downloads()[5:] == ["data/chunk-000/episode_000001.parquet"]


def test_cached_dataset_is_read_offline(
    hub: HubServer, tmp_path: Path, offline: Callable[[], None]
) -> None:
    write_v21(tmp_path / "v21", SMALL)
    commit = hub.push(REPO, tmp_path / "v21")
    families = write_small_families(tmp_path)
    source = LeRobotSource(REPO, families_file=families)
    list(source.read(source.episodes()[2]))
    offline()
    source = LeRobotSource(REPO, families_file=families)
    episodes = source.episodes()
    assert source.provenance["revision"] == commit
    assert len(list(source.read(episodes[2]))) == 9
    with pytest.raises(HubError, match=r"episode_000002\.parquet of the dataset repository"):
        next(source.read(episodes[1]))


def test_robomme_repository_names_its_simulator(hub: HubServer, tmp_path: Path) -> None:
    write_v21(tmp_path / "v21", SMALL[:1], marks=False, stats=False)
    hub.push("lerobot/robomme", tmp_path / "v21")
    (tmp_path / "f.csv").write_text("episode_index,family\n0,MoveCube\n")
    (episode,) = LeRobotSource("lerobot/robomme", families_file=tmp_path / "f.csv").episodes()
    assert episode.simulator == "robomme"
    assert episode.goals == (MOVE,)
    assert episode.demonstration_length is None


def test_revision_of_a_source(hub: HubServer, tmp_path: Path) -> None:
    write_v21(tmp_path / "v21", SMALL)
    old = hub.push(REPO, tmp_path / "v21")
    hub.push(REPO, FILES)
    source = LeRobotSource(REPO, families_file=write_small_families(tmp_path), revision=old[:40])
    assert len(source.episodes()) == 3
    assert source.provenance["revision"] == old
    with pytest.raises(MissingFileError, match=r"is no LeRobot dataset: meta/info.json is missing"):
        LeRobotSource(REPO).episodes()
