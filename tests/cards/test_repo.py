"""Repositories: names, versions and licenses, and files in a folder or on the Hub."""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from huggingface_hub.hf_api import RepoFile
from hypothesis import given
from hypothesis import strategies as st
from support.buffer_sets import GOLDEN, contents, copy_buffer_set
from support.hub_server import Blob
from support.machine import full_disk
from support.messages import raises
from support.publishing import content_of, plain_cards

from robomme_interference_data import load_buffer, load_buffer_set
from robomme_interference_data.build_dataset.verify.buffer_set import verify_buffer_set
from robomme_interference_data.cards.publication import (
    Publication,
    PublishConfig,
    Version,
    versions_of,
)
from robomme_interference_data.cards.repo import (
    LocalFile,
    RepoFiles,
    compare,
    total_size,
    write_folder,
)
from robomme_interference_data.errors import InvalidOptionError, PublishError

COMMIT = "0123456789" * 4
BASE = f"someone/lessons@{COMMIT}"


def remote(data: bytes, large: bool = False) -> RepoFile:
    return RepoFile(**Blob(data, large).entry("file"))


@pytest.mark.parametrize("large", [False, True])
def test_a_file_is_known_by_its_digest(tmp_path: Path, large: bool) -> None:
    (tmp_path / "file").write_bytes(b"hello\n")
    for file in (LocalFile(b"hello\n"), LocalFile(tmp_path / "file")):
        assert file.equals(remote(b"hello\n", large))
        assert not file.equals(remote(b"hullo\n", large))
        assert not file.equals(remote(b"hello", large))
        assert file.sha256 == hashlib.sha256(b"hello\n").hexdigest()


FILES = st.dictionaries(st.sampled_from("abcdef"), st.binary(max_size=3), max_size=6)


@given(FILES, FILES, st.booleans())
def test_what_differs(expected: dict[str, bytes], existing: dict[str, bytes], large: bool) -> None:
    files = {path: LocalFile(data) for path, data in expected.items()}
    found = compare(files, {path: remote(data, large) for path, data in existing.items()})
    kept = {path: data for path, data in existing.items() if path not in found.removed}
    sent = {path: expected[path] for path in found.sent}
    assert kept | sent == expected
    assert bool(found) == (expected != existing)
    assert all(existing.get(path) != expected[path] for path in found.sent)
    assert total_size(files, found.sent) == sum(map(len, sent.values()))


def test_unmanaged_files_are_kept() -> None:
    unmanaged = (".gitattributes", "LICENSE", "LICENSE.txt", ".github/workflow.yml")
    existing = {path: remote(b"x") for path in (*unmanaged, "LICENSES/x", "data/.x", "NOTICE")}
    assert compare({}, existing).removed == ("LICENSES/x", "NOTICE", "data/.x")


def test_the_files_of_a_buffer_set(tmp_path: Path) -> None:
    root = copy_buffer_set(tmp_path / "buffer_set")
    for path in ("index/thumbnail/a.npy", "index/.thumbnail.building/b.npy", "LICENSE", ".x"):
        (root / "distractors" / path).parent.mkdir(parents=True, exist_ok=True)
        (root / "distractors" / path).write_bytes(b"more")
    found = content_of(root).units(BASE).data
    header = found.pop("manifests/manifest.json").read().decode()
    assert {path: file.read() for path, file in found.items()} == {
        **contents(GOLDEN / "distractors"),
        "index/thumbnail/a.npy": b"more",
        "manifests/buffers.parquet": (GOLDEN / "manifests/buffers.parquet").read_bytes(),
    }
    before = (GOLDEN / "manifests/manifest.json").read_text(encoding="utf-8")
    added = [line.strip() for line in header.splitlines() if line not in before.splitlines()]
    assert added == [f'"location": "{BASE}",', '"location": ".",']


# --- in a folder ---------------------------------------------------------------------------------


@pytest.fixture
def _plain(monkeypatch: pytest.MonkeyPatch) -> None:
    plain_cards(monkeypatch)


def folder(root: Path, **options: Any) -> RepoFiles:
    return content_of(root, **options).folder()


