"""The Hub's own client against the Hub on the loopback interface that other tests rely on."""

import hashlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from huggingface_hub import (
    CommitOperationAdd,
    CommitOperationDelete,
    HfApi,
    constants,
    snapshot_download,
)
from huggingface_hub.errors import (
    EntryNotFoundError,
    GatedRepoError,
    HfHubHTTPError,
    RepositoryNotFoundError,
    RevisionNotFoundError,
)
from support.hub_http import Answer
from support.hub_repositories import Blob
from support.hub_server import HubServer

REPO = "someone/small"
DATASET = f"datasets/{REPO}"
CARD = b"---\nlicense: mit\n---\nread me"
VIDEO = bytes(range(256)) * 300
FILES = {"README.md": CARD, "meta/info.json": b"{}", "videos/a.mp4": VIDEO, "empty": b""}


@pytest.fixture
def api(hub: HubServer, login: Callable[..., None]) -> HfApi:
    """The client, logged in as the owner of a repository that is there."""
    login("someone")
    api = HfApi()
    api.create_repo(REPO, repo_type="dataset")
    return api


def commit(api: HfApi, files: dict[str, bytes], parent: str | None = None) -> str:
    adds = [CommitOperationAdd(path, data) for path, data in files.items()]
    made = api.create_commit(
        REPO, adds, commit_message="c", repo_type="dataset", parent_commit=parent
    )
    return str(made.oid)


def head(api: HfApi) -> str:
    return str(api.dataset_info(REPO).sha)


def download(api: HfApi, path: str, revision: str | None = None) -> bytes:
    found = api.hf_hub_download(REPO, path, repo_type="dataset", revision=revision)
    return Path(found).read_bytes()


# --- what is kept --------------------------------------------------------------------------------


def test_object_ids_are_those_of_git_and_of_git_lfs() -> None:
    # printf 'hello\n' | git hash-object --stdin
    assert Blob(b"hello\n", large=False).oid == "ce013625030ba8dba906f756967f9e9ca394464a"
    large = Blob(b"hello\n", large=True)
    digest = "5891b5b522d5df086d0ff0b110fbd9d21bb4fc7163af34d08286a2e846f6be03"
    told = f"version https://git-lfs.github.com/spec/v1\noid sha256:{digest}\nsize 6\n"
    assert (large.etag, large.pointer.decode()) == (digest, told)
    assert large.oid == hashlib.sha1(b"blob 126\0" + told.encode()).hexdigest()


@pytest.mark.parametrize(
    ("span", "expected"),
    [
        ("bytes=2-", (206, b"cdef", "bytes 2-5/6")),
        ("bytes=1-2", (206, b"bc", "bytes 1-2/6")),
        ("bytes=4-99", (206, b"ef", "bytes 4-5/6")),
        ("bytes=-2", (206, b"ef", "bytes 4-5/6")),
        ("bytes=6-", (416, b"", "bytes */6")),
        ("words=1-2", (200, b"abcdef", None)),
    ],
)
def test_ranges(span: str, expected: tuple[int, bytes, str | None]) -> None:
    from http.client import HTTPMessage

    asked = HTTPMessage()
    asked["Range"] = span
    answer = Answer(b"abcdef")
    answer.fit(asked)
    assert (answer.status, answer.body, answer.headers.get("Content-Range")) == expected


def test_a_new_repository(hub: HubServer, api: HfApi) -> None:
    assert api.whoami()["name"] == "someone"
    assert api.list_repo_files(REPO, repo_type="dataset") == [".gitattributes"]
    assert str(api.create_repo(REPO, repo_type="dataset", exist_ok=True)).endswith(DATASET)
    with pytest.raises(HfHubHTTPError, match="already created"):
        api.create_repo(REPO, repo_type="dataset")
    api.create_repo("someone/secret", repo_type="dataset", private=True)
    assert api.dataset_info("someone/secret").private
    with pytest.raises(RepositoryNotFoundError):
        HfApi(token=False).dataset_info("someone/secret")


def test_a_commit_of_small_and_large_files(hub: HubServer, api: HfApi, tmp_path: Path) -> None:
    made = commit(api, FILES, parent=head(api))
    found = snapshot_download(REPO, repo_type="dataset", local_dir=tmp_path / "copy")
    for path, data in FILES.items():
        assert (Path(found) / path).read_bytes() == data
    assert hub.uploads() == [hashlib.sha256(VIDEO).hexdigest()]
    listed = {one.path: one for one in api.list_repo_tree(REPO, "videos", repo_type="dataset")}
    assert listed["videos/a.mp4"].lfs.sha256 == hashlib.sha256(VIDEO).hexdigest()
    assert listed["videos/a.mp4"].size == len(VIDEO)
    info = api.dataset_info(REPO, files_metadata=True)
    assert (info.sha, {one.rfilename: one.size for one in info.siblings}["empty"]) == (made, 0)
    # Once more: nothing has changed, so nothing is sent and no commit is made.
    assert commit(api, FILES) == made
    assert len(hub.uploads()) == 1


