"""The index beside the data: what it holds, and how it is made and made again."""

import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.retrieval import (
    FRAMES,
    QUIET,
    Interrupted,
    TwoSums,
    change_header,
    files_of,
    make_index,
    remade,
)
from support.splits import QUERIES, UNITS

from robomme_interference_data import load_buffer, load_split
from robomme_interference_data.embeddings import normalised
from robomme_interference_data.errors import BuildError, MissingIndexError
from robomme_interference_data.files import hold, work_folder
from robomme_interference_data.retrieval.encoders.thumbnail import Thumbnail
from robomme_interference_data.retrieval.index import build_index
from robomme_interference_data.retrieval.select import measure

GOLDEN = Path(__file__).parents[1] / "golden" / "index"

# --- what it holds -----------------------------------------------------------------------------


def test_a_buffers_embeddings_are_those_of_its_frames(indexed: Path) -> None:
    buffer = load_buffer(QUERIES[0], "k3", split=indexed)
    found = buffer.embeddings("thumbnail")
    assert found.dtype == np.float16 and found.shape == (48 + 3 * 32, 528)
    encoder, centre = Thumbnail(), buffer.query.dataset.index("thumbnail").centre
    assert np.array_equal(found, normalised(encoder.prepare(buffer.frames()), centre))
    query = normalised(encoder.prepare(buffer.query.frame()[None]), centre)[0]
    assert np.array_equal(buffer.query.embedding("thumbnail"), query)
    lesson, unit, *_ = buffer.manifest.sessions
    turned = remade(indexed, [unit, lesson]).embeddings("thumbnail")
    assert np.array_equal(turned, np.concatenate([found[48:80], found[:48]]))


def test_embeddings_are_the_callers(indexed: Path) -> None:
    assert load_buffer(QUERIES[0], "no-history", split=indexed).embeddings("thumbnail").size == 0
    buffer = load_buffer(QUERIES[0], "k0", split=indexed)
    once = buffer.embeddings("thumbnail")
    kept = once.copy()
    once += 1
    buffer.query.embedding("thumbnail")[:] = 0
    assert np.array_equal(buffer.embeddings("thumbnail"), kept)
    assert buffer.query.embedding("thumbnail").any()


def test_centre_and_typical_cosine_are_of_the_units_alone(indexed: Path, own_split: Path) -> None:
    datasets = load_split(indexed).datasets
    units, images = datasets["distractors"], np.empty((UNITS, 32, 32, 32, 3), np.uint8)
    for episode in range(UNITS):
        units.read_frames(episode, "front", 0, images[episode])
    expected = Thumbnail().prepare(images.reshape(-1, 32, 32, 3)).mean(axis=0, dtype=np.float64)
    headers = []
    for dataset in datasets.values():
        index = dataset.index("thumbnail")
        assert index.centre == pytest.approx(expected, abs=1e-6)
        headers.append((index.made, index.header.typical_cosine))
        assert index.header.pool == units.revision
    assert headers[0] == headers[1]
    # Made without any demonstration, they are the same.
    build_index([own_split / "distractors"], Thumbnail(), QUIET)
    place = "distractors/index/"
    assert files_of(own_split) == {k: v for k, v in files_of(indexed).items() if place in k}


def test_each_camera_has_an_index_of_its_own(indexed: Path, own_split: Path) -> None:
    shutil.copytree(indexed, own_split, dirs_exist_ok=True)
    once = files_of(own_split)
    assert make_index(own_split, camera="wrist") == FRAMES
    both = files_of(own_split)
    assert {name: both[name] for name in once} == once and len(both) == 2 * len(once)
    buffer = load_buffer(QUERIES[0], "k1", split=own_split)
    centre = buffer.query.dataset.index("thumbnail", "wrist").centre
    expected = normalised(Thumbnail().prepare(buffer.frames("wrist")), centre)
    found = buffer.embeddings("thumbnail", "observation.images.wrist")
    assert np.array_equal(found, expected)
    live = normalised(Thumbnail().prepare(buffer.query.frame("wrist")[None]), centre)[0]
    measured = measure(buffer, "thumbnail", "wrist")
    assert np.array_equal(measured.alike, measure(buffer, "thumbnail", "wrist", live).alike)


# --- how it is made ----------------------------------------------------------------------------


