"""The embedding index: its contents, and how it is made and remade."""

import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from support.buffer_sets import QUERIES, UNITS
from support.messages import raises
from support.retrieval import FRAMES, QUIET, Interrupted, TwoSums, files_of, make_index, remade

from robomme_interference_data import load_buffer, load_buffer_set
from robomme_interference_data.data.embeddings import EmbeddingIndex, normalized, open_index
from robomme_interference_data.errors import BuildError, MissingFileError
from robomme_interference_data.retrieval.encoders.thumbnail import Thumbnail
from robomme_interference_data.retrieval.index import build_index
from robomme_interference_data.retrieval.measure import measure
from robomme_interference_data.retrieval.segment import typical_cosine
from robomme_interference_data.storage.staging import file_lock, staging_path

GOLDEN = Path(__file__).parents[1] / "golden" / "index"


def units_index(buffer_set: Path, camera: str = "front") -> EmbeddingIndex:
    return open_index(load_buffer_set(buffer_set).datasets["distractors"], "thumbnail", camera)


def test_a_buffers_embeddings_are_those_of_its_frames(indexed: Path) -> None:
    buffer = load_buffer(QUERIES[0], "k3", buffer_set=indexed)
    found = buffer.embeddings("thumbnail")
    assert found.dtype == np.float32 and found.shape == (48 + 3 * 32, 528)
    assert np.linalg.norm(found, axis=1) == pytest.approx(1, abs=1e-6)
    encoder, center = Thumbnail(), units_index(indexed).center
    assert np.array_equal(found, normalized(encoder.prepare(buffer.frames()), center))
    query = normalized(encoder.prepare(buffer.query.frame()[None]), center)[0]
    assert np.array_equal(buffer.query_embedding("thumbnail"), query)
    lesson, unit, *_ = buffer.manifest.sessions
    turned = remade(indexed, [unit, lesson]).embeddings("thumbnail")
    assert np.array_equal(turned, np.concatenate([found[48:80], found[:48]]))


def test_embeddings_are_the_callers(indexed: Path) -> None:
    assert (
        load_buffer(QUERIES[0], "no-history", buffer_set=indexed).embeddings("thumbnail").size == 0
    )
    buffer = load_buffer(QUERIES[0], "k0", buffer_set=indexed)
    once = buffer.embeddings("thumbnail")
    kept = once.copy()
    once += 1
    buffer.query_embedding("thumbnail")[:] = 0
    assert np.array_equal(buffer.embeddings("thumbnail"), kept)
    assert buffer.query_embedding("thumbnail").any()


def test_centre_and_typical_cosine_are_of_the_units_alone(indexed: Path) -> None:
    datasets = load_buffer_set(indexed).datasets
    units, images = datasets["distractors"], np.empty((UNITS, 32, 32, 32, 3), np.uint8)
    for episode in range(UNITS):
        units.read_frames(episode, "front", 0, images[episode])
    features = Thumbnail().prepare(images.reshape(-1, 32, 32, 3)).astype(np.float16)
    index = open_index(units, "thumbnail")
    assert index.center == pytest.approx(features.mean(axis=0, dtype=np.float64), abs=1e-7)
    pool = normalized(features, index.center).reshape(UNITS, 32, -1)
    assert index.typical_cosine == typical_cosine(UNITS, pool.__getitem__)
    assert np.array_equal(index.span(3, 0, 32), features.reshape(UNITS, 32, -1)[3])
    other = open_index(datasets["demonstrations"], "thumbnail")
    assert (other.center, other.header.typical_cosine) == (None, None)


def test_a_live_frame_has_the_embedding_of_the_stored_one(indexed: Path) -> None:
    buffer = load_buffer(QUERIES[0], "k3", buffer_set=indexed)
    index, stored = buffer.index("thumbnail"), buffer.embeddings("thumbnail")
    for place in (0, 47, 48, 100):
        live = index.embed(Thumbnail().prepare(buffer.frame(place)[None]))[0]
        assert np.array_equal(live, stored[place])
        assert measure(buffer, "thumbnail", query=live).alike[place] == 1


@given(arrays(np.float32, (3, 4), elements=st.floats(-999, 999, width=32)), st.booleans())
def test_normalising(features: np.ndarray, centered: bool) -> None:
    center = np.array([3, 0, -1, 0.5], np.float32) if centered else None
    found = normalized(features, center)
    assert found.dtype == np.float32
    assert np.array_equal(found, normalized(features.astype(np.float16), center))
    exact = features.astype(np.float16).astype(np.float64) - (0 if center is None else center)
    lengths = np.linalg.norm(exact, axis=1, keepdims=True)
    assert found * lengths == pytest.approx(exact, rel=1e-5, abs=1e-5)


