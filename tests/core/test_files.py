"""Files reached through one place, written whole or not at all."""

import json
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.messages import raises

from robomme_interference_data.errors import FormatError, MissingFileError
from robomme_interference_data.storage.files import (
    LocalFiles,
    atomic_path,
    format_sums,
    read_sums,
    write_json,
)
from robomme_interference_data.storage.text import canonical_json, parse_json, read_json, read_text

values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**60), 2**60)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)


def test_path_and_list(tmp_path: Path) -> None:
    for name in ("b.parquet", "a/2.parquet", "a/10.parquet", "a/notes.txt"):
        path = tmp_path / "meta" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
    files = LocalFiles(tmp_path)
    assert files.path("meta/a/notes.txt").read_text() == "a/notes.txt"
    assert files.list("meta", ".parquet") == [
        "meta/a/10.parquet",
        "meta/a/2.parquet",
        "meta/b.parquet",
    ]
    assert len(files.list("meta")) == 4
    assert files.list("data") == []
    assert files.describe() == str(tmp_path)


@pytest.mark.parametrize("name", ["info.json", "meta"])
def test_missing_file_or_folder_in_its_place(tmp_path: Path, name: str) -> None:
    (tmp_path / "meta").mkdir()
    with raises(MissingFileError) as caught:
        LocalFiles(tmp_path).path(name)
    assert isinstance(caught.value, FileNotFoundError)
    assert "build it again" in str(caught.value.hint)


@given(st.dictionaries(st.text(), values, max_size=5))
def test_canonical_json(value: dict[str, Any]) -> None:
    text = canonical_json(value)
    assert canonical_json(dict(reversed(value.items()))) == text
    assert json.loads(text) == value
    assert canonical_json({"b": [1, 2.5, None], "a": "ä\n"}) == '{"a":"ä\\n","b":[1,2.5,null]}'
    with pytest.raises(ValueError, match="not JSON compliant"):
        canonical_json({"x": math.inf})


def test_names_of_files_that_are_not_utf_8_are_written_and_read_back(tmp_path: Path) -> None:
    path = tmp_path / "caf\udce9.json"
    write_json(path, {"out": str(path)})
    assert rb"caf\udce9.json" in path.read_bytes()
    assert read_json(path) == {"out": str(path)}


def test_written_json_is_indented_and_sorted(tmp_path: Path) -> None:
    path = tmp_path / "new" / "info.json"
    write_json(path, {"b": [1], "a": "ä"})
    assert path.read_bytes() == '{\n  "a": "ä",\n  "b": [\n    1\n  ]\n}\n'.encode()


@pytest.mark.parametrize("data", [b"", b'{"a": 1', b"\xff\xfe\x00", b"{} {}", b"[" * 10**5, b"[]"])
def test_invalid_json_objects(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "info.json"
    path.write_bytes(data)
    with raises(FormatError) as caught:
        read_json(path)
    assert caught.value.hint


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_text_in_the_encodings_that_say_which_they_are(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "rows.csv"
    path.write_bytes("task,family\nschließ die Tür,CloseDoor\n".encode(encoding))
    assert read_text(path) == "task,family\nschließ die Tür,CloseDoor\n"
    path.write_bytes('{"a": "ä"}'.encode(encoding))
    assert read_json(path) == {"a": "ä"}


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"task,family\nschlie\xdf,Close\n", "0xdf after 'schlie'"),
        (b"\xe9", "0xe9 at the beginning"),
        ("task,family\n".encode("utf-16-le"), "UTF-16LE"),
        ("task,family\n".encode("utf-16-be"), "UTF-16BE"),
        (b"\xff\xfea\0b", "UTF-16"),
    ],
)
def test_text_in_other_encodings(tmp_path: Path, data: bytes, said: str) -> None:
    path = tmp_path / "rows.csv"
    path.write_bytes(data)
    with raises(FormatError) as caught:
        read_text(path)
    assert said in caught.value.message
    assert "iconv" in str(caught.value.hint)


@pytest.mark.parametrize("relative", ["../x", "a/../../x", "/etc/passwd", "..", "meta/\0x"])
def test_a_path_never_leads_out(tmp_path: Path, relative: str) -> None:
    (tmp_path / "x").write_text("secret")
    (tmp_path / "data").mkdir()
    with raises(FormatError):
        LocalFiles(tmp_path / "data").path(relative)


@pytest.mark.parametrize("relative", ["a/\ud800.mp4", "x" * 5000, "x/" * 3000])
def test_names_that_no_file_can_have(tmp_path: Path, relative: str) -> None:
    with raises(FormatError):
        LocalFiles(tmp_path).path(relative)


