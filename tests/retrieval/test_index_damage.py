"""Indexes that are damaged, or of other data or another encoder, are located errors."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.buffer_sets import QUERIES
from support.damage import flipped_bits
from support.messages import raises
from support.retrieval import change_header, make_index

from robomme_interference_data import load_buffer, load_buffer_set
from robomme_interference_data.data.embeddings import BufferSetIndex, open_index
from robomme_interference_data.data.index_layout import episode_file
from robomme_interference_data.errors import FormatError, InterferenceError, MissingFileError
from robomme_interference_data.retrieval.encoders.thumbnail import Thumbnail
from robomme_interference_data.retrieval.measure import measure
from robomme_interference_data.retrieval.selector import Selector
from robomme_interference_data.storage.files import format_sums, read_sums, sha256_file

FOLDER, OF_UNITS = (f"{name}/index/thumbnail" for name in ("demonstrations", "distractors"))


@pytest.fixture
def whole(indexed: Path, tmp_path: Path) -> Path:
    """A copy of the buffer set with its index."""
    return shutil.copytree(indexed, tmp_path / "whole")


def look_up(buffer_set: Path, encoder: str = "thumbnail") -> None:
    load_buffer(QUERIES[0], "k1", buffer_set=buffer_set).embeddings(encoder)


def check(buffer_set: Path) -> None:
    """Read all of both indexes."""
    for dataset in load_buffer_set(buffer_set).datasets.values():
        lengths = {record.episode_index: record.length for record in dataset.records()}
        open_index(dataset, "thumbnail").check(lengths, units=dataset.kind == "distractors")


def test_without_an_index(tiny_buffers: Path) -> None:
    with raises(MissingFileError) as caught:
        look_up(tiny_buffers)
    expected = f"index {tiny_buffers} --encoder thumbnail"
    assert caught.value.command == expected
    with raises(MissingFileError) as caught:
        load_buffer(QUERIES[0], "k0", buffer_set=tiny_buffers).embeddings("thumbnail", "wrist")
    assert caught.value.command == f"{expected} --camera wrist"


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"format_version": 2}, FormatError),
        ({"size": 7}, MissingFileError),
        ({"camera": "wrist"}, MissingFileError),
        ({"sums": "0" * 64}, FormatError),
        ({"qool": 1}, FormatError),  # as a flipped bit makes of a key
    ],
)
def test_a_header_that_does_not_fit(
    whole: Path, change: dict[str, Any], error: type[InterferenceError]
) -> None:
    path = whole / FOLDER / "index.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with raises(error) as caught:
        look_up(whole)
    assert str(caught.value.command).startswith("index ")


def test_any_flipped_bit_is_an_error_or_does_no_harm(whole: Path) -> None:
    refused = 0
    for _ in flipped_bits(whole / FOLDER / "index.json", 60):
        try:
            check(whole)
        except InterferenceError as error:
            assert error.message
            refused += 1
    assert refused > 30


@pytest.mark.parametrize("name", ["chunk-000/episode-000000.npy", "center.npy", "SHA256SUMS"])
def test_a_damaged_file_is_named(whole: Path, name: str) -> None:
    path = whole / OF_UNITS / name
    content = path.read_bytes()
    for damaged in (content[:-1] + bytes([content[-1] ^ 1]), content[:50], b"", None):
        path.unlink() if damaged is None else path.write_bytes(damaged)
        with raises(FormatError) as caught:
            check(whole)
        assert caught.value.command == f"index {whole} --encoder thumbnail"


@pytest.mark.parametrize(("factor", "columns"), [(np.nan, 528), (1, 3)])
def test_invalid_embeddings_with_valid_hashes(whole: Path, factor: float, columns: int) -> None:
    # The hashes are right, the content is not.
    folder = whole / FOLDER
    path, sums, header = folder / episode_file(0), folder / "SHA256SUMS", folder / "index.json"
    np.save(path, np.load(path)[:, :columns] * np.float16(factor))
    names, before = read_sums(sums), sha256_file(sums)
    sums.write_text(format_sums(folder, names))
    header.write_text(header.read_text().replace(before, sha256_file(sums)))
    with raises(FormatError):
        look_up(whole)


def test_two_models_of_one_name_are_told_apart(own_buffers: Path) -> None:
    encoder = Thumbnail()
    encoder.name = "siglip:one/tiny"
    make_index(own_buffers, encoder)
    look_up(own_buffers, "siglip:one/tiny@v2")
    with raises(MissingFileError) as caught:
        look_up(own_buffers, "siglip:two/tiny")
    assert str(caught.value.command).startswith("index ")


def test_an_index_of_another_version_of_the_encoder(whole: Path) -> None:
    for folder in (FOLDER, OF_UNITS):
        path = whole / folder / "index.json"
        header = json.loads(path.read_text())
        header["encoder"]["sha256"] = "0" * 64
        path.write_text(json.dumps(header))
        buffer = load_buffer(QUERIES[0], "k0", buffer_set=whole)
        with raises(MissingFileError) as caught:
            Selector("thumbnail").select(buffer, buffer.query.frame())
        assert caught.value.command == f"index {whole} --encoder thumbnail"


def test_pool_statistics_are_only_in_the_index_of_units(whole: Path) -> None:
    """Hashes are valid; pool statistics are missing, wrong, or in the wrong index."""
    change_header(whole / OF_UNITS / "index.json", typical_cosine=None)
    buffer = load_buffer(QUERIES[0], "k0", buffer_set=whole)
    with raises(FormatError):
        measure(buffer, "thumbnail")
    with raises(FormatError):
        check(whole)
    change_header(whole / OF_UNITS / "index.json", typical_cosine=0.5)
    check(whole)
    change_header(whole / FOLDER / "index.json", typical_cosine=0.5)
    with raises(FormatError):
        check(whole)
    change_header(whole / FOLDER / "index.json", typical_cosine=None)
    center = np.load(whole / OF_UNITS / "center.npy")
    for folder in (OF_UNITS, FOLDER):
        before = read_sums(whole / folder / "SHA256SUMS")
        np.save(whole / folder / "center.npy", center + (folder == OF_UNITS))
        sums = format_sums(whole / folder, sorted({*before, "center.npy"}))
        (whole / folder / "SHA256SUMS").write_text(sums)
        digest = sha256_file(whole / folder / "SHA256SUMS")
        change_header(whole / folder / "index.json", sums=digest)
        with raises(FormatError):
            check(whole)
        make_index(whole)
        check(whole)


def test_embeddings_without_units(whole: Path) -> None:
    """A buffer set lists its units; these are datasets that somebody chose."""
    datasets = {"demonstrations": load_buffer_set(whole).datasets["demonstrations"]}
    with raises(MissingFileError):
        BufferSetIndex(datasets, "thumbnail", "front")