def test_datasets_that_a_buffer_does_not_need_may_lack_an_index(
    indexed: Path, tiny_buffers: Path
) -> None:
    buffer_set = load_buffer_set(indexed)
    expected = buffer_set.load(QUERIES[0], "k1").embeddings("thumbnail")
    other = load_buffer_set(tiny_buffers).datasets["demonstrations"]
    buffer_set.datasets = {**buffer_set.datasets, "contradictions": other}  # type: ignore[misc]
    assert np.array_equal(buffer_set.load(QUERIES[0], "k1").embeddings("thumbnail"), expected)


def test_each_camera_has_an_index_of_its_own(indexed: Path, own_buffers: Path) -> None:
    shutil.copytree(indexed, own_buffers, dirs_exist_ok=True)
    once = files_of(own_buffers)
    assert make_index(own_buffers, camera="wrist") == FRAMES
    both = files_of(own_buffers)
    assert {name: both[name] for name in once} == once and len(both) == 2 * len(once)
    buffer = load_buffer(QUERIES[0], "k1", buffer_set=own_buffers)
    center = units_index(own_buffers, "wrist").center
    expected = normalized(Thumbnail().prepare(buffer.frames("wrist")), center)
    found = buffer.embeddings("thumbnail", "observation.images.wrist")
    assert np.array_equal(found, expected)
    live = normalized(Thumbnail().prepare(buffer.query.frame("wrist")[None]), center)[0]
    measured = measure(buffer, "thumbnail", "wrist")
    assert np.array_equal(measured.alike, measure(buffer, "thumbnail", "wrist", live).alike)


def test_an_index_is_the_same_bytes_every_time(indexed: Path, own_buffers: Path) -> None:
    assert make_index(own_buffers, threads=3) == FRAMES
    assert files_of(own_buffers) == files_of(indexed)
    assert make_index(own_buffers) == [0, 0]  # it is there and right
    assert make_index(own_buffers, force=True) == FRAMES
    assert files_of(own_buffers) == files_of(indexed)


def test_interrupted_index_resumes(indexed: Path, own_buffers: Path) -> None:
    # Three lessons of four batches each, then units of two: one is done, and half of the next.
    with pytest.raises(KeyboardInterrupt):
        make_index(own_buffers, Interrupted(after=15))
    with pytest.raises(MissingFileError):
        load_buffer(QUERIES[0], "k0", buffer_set=own_buffers).embeddings("thumbnail")
    assert make_index(own_buffers) == [0, FRAMES[1] - 32]
    assert files_of(own_buffers) == files_of(indexed)


@pytest.mark.parametrize(
    ("name", "again"),
    [
        ("demonstrations", [FRAMES[0], 0]),
        ("distractors/index/thumbnail/chunk-000/episode-000003.npy", [0, FRAMES[1]]),
        ("distractors/index/thumbnail/index.json", [0, FRAMES[1]]),
        ("demonstrations/index/thumbnail/stray.txt", [FRAMES[0], 0]),
    ],
)
def test_what_is_missing_or_damaged_is_made_again(
    indexed: Path, own_buffers: Path, name: str, again: list[int]
) -> None:
    shutil.copytree(indexed, own_buffers, dirs_exist_ok=True)
    path = own_buffers / name
    if path.is_dir():
        shutil.rmtree(path / "index")
    else:
        path.write_bytes((path.read_bytes()[:-2] if path.exists() else b"") + b"xx")
    assert make_index(own_buffers) == again
    assert files_of(own_buffers) == files_of(indexed)


def test_frames_that_cannot_be_embedded(own_buffers: Path) -> None:
    class Holed(Thumbnail):
        def features(self, prepared: Any) -> Any:
            prepared[-1, 5] = 1e6  # more than float16 holds
            return prepared

    class Broken(Thumbnail):
        def features(self, prepared: Any) -> Any:
            raise RuntimeError("out of memory")

    with raises(BuildError):
        make_index(own_buffers, Holed())
    with raises(BuildError):
        make_index(own_buffers, Broken())
    assert not list(own_buffers.glob("*/index/thumbnail"))


def test_concurrent_indexing_is_an_error(own_buffers: Path) -> None:
    folder = staging_path(own_buffers / "demonstrations" / "index" / "thumbnail")
    folder.mkdir(parents=True)
    with file_lock(folder / "lock", BuildError("busy")), raises(BuildError):
        make_index(own_buffers)


def test_the_files_are_the_golden_ones(own_buffers: Path) -> None:
    """A change here is a change of the format: raise its version."""
    build_index([own_buffers / "distractors"], TwoSums(), QUIET)
    written = own_buffers / "distractors" / "index"
    if os.environ.get("UPDATE_GOLDEN"):
        shutil.rmtree(GOLDEN, ignore_errors=True)
        shutil.copytree(written, GOLDEN / "golden" / "index")
    golden = files_of(GOLDEN).items()
    assert files_of(own_buffers) == {k.replace("golden/", "distractors/"): v for k, v in golden}