def test_a_large_file_that_is_there_is_not_sent_again(hub: HubServer, api: HfApi) -> None:
    hub.fault("POST", "/commit/", status=500)
    with pytest.raises(HfHubHTTPError, match="500"):
        commit(api, FILES)
    commit(api, FILES | {"videos/b.mp4": VIDEO[:1000]})
    assert len(hub.uploads()) == len(set(hub.uploads())) == 2


def test_files_and_folders_are_deleted(hub: HubServer, api: HfApi) -> None:
    commit(api, FILES)
    gone = [CommitOperationDelete("videos/"), CommitOperationDelete("empty")]
    api.create_commit(REPO, gone, commit_message="d", repo_type="dataset")
    left = api.list_repo_files(REPO, repo_type="dataset")
    assert left == [".gitattributes", "README.md", "meta/info.json"]
    with pytest.raises(EntryNotFoundError):
        api.create_commit(REPO, gone[1:], commit_message="d", repo_type="dataset")


def test_a_stale_parent_is_refused(hub: HubServer, api: HfApi) -> None:
    old = head(api)
    new = commit(api, {"a": b"a"}, parent=old)
    with pytest.raises(HfHubHTTPError, match="412") as caught:
        commit(api, {"b": b"b"}, parent=old)
    assert (caught.value.response.status_code, head(api)) == (412, new)


def test_trees_come_in_pages(hub: HubServer, api: HfApi) -> None:
    hub.page = 4
    files = {f"data/{number // 3}/{number}.txt": b"%d" % number for number in range(9)}
    commit(api, files)
    asked = len(hub.asked)
    found = list(api.list_repo_tree(REPO, recursive=True, repo_type="dataset"))
    assert [one.path for one in found] == sorted(
        [".gitattributes", "data", "data/0", "data/1", "data/2", *files]
    )
    assert len(hub.asked) - asked == 4  # 14 entries
    flat = api.list_repo_tree(REPO, "data", repo_type="dataset")
    assert [one.path for one in flat] == ["data/0", "data/1", "data/2"]
    known = api.get_paths_info(REPO, ["data/0", "data/0/1.txt", "no"], repo_type="dataset")
    assert [one.path for one in known] == ["data/0", "data/0/1.txt"]
    with pytest.raises(EntryNotFoundError):
        list(api.list_repo_tree(REPO, "no", repo_type="dataset"))


def test_tags(hub: HubServer, api: HfApi) -> None:
    first = commit(api, {"a": b"1"})
    api.create_tag(REPO, tag="data-1.0.0", repo_type="dataset")
    commit(api, {"a": b"2"})
    refs = api.list_repo_refs(REPO, repo_type="dataset")
    assert {tag.name: tag.target_commit for tag in refs.tags} == {"data-1.0.0": first}
    assert [branch.name for branch in refs.branches] == ["main"]
    assert (download(api, "a"), download(api, "a", "data-1.0.0")) == (b"2", b"1")
    with pytest.raises(HfHubHTTPError, match="409"):
        api.create_tag(REPO, tag="data-1.0.0", repo_type="dataset")
    with pytest.raises(RevisionNotFoundError):
        api.create_tag(REPO, tag="x", revision="0" * 40, repo_type="dataset")
    api.delete_tag(REPO, tag="data-1.0.0", repo_type="dataset")
    with pytest.raises(RevisionNotFoundError):
        download(api, "a", "data-1.0.0")


def test_a_card_without_an_end_is_refused(hub: HubServer, api: HfApi) -> None:
    with pytest.raises(ValueError, match="README"):
        commit(api, {"README.md": b"---\nlicense: mit\n"})
    with pytest.warns(UserWarning, match="empty or missing yaml"):
        commit(api, {"README.md": b"plain"})


# --- where files come from -----------------------------------------------------------------------


def test_a_token_stays_with_the_hub(hub: HubServer, api: HfApi) -> None:
    commit(api, FILES)
    assert download(api, "videos/a.mp4") == VIDEO
    hosts = {(one.host, one.token) for one in hub.asked}
    assert hosts == {("127.0.0.1", "hf_someone"), ("localhost", None)}
    assert hub.downloads() == ["videos/a.mp4"]


