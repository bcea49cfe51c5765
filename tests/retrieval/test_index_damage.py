"""Indexes that are damaged, or of other data or another encoder, are refused and named."""

import io
import json
import shutil
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.retrieval import EPISODE, make_index

from robomme_interference_data import load_buffer, load_split
from robomme_interference_data.embeddings import EmbeddingIndex
from robomme_interference_data.errors import (
    FormatError,
    InterferenceError,
    MissingIndexError,
    StaleIndexError,
)
from robomme_interference_data.retrieval.encoders.thumbnail import Thumbnail
from robomme_interference_data.retrieval.selector import Selector


@pytest.fixture
def whole(indexed: Path, tmp_path: Path) -> Path:
    """A copy of the split with its index."""
    return shutil.copytree(indexed, tmp_path / "whole")


def header_of(split: Path) -> Path:
    return split / "demonstrations" / "index" / "thumbnail" / "index.json"


def look_up(split: Path, encoder: str = "thumbnail") -> None:
    load_buffer(EPISODE, "k1", split=split).embeddings(encoder)


def test_without_an_index(tiny_split: Path) -> None:
    with pytest.raises(MissingIndexError, match="no embeddings of encoder 'thumbnail'") as caught:
        look_up(tiny_split)
    expected = f"Type: robomme-interference index {tiny_split} --encoder thumbnail"
    assert caught.value.hint == expected


@pytest.mark.parametrize(
    ("change", "error", "said"),
    [
        ({"revision": "0" * 64}, StaleIndexError, "revision 0000"),
        ({"format_version": 2}, FormatError, "format version 2"),
        ({"size": 7}, FormatError, "of shape"),
        ({"camera": "wrist"}, StaleIndexError, "camera 'wrist'"),
        ({"pool": "0" * 64}, StaleIndexError, "made differently"),
        ({"encoder": None}, FormatError, "encoder: None"),
        ({"sums": "0" * 64}, FormatError, "SHA256SUMS"),
        ({"frames": "many"}, FormatError, "frames: 'many'"),
        ({"typical_cosine": []}, FormatError, r"typical_cosine: \[\]"),
        ({"more": 1}, FormatError, "unknown more"),
    ],
)
def test_a_header_that_does_not_fit(
    whole: Path, change: dict[str, Any], error: type[Exception], said: str
) -> None:
    path = header_of(whole)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(error, match=said) as caught:
        look_up(whole)
    assert "robomme-interference index " in str(caught.value.hint)  # type: ignore[attr-defined]


@pytest.mark.parametrize("key", ["pool", "encoder", "sums", "computed"])
def test_a_flipped_key_is_one_error(whole: Path, key: str) -> None:
    path = header_of(whole)
    path.write_text(path.read_text().replace(f'"{key}"', f'"{chr(ord(key[0]) ^ 1)}{key[1:]}"', 1))
    with pytest.raises(FormatError, match=r"index\.json: unknown") as caught:
        look_up(whole)
    assert f"index {whole} --encoder thumbnail" in str(caught.value.hint)


@given(st.data())
def test_any_flipped_bit_is_an_error_or_does_no_harm(indexed: Path, data: st.DataObject) -> None:
    folder = indexed.parent / "flipped"
    path = header_of(folder)
    if not path.exists():
        shutil.copytree(indexed / "demonstrations", folder / "demonstrations")
    content = header_of(indexed).read_bytes()
    place = data.draw(st.integers(0, len(content) - 1))
    bit = 1 << data.draw(st.integers(0, 7))
    path.write_bytes(content[:place] + bytes([content[place] ^ bit]) + content[place + 1 :])
    demonstrations = load_split(indexed).datasets["demonstrations"]
    files = type(demonstrations.files)(folder / "demonstrations")
    try:
        index = EmbeddingIndex(files, demonstrations.revision, "thumbnail")
        index.check({record.episode_index: record.length for record in demonstrations.records()})
    except InterferenceError as error:
        assert str(error)


@pytest.mark.parametrize("name", ["chunk-000/episode-000000.npy", "centre.npy", "SHA256SUMS"])
def test_a_damaged_file_is_named(whole: Path, name: str) -> None:
    path = header_of(whole).parent / name
    content = path.read_bytes()
    index = load_split(whole).datasets["demonstrations"].index("thumbnail")
    for damaged in (content[:-1] + bytes([content[-1] ^ 1]), content[:50], b""):
        path.write_bytes(damaged)
        dataset = load_split(whole).datasets["demonstrations"]
        with pytest.raises(FormatError, match=f"{name}.* not have the SHA-256") as caught:
            dataset.index("thumbnail").check({r.episode_index: r.length for r in dataset.records()})
        assert f"index {whole} --encoder thumbnail" in str(caught.value.hint)
    path.unlink()
    with pytest.raises(FormatError, match=f"{name} is missing"):
        index.span(0, 0, 1) if name != "centre.npy" else index.centre  # noqa: B018


def test_what_something_else_made(whole: Path) -> None:
    # The hashes are right, the content is not.
    folder = header_of(whole).parent
    name = "chunk-000/episode-000000.npy"
    rows = np.load(folder / name)
    for change, said in ((lambda r: r * np.nan, "finite"), (lambda r: r[:, :3], "of shape")):
        out = io.BytesIO()
        np.save(out, change(rows))
        was = sha256((folder / name).read_bytes()).hexdigest()
        (folder / name).write_bytes(out.getvalue())
        sums = (folder / "SHA256SUMS").read_text()
        changed = sums.replace(was, sha256(out.getvalue()).hexdigest())
        (folder / "SHA256SUMS").write_text(changed)
        header = json.loads(header_of(whole).read_text())
        header["sums"] = sha256(changed.encode()).hexdigest()
        header_of(whole).write_text(json.dumps(header))
        with pytest.raises(FormatError, match=said):
            look_up(whole)


def test_frames_that_are_not_there(indexed: Path) -> None:
    index = load_split(indexed).datasets["demonstrations"].index("thumbnail")
    for episode, start, stop in ((0, 0, 10_000), (10_000, 0, 1), (0, -1, 2), (0, 3, 2)):
        with pytest.raises(LookupError, match="are not in"):
            index.span(episode, start, stop)


def test_two_models_of_one_name_are_told_apart(split: Path) -> None:
    encoder = Thumbnail()
    encoder.name = "siglip:one/tiny"
    make_index(split, encoder)
    look_up(split, "siglip:one/tiny@v2")
    with pytest.raises(StaleIndexError, match="of encoder 'siglip:one/tiny'") as caught:
        look_up(split, "siglip:two/tiny")
    assert "robomme-interference index" in str(caught.value.hint)


def test_an_index_of_another_version_of_the_encoder(whole: Path) -> None:
    for path in whole.glob("*/index/thumbnail/index.json"):
        header = json.loads(path.read_text())
        header["encoder"]["sha256"] = "0" * 64
        path.write_text(json.dumps(header))
    buffer = load_buffer(EPISODE, "k0", split=whole)
    with pytest.raises(StaleIndexError, match="another version of the encoder"):
        Selector("thumbnail").select(buffer, buffer.query.frame())