def test_links_are_followed_inside_only(tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("secret")
    root = tmp_path / "data"
    (root / "meta").mkdir(parents=True)
    (root / "real").write_text("here")
    (root / "meta" / "inside").symlink_to(root / "real")
    (root / "meta" / "out").symlink_to(tmp_path / "secret")
    (root / "folder").symlink_to(tmp_path)
    assert LocalFiles(root).path("meta/inside").read_text() == "here"
    for relative in ("meta/out", "folder/secret"):
        with raises(FormatError):
            LocalFiles(root).path(relative)
    (root / "round").symlink_to("round")
    with raises(MissingFileError):
        LocalFiles(root).path("round")
    (tmp_path / "link").symlink_to(root)  # the folder itself may be one
    assert LocalFiles(tmp_path / "link").path("real").read_text() == "here"


def test_snapshots_of_the_hubs_cache_link_to_its_blobs(tmp_path: Path) -> None:
    (tmp_path / "blobs").mkdir()
    (tmp_path / "blobs" / "abc").write_text("data")
    (tmp_path / "refs").mkdir()
    (tmp_path / "refs" / "main").write_text("no data")
    for folder in (".", "v1", "v1/pick_cube", "sim/v1/pick_cube"):
        root = tmp_path / "snapshots" / "0123" / folder
        root.mkdir(parents=True, exist_ok=True)
        up = "../" * (2 + len(Path(folder).parts))
        (root / "info.json").symlink_to(f"{up}blobs/abc")
        (root / "other").symlink_to(f"{up}refs/main")
        assert LocalFiles(root).path("info.json").read_text() == "data"
        with raises(FormatError):
            LocalFiles(root).path("other")


def test_blobs_that_repositories_share(tmp_path: Path) -> None:
    """The client's cache may hold a file once for all repositories."""
    store = tmp_path / "blobs" / "ab"
    store.mkdir(parents=True)
    (store / "abcd").write_text("data")
    blobs = tmp_path / "datasets--a--b" / "blobs"
    blobs.mkdir(parents=True)
    (blobs / "sha").symlink_to("../../blobs/ab/abcd")
    root = tmp_path / "datasets--a--b" / "snapshots" / "0123"
    root.mkdir(parents=True)
    (root / "info.json").symlink_to("../../blobs/sha")
    with raises(FormatError):
        LocalFiles(root).path("info.json")
    (tmp_path / "blobs" / ".huggingface-shared-blobs").touch()
    assert LocalFiles(root).path("info.json").read_text() == "data"


def test_sums_equal_those_of_sha256sum(tmp_path: Path) -> None:
    (tmp_path / "b").write_bytes(b"")
    (tmp_path / "a").write_bytes(b"abc")
    text = format_sums(tmp_path, ["b", "a"])
    assert text == (
        "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad  a\n"
        "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855  b\n"
    )
    path = tmp_path / "sums"
    path.write_text(text)
    assert list(read_sums(path)) == ["a", "b"]
    for damaged in ("abc  a\n", "no sums\n", text.replace("  a", " a")):
        path.write_text(damaged)
        with raises(FormatError):
            read_sums(path)
    path.write_text(text.replace("  a", "  ../../a"))
    with raises(FormatError):
        read_sums(path)
    path.write_bytes(b"\xff")
    with raises(FormatError):
        read_sums(path)


@pytest.mark.parametrize(
    "text",
    [
        '{"a": 1, "b": 2, "a": 1}',
        '{"a": [{"b": 1, "b": 2}]}',
        '{"a": NaN}',
        '{"a": 1e999}',
        '{"a": ' + "9" * 5000 + "}",
    ],
)
def test_json_holds_finite_numbers_and_each_key_once(text: str) -> None:
    with raises(FormatError):
        parse_json(text.encode("latin-1"), "here")


def test_json_has_a_bounded_depth() -> None:
    def nested(depth: int) -> bytes:
        return b'{"a":' + b"[" * (depth - 1) + b"]" * (depth - 1) + b"}"

    assert parse_json(nested(64), "here")
    for depth in (66, 5_000, 500_000):
        with raises(FormatError):
            parse_json(nested(depth), "here")
    many = b'{"a":[' + b"{}," * 1000 + b"{}]}"
    assert len(parse_json(many, "here")["a"]) == 1001


def test_atomic_path_replaces(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "file.txt"
    for text in ("one", "two"):
        with atomic_path(path) as partial:
            assert partial.parent == path.parent  # a rename in one folder is atomic
            assert partial.suffix == ".partial"
            partial.write_text(text)
        assert path.read_text() == text
    assert [p.name for p in path.parent.iterdir()] == ["file.txt"]
    assert path.stat().st_mode & 0o777 == 0o644


def test_nothing_is_left_and_the_old_file_stays_when_writing_fails(tmp_path: Path) -> None:
    path = tmp_path / "info.json"
    write_json(path, {"a": 1})
    with pytest.raises(KeyboardInterrupt), atomic_path(path) as partial:
        partial.write_text("half")
        raise KeyboardInterrupt
    with raises(ValueError):
        write_json(path, {"a": math.nan})
    assert read_json(path) == {"a": 1}
    assert list(tmp_path.iterdir()) == [path]
