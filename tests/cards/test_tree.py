"""Trees, versions and parts: the pure rules of publishing."""

import hashlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.hub_repositories import Blob
from support.splits import GOLDEN, contents, copy_split

from robomme_interference_data import load_split
from robomme_interference_data.build_dataset.manifests import (
    in_folder,
    plan_manifests,
    write_manifests,
)
from robomme_interference_data.cards.contents import (
    dataset_tree,
    parts_of_buffers,
    parts_of_dataset,
    split_tree,
)
from robomme_interference_data.cards.tree import Content, Entry, compare, total_size
from robomme_interference_data.cards.versions import Change, Version, change_between, versions_of
from robomme_interference_data.errors import HashMismatchError

BASE = f"someone/lessons@{'0123456789' * 4}"


def entry(data: bytes, large: bool = False) -> Entry:
    blob = Blob(data, large)
    return Entry(len(data), blob.oid, blob.sha256 if large else None)


# --- trees ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("large", [False, True])
def test_a_file_is_known_by_its_digest(tmp_path: Path, large: bool) -> None:
    (tmp_path / "file").write_bytes(b"hello\n")
    for content in (Content(b"hello\n"), Content(tmp_path / "file")):
        assert entry(b"hello\n", large).holds(content)
        assert not entry(b"hullo\n", large).holds(content)
        assert not entry(b"hello", large).holds(content)
        assert content.blob == "ce013625030ba8dba906f756967f9e9ca394464a"
        assert content.sha256 == hashlib.sha256(b"hello\n").hexdigest()


def test_a_recorded_digest_is_taken() -> None:
    assert Content(b"anything", "known").sha256 == "known"


FILES = st.dictionaries(st.sampled_from("abcdef"), st.binary(max_size=3), max_size=6)


@given(FILES, FILES, st.booleans())
def test_what_differs(wanted: dict[str, bytes], there: dict[str, bytes], large: bool) -> None:
    tree = {path: Content(data) for path, data in wanted.items()}
    found = compare(tree, {path: entry(data, large) for path, data in there.items()})
    kept = {path: data for path, data in there.items() if path not in found.removed}
    sent = {path: wanted[path] for path in found.sent}
    assert kept | sent == wanted
    assert bool(found) == (wanted != there)
    assert all(there.get(path) != wanted[path] for path in found.sent)
    assert total_size(tree, found.sent) == sum(map(len, sent.values()))


def test_what_lies_beside_is_left_alone() -> None:
    beside = (".gitattributes", "LICENSE", "LICENSE.txt", ".github/workflow.yml")
    there = {path: entry(b"x") for path in (*beside, "LICENSES/x", "data/.x", "NOTICE")}
    assert compare({}, there).removed == ("LICENSES/x", "NOTICE", "data/.x")


# --- versions ------------------------------------------------------------------------------------


def test_versions_are_tags() -> None:
    tags = {"v3.0": "a", "data-1.10.0": "b", "data-1.9.9": "c", "data-01.0.0": "d", "data-2": "e"}
    assert versions_of(tags) == {Version(1, 9, 9): "c", Version(1, 10, 0): "b"}
    assert list(versions_of(tags)) == [Version(1, 9, 9), Version(1, 10, 0)]
    assert (str(Version(1, 9, 9)), Version(1, 9, 9).tag) == ("1.9.9", "data-1.9.9")
    assert [Version.parse(text) for text in ("1.2", "1.2.3 ", "v1.2.3", "1.2.3")] == [
        *(None, None, None),
        Version(1, 2, 3),
    ]


@pytest.mark.parametrize(
    ("before", "now", "change", "following"),
    [
        ({"a": "1"}, {"a": "1"}, Change.PATCH, "1.2.4"),
        ({"a": "1"}, {"a": "1", "b": "1"}, Change.MINOR, "1.3.0"),
        ({"a": "1"}, {"a": "2", "b": "1"}, Change.MAJOR, "2.0.0"),
        ({"a": "1", "b": "1"}, {"a": "1"}, Change.MAJOR, "2.0.0"),
    ],
)
def test_the_next_version(
    before: dict[str, str], now: dict[str, str], change: Change, following: str
) -> None:
    assert change_between(before, now) is change
    assert str(Version(1, 2, 3).after(change)) == following


