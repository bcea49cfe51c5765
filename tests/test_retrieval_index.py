"""The index beside the data: what it holds, and how it is made and made again."""

import json
import shutil
from pathlib import Path
from typing import Any

import factories
import numpy as np
import pytest
import retrieval_indexes
from retrieval_indexes import EPISODE, QUIET, files_of, make_index

from robomme_interference_data import load_buffer, load_split
from robomme_interference_data.build_dataset.sample import write_sample
from robomme_interference_data.embeddings import normalised
from robomme_interference_data.errors import (
    BuildError,
    InvalidOptionError,
    MissingFileError,
    MissingIndexError,
    UnknownNameError,
)
from robomme_interference_data.retrieval.commands import datasets_in
from robomme_interference_data.retrieval.encoders import make_encoder
from robomme_interference_data.retrieval.encoders.thumbnail import Thumbnail
from robomme_interference_data.retrieval.index import build_index
from robomme_interference_data.retrieval.selector import Selector, select

split = retrieval_indexes.split  # the fixture


def test_a_buffers_embeddings_are_those_of_its_frames(split: Path) -> None:
    # 8 demonstrations: index 0 has 20 + 1 frames, index 1 has 36 + 1; 7 units of 32.
    assert make_index(split) == [4 * (21 + 37), 7 * 32]
    buffer = load_buffer(EPISODE, 3, split)
    found = buffer.embeddings("thumbnail")
    assert found.dtype == np.float16 and found.shape == (20 + 3 * 32, 528)
    encoder, centre = Thumbnail(), buffer.query_index("thumbnail").centre
    assert np.array_equal(found, normalised(encoder.prepare(buffer.frames()), centre))
    query = normalised(encoder.prepare(buffer.query_frame()[None]), centre)[0]
    assert np.array_equal(buffer.query_embedding("thumbnail"), query)


def test_an_index_is_the_same_bytes_every_time(split: Path) -> None:
    make_index(split)
    once = files_of(split)
    assert make_index(split) == [0, 0]  # it is there and right
    assert files_of(split) == once
    for path in split.glob("*/index"):
        shutil.rmtree(path)
    make_index(split, threads=3)
    assert files_of(split) == once