def test_an_index_is_the_same_bytes_every_time(indexed: Path, own_split: Path) -> None:
    assert make_index(own_split, threads=3) == FRAMES
    assert files_of(own_split) == files_of(indexed)
    assert make_index(own_split) == [0, 0]  # it is there and right
    assert make_index(own_split, force=True) == FRAMES
    assert files_of(own_split) == files_of(indexed)


def test_an_interrupted_run_goes_on(indexed: Path, own_split: Path) -> None:
    # Units come first, two batches of 16 each: three are done, and the first of the fourth.
    with pytest.raises(KeyboardInterrupt):
        make_index(own_split, Interrupted(after=7))
    with pytest.raises(MissingIndexError):
        load_buffer(QUERIES[0], "k0", split=own_split).embeddings("thumbnail")
    assert make_index(own_split) == [FRAMES[0], FRAMES[1] - 3 * 32]
    assert files_of(own_split) == files_of(indexed)


@pytest.mark.parametrize(
    ("name", "again"),
    [
        ("distractors", [0, FRAMES[1]]),
        ("demonstrations", [FRAMES[0], 0]),
        ("distractors/index/thumbnail/chunk-000/episode-000003.npy", [0, FRAMES[1]]),
        ("distractors/index/thumbnail/SHA256SUMS", [0, FRAMES[1]]),
        ("distractors/index/thumbnail/index.json", [0, FRAMES[1]]),
        ("demonstrations/index/thumbnail/centre.npy", [FRAMES[0], 0]),
        ("demonstrations/index/thumbnail/stray.txt", [FRAMES[0], 0]),
    ],
)
def test_what_is_missing_or_damaged_is_made_again(
    indexed: Path, own_split: Path, name: str, again: list[int]
) -> None:
    shutil.copytree(indexed, own_split, dirs_exist_ok=True)
    path = own_split / name
    if path.is_dir():
        shutil.rmtree(path / "index")
    else:
        path.write_bytes((path.read_bytes()[:-2] if path.exists() else b"") + b"xx")
    assert make_index(own_split) == again
    assert files_of(own_split) == files_of(indexed)


def test_an_index_of_another_device_is_kept_one_of_other_units_is_not(
    indexed: Path, own_split: Path
) -> None:
    shutil.copytree(indexed, own_split, dirs_exist_ok=True)
    header = own_split / "demonstrations/index/thumbnail/index.json"
    change_header(header, computed={"in": "cuda, bfloat16", "batch": 32})
    assert make_index(own_split) == [0, 0]
    change_header(header, pool="0" * 64)
    assert make_index(own_split) == [FRAMES[0], 0]


# --- refusals ----------------------------------------------------------------------------------


def test_what_cannot_be_embedded(own_split: Path) -> None:
    class Holed(Thumbnail):
        def features(self, prepared: Any) -> Any:
            prepared[-1, 5] = np.inf
            return prepared

    class Broken(Thumbnail):
        def features(self, prepared: Any) -> Any:
            raise RuntimeError("out of memory")

    with pytest.raises(BuildError, match=r"not finite for \w+/train/\d"):
        make_index(own_split, Holed())
    with pytest.raises(BuildError, match=r"/train/\d cannot be embedded: .*out of memory"):
        make_index(own_split, Broken())
    assert not list(own_split.glob("*/index/thumbnail"))


def test_two_do_not_make_one_index(own_split: Path) -> None:
    folder = work_folder(own_split / "demonstrations" / "index" / "thumbnail")
    folder.mkdir(parents=True)
    with hold(folder / "lock", BuildError("busy")), pytest.raises(BuildError, match="another"):
        make_index(own_split)


# --- the files ---------------------------------------------------------------------------------


def test_the_files_are_the_golden_ones(own_split: Path) -> None:
    """A change here is a change of the format: `docs/format.md`, and the format version."""
    build_index([own_split / "distractors"], TwoSums(), QUIET)
    written = own_split / "distractors" / "index"
    if os.environ.get("UPDATE_GOLDEN"):
        shutil.rmtree(GOLDEN, ignore_errors=True)
        shutil.copytree(written, GOLDEN / "golden" / "index")
    golden = files_of(GOLDEN).items()
    assert files_of(own_split) == {k.replace("golden/", "distractors/"): v for k, v in golden}
