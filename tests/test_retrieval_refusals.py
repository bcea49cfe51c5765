"""Indexes that are damaged, or of other data or another encoder, are refused and named."""

import io
import json
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import retrieval_indexes
from retrieval_indexes import EPISODE, QUIET, make_index

from robomme_interference_data import load_buffer
from robomme_interference_data.build_dataset.verify import verify_split
from robomme_interference_data.errors import FormatError, MissingIndexError, StaleIndexError
from robomme_interference_data.retrieval.commands import datasets_in
from robomme_interference_data.retrieval.encoders.thumbnail import Thumbnail
from robomme_interference_data.retrieval.index import build_index
from robomme_interference_data.retrieval.selector import Selector

split = retrieval_indexes.split  # the fixture


def test_what_cannot_be_used_is_refused(split: Path) -> None:
    buffer = load_buffer(EPISODE, 1, split)
    with pytest.raises(MissingIndexError, match=f"index --data {split} --encoder thumbnail"):
        buffer.embeddings("thumbnail")
    make_index(split)
    header = split / "demonstrations" / "index" / "thumbnail" / "index.json"
    whole = json.loads(header.read_text())

    def refused(error: type[Exception], match: str, **change: Any) -> None:
        header.write_text(json.dumps(whole | change))
        with pytest.raises(error, match=match):
            load_buffer(EPISODE, 1, split).embeddings("thumbnail")

    refused(StaleIndexError, "revision 0000", revision="0" * 64)
    refused(FormatError, "format version 2", format_version=2)
    refused(FormatError, "expected float16 of shape", size=7)
    lacking = {name: value for name, value in whole.items() if name != "pool"}
    header.write_text(json.dumps(lacking))
    with pytest.raises(FormatError, match="lacks pool") as caught:
        load_buffer(EPISODE, 1, split).embeddings("thumbnail")
    assert f"index --data {split} --encoder thumbnail" in str(caught.value.hint)
    other = whole["encoder"] | {"sha256": "0" * 64}
    refused(StaleIndexError, "made differently", encoder=other)
    with pytest.raises(StaleIndexError, match="another version of the encoder"):
        Selector("thumbnail").select(load_buffer(EPISODE, 0, split), buffer.query_frame())
    refused(StaleIndexError, "camera 'wrist'", camera="observation.images.wrist")
    refused(StaleIndexError, "made differently", pool="0" * 64)
    header.write_text(json.dumps(whole))
    (header.parent / "rows.parquet").write_bytes(b"PAR1")
    refused(FormatError, "rows.parquet")


def test_two_models_of_one_name_are_told_apart(split: Path) -> None:
    encoder = Thumbnail()
    encoder.name = "siglip:one/tiny"
    build_index(datasets_in(split), encoder, QUIET)
    buffer = load_buffer(EPISODE, 1, split)
    assert len(buffer.embeddings("siglip:one/tiny@v2")) == 20 + 32
    with pytest.raises(StaleIndexError, match="of encoder 'siglip:one/tiny'") as caught:
        buffer.embeddings("siglip:two/tiny")
    assert "index --data" in str(caught.value.hint)


def test_contents_are_checked(split: Path) -> None:
    make_index(split)
    folder = split / "demonstrations" / "index" / "thumbnail"
    assert not list(verify_split(split, decode=False))
    whole = {path.name: path.read_bytes() for path in folder.iterdir()}

    def refused(name: str, content: bytes, said: str) -> None:
        (folder / name).write_bytes(content)
        with pytest.raises(FormatError, match=said) as caught:
            load_buffer(EPISODE, 1, split).query_index("thumbnail").check()
        assert f"index --data {split} --encoder thumbnail" in str(caught.value.hint)
        (found,) = verify_split(split, decode=False)
        assert found.where == "demonstrations/index/thumbnail" and said in found.what
        (folder / name).write_bytes(whole[name])

    rows = np.load(folder / "embeddings.npy")
    turned, holed = io.BytesIO(), io.BytesIO()
    np.save(turned, rows[::-1])
    rows[3] = np.nan
    np.save(holed, rows)
    for name, content in (
        ("embeddings.npy", turned.getvalue()),
        ("centre.npy", whole["centre.npy"][:-1] + b"x"),
        ("rows.parquet", whole["rows.parquet"] + b"x"),
    ):
        refused(name, content, f"{name} does not have the SHA-256")
    # As made by something else: the hash is right, the content is not.
    header = json.loads(whole["index.json"])
    header["files"]["embeddings.npy"]["sha256"] = sha256(holed.getvalue()).hexdigest()
    whole["embeddings.npy"] = holed.getvalue()
    (folder / "embeddings.npy").write_bytes(holed.getvalue())
    refused("index.json", json.dumps(header).encode(), "no finite number")
    (folder / "index.json").write_bytes(whole["index.json"])
    (folder / "rows.parquet").unlink()
    with pytest.raises(FormatError, match=r"rows\.parquet is missing") as caught:
        load_buffer(EPISODE, 1, split).embeddings("thumbnail")
    assert f"index --data {split} --encoder thumbnail" in str(caught.value.hint)


def test_verify_names_an_index_that_does_not_belong(split: Path) -> None:
    make_index(split)
    path = split / "demonstrations" / "index" / "thumbnail" / "index.json"
    header = json.loads(path.read_text())
    for change, said in (
        ({"pool": "0" * 64}, "other distractors"),
        ({"camera": "observation.images.wrist"}, "camera observation.images.wrist"),
        ({"encoder": None}, "does not say of which encoder"),
    ):
        path.write_text(json.dumps(header | change))
        (found,) = verify_split(split, decode=False)
        assert found.where == "demonstrations/index/thumbnail" and said in found.what