def test_a_dropped_download_goes_on_where_it_stopped(
    hub: HubServer, api: HfApi, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(constants, "DOWNLOAD_CHUNK_SIZE", 10_000)  # what the client keeps at a time
    commit(api, FILES)
    hub.fault("GET", "/store/", drop=70_000)
    assert download(api, "videos/a.mp4") == VIDEO
    parts = [one for one in hub.asked if one.method == "GET" and one.host == "localhost"]
    assert [one.status for one in parts] == [200, 206]
    assert [one.sent for one in parts] == [70_000, len(VIDEO) - 70_000]


def test_small_files_and_json_are_compressed(hub: HubServer, api: HfApi) -> None:
    commit(api, {"long.json": b" " * 100_000})
    hub.asked.clear()
    assert download(api, "long.json") == b" " * 100_000
    [got] = [one for one in hub.asked if one.method == "GET"]
    assert got.sent == hub.sent < 1000


def test_a_renamed_repository_is_found(hub: HubServer, api: HfApi) -> None:
    commit(api, FILES)
    hub.renamed["datasets/someone/old"] = DATASET
    assert api.dataset_info("someone/old").id == REPO
    found = api.hf_hub_download("someone/old", "videos/a.mp4", repo_type="dataset")
    assert Path(found).read_bytes() == VIDEO
    adds = [CommitOperationAdd("new", b"new"), CommitOperationAdd("new.mp4", b"new")]
    api.create_commit("someone/old", adds, commit_message="c", repo_type="dataset")
    assert download(api, "new.mp4") == b"new"


# --- rights --------------------------------------------------------------------------------------


def test_a_wrong_token(hub: HubServer, api: HfApi) -> None:
    wrong = HfApi(token="hf_wrong")
    for ask in (wrong.whoami, lambda: wrong.dataset_info(REPO)):
        with pytest.raises(HfHubHTTPError) as caught:
            ask()
        assert caught.value.response.status_code == 401
        assert not isinstance(caught.value, RepositoryNotFoundError)


@pytest.mark.parametrize("rights", [{"name": "reader"}, {"name": "someone", "write": False}])
def test_a_token_without_rights(
    hub: HubServer, api: HfApi, login: Callable[..., None], rights: dict[str, object]
) -> None:
    login(**rights)
    for ask in (
        lambda: commit(api, FILES),
        lambda: api.create_repo("someone/other", repo_type="dataset"),
        lambda: api.create_tag(REPO, tag="x", repo_type="dataset"),
        lambda: api.auth_check(REPO, repo_type="dataset", write=True),
    ):
        with pytest.raises(HfHubHTTPError) as caught:
            ask()
        assert caught.value.response.status_code == 403
    assert not hub.uploads()
    with pytest.raises(HfHubHTTPError) as caught:
        HfApi(token=False).create_repo("someone/other", repo_type="dataset")
    assert caught.value.response.status_code == 401


def test_gated_files(hub: HubServer, api: HfApi, login: Callable[..., None]) -> None:
    commit(api, FILES)
    hub.gated.add(DATASET)
    assert download(api, "meta/info.json") == b"{}"  # it is its owner who asks
    login("reader", orgs=("somebody",))
    assert api.dataset_info(REPO).gated == "manual"
    with pytest.raises(GatedRepoError):
        download(api, "videos/a.mp4")
    login("member", orgs=("someone",))
    assert download(api, "videos/a.mp4") == VIDEO


# --- what goes wrong -----------------------------------------------------------------------------


def test_a_rate_limit_is_told(hub: HubServer, api: HfApi) -> None:
    hub.fault("POST", "/tag/", after=1, status=429, headers={"Retry-After": "7"})
    api.create_tag(REPO, tag="one", repo_type="dataset")
    with pytest.raises(HfHubHTTPError) as caught:
        api.create_tag(REPO, tag="two", repo_type="dataset")
    told = caught.value.response
    assert (told.status_code, told.headers["Retry-After"]) == (429, "7")
    api.create_tag(REPO, tag="two", repo_type="dataset")


def test_a_busy_store_is_asked_again(hub: HubServer, api: HfApi) -> None:
    hub.fault("PUT", "/store/", drop=1000)
    commit(api, FILES)
    assert download(api, "videos/a.mp4") == VIDEO


def test_a_lost_answer(hub: HubServer, api: HfApi) -> None:
    old = head(api)
    hub.fault("POST", "/commit/", lost=True)
    with pytest.raises(Exception, match="disconnected"):
        commit(api, {"a": b"a"})
    assert head(api) != old
    assert download(api, "a") == b"a"


def test_a_body_that_is_cut_or_wrong(hub: HubServer, api: HfApi) -> None:
    commit(api, FILES)
    hub.fault("GET", "/store/", cut=1)
    with pytest.raises(OSError, match="Consistency check"):
        download(api, "videos/a.mp4")
    hub.fault("GET", "/store/", wrong=True)
    assert download(api, "videos/a.mp4") != VIDEO  # the client compares sizes alone


def test_down(hub: HubServer, api: HfApi) -> None:
    hub.down = True
    with pytest.raises(HfHubHTTPError, match="503"):
        api.dataset_info(REPO)


def test_somebody_else_comes_first(hub: HubServer, api: HfApi) -> None:
    hub.fault("POST", "/commit/", call=lambda: commit(api, {"b": b"b"}))
    with pytest.raises(HfHubHTTPError, match="412"):
        commit(api, {"a": b"a"}, parent=head(api))
    assert "b" in api.list_repo_files(REPO, repo_type="dataset")


def test_many_clients(hub: HubServer, api: HfApi) -> None:
    commit(api, FILES)
    hub.asked.clear()
    with ThreadPoolExecutor(40) as pool:
        assert len(set(pool.map(head, [api] * 40))) == 1
    assert len(hub.asked) == 40