def test_an_interrupted_run_goes_on(split: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_index(split)
    once = files_of(split)
    for path in split.glob("*/index"):
        shutil.rmtree(path)
    interrupted(split, monkeypatch)
    with pytest.raises(MissingIndexError):
        load_buffer(EPISODE, 0, split).embeddings("thumbnail")
    # Three units of 32 frames were done.
    assert make_index(split) == [4 * (21 + 37), 4 * 32]
    assert files_of(split) == once


def interrupted(split: Path, monkeypatch: pytest.MonkeyPatch, after: int = 3) -> None:
    """Begin an index, and break off after some batches."""
    calls = 0

    def features(_: Thumbnail, prepared: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls > after:
            raise KeyboardInterrupt
        return prepared

    with monkeypatch.context() as patch:
        patch.setattr(Thumbnail, "features", features)
        with pytest.raises(KeyboardInterrupt):
            make_index(split)


def test_parts_of_another_batch_or_device_are_refused(
    split: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupted(split, monkeypatch)
    with monkeypatch.context() as patch:
        patch.setattr(Thumbnail, "batch", 8)
        with pytest.raises(BuildError, match="computed with numpy, 64 images") as caught:
            make_index(split)
        assert "--batch 64" in str(caught.value.hint) and "--force" in str(caught.value.hint)
        # All 7 units, though three were done.
        assert make_index(split, force=True) == [4 * (21 + 37), 7 * 32]
    header = json.loads((split / "distractors/index/thumbnail/index.json").read_text())
    assert header["computed"] == {"in": "numpy", "batch": 8}


def test_each_dataset_is_made_by_itself(split: Path) -> None:
    make_index(split)
    once = files_of(split)
    for kind, embedded in (("distractors", [0, 7 * 32]), ("demonstrations", [4 * (21 + 37), 0])):
        shutil.rmtree(split / kind / "index")
        assert make_index(split) == embedded
        assert files_of(split) == once


def test_an_index_of_another_device_is_kept(split: Path) -> None:
    make_index(split)
    for path in split.glob("*/index/thumbnail/index.json"):
        header = json.loads(path.read_text())
        header["computed"] = {"in": "cuda, bfloat16", "batch": 32}
        path.write_text(json.dumps(header))
    reports = build_index(datasets_in(split), make_encoder("thumbnail"), QUIET)
    assert [r.embedded for r in reports] == [0, 0]
    assert {(r.computed_in, r.batch) for r in reports} == {("cuda, bfloat16", 32)}
    assert make_index(split, force=True) == [4 * (21 + 37), 7 * 32]


def test_what_a_killed_run_left_is_swept(split: Path) -> None:
    make_index(split)
    once = files_of(split)
    left = split / "distractors" / "index" / "thumbnail" / ".embeddings.npy.a1b2.partial"
    left.write_bytes(b"half")
    assert make_index(split) == [0, 0]
    assert files_of(split) == once


def test_what_is_not_finite_is_not_stored(split: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def features(_: Thumbnail, prepared: Any) -> Any:
        prepared[-1, 5] = np.inf
        return prepared

    monkeypatch.setattr(Thumbnail, "features", features)
    with pytest.raises(BuildError, match=r"not finite for frames up to 31 of VideoRepick/train/0"):
        make_index(split)


def test_a_damaged_index_is_made_again(split: Path) -> None:
    make_index(split)
    once = files_of(split)
    path = split / "distractors" / "index" / "thumbnail" / "embeddings.npy"
    path.write_bytes(path.read_bytes()[:-2] + b"xx")
    assert make_index(split)[1] == 7 * 32
    assert files_of(split) == once


def test_each_camera_has_an_index_of_its_own(split: Path) -> None:
    make_index(split)
    once = files_of(split)
    assert make_index(split, camera="wrist") == [4 * (21 + 37), 7 * 32]
    both = files_of(split)
    assert {name: both[name] for name in once} == once and len(both) == 2 * len(once)
    buffer = load_buffer(EPISODE, 1, split)
    centre = buffer.query_index("thumbnail", "wrist").centre
    expected = normalised(Thumbnail().prepare(buffer.frames("wrist")), centre)
    assert np.array_equal(buffer.embeddings("thumbnail", "wrist"), expected)
    selector = Selector("thumbnail", camera="wrist")
    assert (selector.name, selector.camera) == ("thumbnail@wrist/max/adaptive", "wrist")
    chosen = selector.select(buffer, buffer.query_frame("wrist"))
    stored = select(buffer, "thumbnail", selector.rule, camera="wrist")
    assert (chosen.start, chosen.stop) == (stored.start, stored.stop)
    for path in split.glob("*/index/thumbnail@wrist"):
        shutil.rmtree(path)
    with pytest.raises(MissingIndexError, match="camera 'wrist'") as caught:
        load_buffer(EPISODE, 1, split).embeddings("thumbnail", "wrist")
    assert str(caught.value.hint).endswith("--encoder thumbnail --camera wrist")


def test_retrieval_does_not_depend_on_other_queries(split: Path, tmp_path: Path) -> None:
    make_index(split)
    # The same but for the queries: one of each family instead of two.
    sample = tmp_path / "sample"
    for _ in write_sample(
        sample, families=factories.FAMILIES, train=2, test=1, size=64, demonstration=20
    ):
        pass
    fewer = factories.build_split(sample, tmp_path / "fewer")
    assert make_index(fewer) == [4 * 21, 7 * 32]
    one, other = (load_buffer(EPISODE, 0, folder) for folder in (split, fewer))
    assert np.array_equal(one.embeddings("thumbnail"), other.embeddings("thumbnail"))
    indexes = [buffer.query_index("thumbnail") for buffer in (one, other)]
    assert indexes[0].typical_cosine == indexes[1].typical_cosine
    assert indexes[0].made == indexes[1].made


def test_the_centre_is_the_mean_of_the_units(split: Path) -> None:
    make_index(split)
    units = load_split(split).datasets["distractors"]
    features = []
    for episode in range(7):
        images = np.empty((32, 64, 64, 3), np.uint8)
        units.read_frames(episode, "observation.images.front", 0, images)
        features.append(Thumbnail().prepare(images))
    index = load_buffer(EPISODE, 0, split).query_index("thumbnail")
    expected = np.concatenate(features).mean(axis=0, dtype=np.float64)
    assert index.centre == pytest.approx(expected, abs=1e-6)
    assert index.pool == units.revision


def test_units_are_indexed_alone_but_no_demonstrations(split: Path) -> None:
    make_index(split)
    once = files_of(split)
    shutil.rmtree(split / "distractors" / "index")
    build_index([split / "distractors"], make_encoder("thumbnail"), QUIET)
    assert files_of(split) == once
    with pytest.raises(InvalidOptionError, match="demonstrations; expected distractor units"):
        build_index([split / "demonstrations"], make_encoder("thumbnail"), QUIET)


def test_what_is_no_data_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="neither a split"):
        datasets_in(tmp_path)
    with pytest.raises(UnknownNameError, match="camera 'side'"):
        build_index([factories.split() / "distractors"], Thumbnail(), QUIET, camera="side")