@given(st.builds(Version, *[st.integers(0, 50)] * 3), st.sampled_from(Change))
def test_the_next_version_is_later(version: Version, change: Change) -> None:
    assert version < version.after(change) <= version.after(Change.MAJOR)
    assert Version.of_tag(version.tag) == version


# --- what repositories hold ----------------------------------------------------------------------


def test_the_files_of_a_split(tmp_path: Path) -> None:
    root = copy_split(tmp_path / "split")
    for path in ("index/thumbnail/a.npy", "index/.thumbnail.building/b.npy", "LICENSE", ".x"):
        (root / "distractors" / path).parent.mkdir(parents=True, exist_ok=True)
        (root / "distractors" / path).write_bytes(b"more")
    split = load_split(root)
    tree = split_tree(split, BASE)
    own = contents(GOLDEN / "distractors")
    assert {path: content.read() for path, content in tree.items()} == {
        **own,
        "index/thumbnail/a.npy": b"more",
        "manifests/buffers.parquet": (GOLDEN / "manifests/buffers.parquet").read_bytes(),
        "manifests/manifest.json": tree["manifests/manifest.json"].read(),
    }
    for content in tree.values():
        assert content.sha256 == hashlib.sha256(content.read()).hexdigest()
    lessons = dataset_tree(split.datasets["demonstrations"])
    assert {path: one.read() for path, one in lessons.items()} == contents(
        GOLDEN / "demonstrations"
    )


def test_the_manifests_say_where_the_data_are(tmp_path: Path) -> None:
    header = split_tree(load_split(GOLDEN), BASE)["manifests/manifest.json"].read().decode()
    before = (GOLDEN / "manifests/manifest.json").read_text(encoding="utf-8")
    added = [line.strip() for line in header.splitlines() if line not in before.splitlines()]
    assert added == [f'"place": "{BASE}",', '"place": ".",']


def test_rows_that_are_not_the_recorded_ones(tmp_path: Path) -> None:
    root = copy_split(tmp_path / "split")
    with (root / "manifests/buffers.parquet").open("ab") as file:
        file.write(b"more")
    with pytest.raises(HashMismatchError, match=r"buffers\.parquet"):
        split_tree(load_split(root), None)


@pytest.mark.parametrize(
    ("conditions", "change"),
    [
        (("no-history", "k0", "k1", "k3", "k7"), Change.PATCH),
        (("no-history", "k0", "k1", "k2", "k3", "k7"), Change.MINOR),
        (("no-history", "k0", "k1", "k2", "k3"), Change.MAJOR),
    ],
)
def test_how_much_has_changed(tmp_path: Path, conditions: tuple[str, ...], change: Change) -> None:
    root = copy_split(tmp_path / "split")
    for _ in write_manifests(plan_manifests(in_folder(root), conditions), root):
        pass
    before, now = (
        parts_of_buffers(split.manifests()) for split in (load_split(GOLDEN), load_split(root))
    )
    assert change_between(before, now) is change


def test_other_draws_are_other_buffers(tmp_path: Path) -> None:
    root = copy_split(tmp_path / "split")
    for _ in write_manifests(plan_manifests(in_folder(root), seed=1), root):
        pass
    before, now = (
        parts_of_buffers(split.manifests()) for split in (load_split(GOLDEN), load_split(root))
    )
    assert before.keys() == now.keys()
    same = {name for name, held in before.items() if now[name] == held}
    assert {name.rpartition(" ")[2] for name in same} == {"no-history", "k0"}


def test_parts_of_a_dataset() -> None:
    parts = parts_of_dataset(load_split(GOLDEN).datasets["demonstrations"])
    assert sorted(parts) == [
        f"demonstrations {family}/test/0" for family in ("MoveCube", "PatternLock", "VideoRepick")
    ]