@pytest.mark.usefixtures("_plain")
def test_a_folder_is_a_buffer_set(tmp_path: Path) -> None:
    one, two = tmp_path / "one", tmp_path / "two"
    assert write_folder(folder(GOLDEN), one)
    golden, written = load_buffer_set(GOLDEN), load_buffer_set(one)
    assert written.revision == golden.revision
    assert [*verify_buffer_set(written)] == []
    mine = load_buffer("MoveCube/test/0", "k7", buffer_set=golden).frames("front")
    theirs = load_buffer("MoveCube/test/0", "k7", buffer_set=written, verify=True).frames("front")
    assert np.array_equal(mine, theirs)
    assert write_folder(folder(one), two)
    assert contents(two) == contents(one)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one", "two"]


@pytest.mark.usefixtures("_plain")
def test_a_folder_is_written_once(tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert write_folder(folder(GOLDEN), out)
    assert not write_folder(folder(GOLDEN), out)
    before = contents(out)
    with pytest.raises(PublishError):
        write_folder(folder(GOLDEN, version="1.0.1"), out)
    assert contents(out) == before


@pytest.mark.usefixtures("_plain")
@pytest.mark.parametrize("other", ["file", "buffer_set", ".git/config", "LICENSE"])
def test_a_folder_of_something_else_is_kept(tmp_path: Path, other: str) -> None:
    out = tmp_path / "out"
    if other == "buffer_set":
        copy_buffer_set(out)
    elif other == "file":
        out.write_bytes(b"mine")
    else:
        write_folder(folder(GOLDEN, version="1.0.1"), out)
        (out / other).parent.mkdir(exist_ok=True)
        (out / other).write_bytes(b"mine")
    before = contents(tmp_path)
    with pytest.raises(PublishError):
        write_folder(folder(GOLDEN), out)
    assert contents(tmp_path) == before


@pytest.mark.usefixtures("_plain")
def test_a_full_disk_leaves_what_was_there(tmp_path: Path) -> None:
    out, files = tmp_path / "out", folder(GOLDEN)
    for left in (0, 12_000):  # the first file does not fit, a later one
        with full_disk(left), raises(OSError) as caught:
            write_folder(files, out)
        assert str(tmp_path) in f"{caught.value.filename} {caught.value.filename2}"
        assert [*tmp_path.iterdir()] == []
    assert write_folder(files, out)
    assert {path: file.read() for path, file in files.items()} == contents(out)


# --- publications --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wrong",
    [
        *({"repo_id": one} for one in ("tiny", "a/b/c", "a/b\n", "a/b.git", None)),
        *({"version": one} for one in ("1.0", "v1.0.0", "01.0.0", "1.0.0\n")),
        *({"license": one} for one in ("CC BY 4.0", "cc-by-4", "a: b", "")),
        *({"base": one} for one in ("people/demos", "people/demos@main", f"demos@{COMMIT}")),
    ],
)
def test_invalid_publications(wrong: dict[str, Any]) -> None:
    with raises(InvalidOptionError) as caught:
        Publication(**{"repo_id": "people/tiny", **wrong})
    assert repr(next(iter(wrong.values())))[:6] in caught.value.message


@pytest.mark.parametrize(
    "options", [{"demonstrations_id": "people/tiny"}, {"repo_id": "people/" + "a" * 90}]
)
def test_invalid_settings(options: dict[str, str]) -> None:
    with raises(InvalidOptionError):
        PublishConfig(**{"repo_id": "people/tiny", **options})


@pytest.mark.parametrize("location", [None, ".", 7, f"demos@{COMMIT}"])
def test_a_base_is_a_commit_on_the_hub(location: object) -> None:
    publication = Publication("people/tiny").made_for(location)
    assert publication.base is None
    known = publication.made_for(f"people/demos@{COMMIT}")
    assert known.base == known.made_for(f"people/others@{COMMIT}").base == f"people/demos@{COMMIT}"


def test_versions_are_tags() -> None:
    tags = {"v3.0": "a", "data-1.10.0": "b", "data-1.9.9": "c", "data-01.0.0": "d", "data-2": "e"}
    assert list(versions_of(tags).items()) == [(Version(1, 9, 9), "c"), (Version(1, 10, 0), "b")]
    texts = ("1.2", "1.2.3 ", "v1.2.3", "1.2.3")
    assert [Version.parse(text) for text in texts] == [None, None, None, Version(1, 2, 3)]
