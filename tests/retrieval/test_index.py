"""The index beside the data: what it holds, and how it is made and made again."""

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.retrieval import (
    EPISODE,
    QUIET,
    Interrupted,
    TwoSums,
    files_of,
    make_index,
    remade,
    roots_of,
)

from robomme_interference_data import load_buffer, load_split
from robomme_interference_data.embeddings import EmbeddingIndex, normalised
from robomme_interference_data.errors import (
    BuildError,
    InvalidOptionError,
    MissingIndexError,
    UnknownNameError,
)
from robomme_interference_data.files import LocalFiles, hold
from robomme_interference_data.retrieval.encoders.thumbnail import Thumbnail
from robomme_interference_data.retrieval.index import build_index
from robomme_interference_data.retrieval.select import measure
from robomme_interference_data.retrieval.selector import Selector

GOLDEN = Path(__file__).parent.parent / "golden" / "index"


def frames_in(split: Path) -> list[int]:
    """Stored frames of both datasets."""
    datasets = load_split(split).datasets
    return [sum(r.length for r in datasets[p.name].records()) for p in roots_of(split)]


def drop(split: Path, kind: str = "*") -> None:
    for path in split.glob(f"{kind}/index"):
        shutil.rmtree(path)


# --- what it holds -----------------------------------------------------------------------------


def test_a_buffers_embeddings_are_those_of_its_frames(indexed: Path) -> None:
    buffer = load_buffer(EPISODE, "k3", split=indexed)
    found = buffer.embeddings("thumbnail")
    assert found.dtype == np.float16 and found.shape == (len(buffer), 528)
    encoder, centre = Thumbnail(), buffer.query.dataset.index("thumbnail").centre
    assert np.array_equal(found, normalised(encoder.prepare(buffer.frames()), centre))
    query = normalised(encoder.prepare(buffer.query.frame()[None]), centre)[0]
    assert np.array_equal(buffer.query.embedding("thumbnail"), query)


@pytest.mark.parametrize("condition", ["no-history", "k0", "k3"])
def test_embeddings_are_the_callers(indexed: Path, condition: str) -> None:
    buffer = load_buffer(EPISODE, condition, split=indexed)
    once = buffer.embeddings("thumbnail")
    kept = once.copy()
    once += 1
    buffer.query.embedding("thumbnail")[:] = 0
    assert np.array_equal(buffer.embeddings("thumbnail"), kept)
    assert buffer.query.embedding("thumbnail").any()


def test_embeddings_of_sessions_in_any_order(indexed: Path) -> None:
    buffer = load_buffer(EPISODE, "k1", split=indexed)
    lesson, unit = buffer.manifest.sessions
    whole = buffer.embeddings("thumbnail")
    turned = remade(buffer, [unit, lesson]).embeddings("thumbnail")
    assert np.array_equal(turned, np.concatenate([whole[len(turned) - 32 :], whole[:-32]]))


def test_the_centre_is_the_mean_of_the_units(indexed: Path) -> None:
    units = load_split(indexed).datasets["distractors"]
    features = []
    for record in units.records():
        images = np.empty((record.length, 32, 32, 3), np.uint8)
        units.read_frames(record.episode_index, "front", 0, images)
        features.append(Thumbnail().prepare(images))
    index = load_buffer(EPISODE, "k0", split=indexed).query.dataset.index("thumbnail")
    expected = np.concatenate(features).mean(axis=0, dtype=np.float64)
    assert index.centre == pytest.approx(expected, abs=1e-6)
    assert index.header.pool == units.revision


def test_retrieval_does_not_depend_on_other_queries(indexed: Path, split: Path) -> None:
    # Units alone: what queries there are can have no part in centre and typical cosine.
    build_index([split / "distractors"], Thumbnail(), QUIET)
    place = "distractors/index/"
    expected = {k: v for k, v in files_of(indexed).items() if k.startswith(place)}
    assert files_of(split) == expected
    headers = [d.index("thumbnail").header for d in load_split(indexed).datasets.values()]
    assert headers[0].typical_cosine == headers[1].typical_cosine
    assert headers[0].encoder.sha256 == headers[1].encoder.sha256


def test_each_camera_has_an_index_of_its_own(split: Path) -> None:
    make_index(split)
    once = files_of(split)
    assert make_index(split, camera="wrist") == frames_in(split)
    both = files_of(split)
    assert {name: both[name] for name in once} == once and len(both) == 2 * len(once)
    buffer = load_buffer(EPISODE, "k1", split=split)
    centre = buffer.query.dataset.index("thumbnail", "wrist").centre
    expected = normalised(Thumbnail().prepare(buffer.frames("wrist")), centre)
    found = buffer.embeddings("thumbnail", "observation.images.wrist")
    assert np.array_equal(found, expected)
    selector = Selector("thumbnail", camera="wrist")
    assert (selector.name, selector.camera) == ("thumbnail@wrist/max/adaptive", "wrist")
    live = normalised(Thumbnail().prepare(buffer.query.frame("wrist")[None]), centre)[0]
    measured = measure(buffer, "thumbnail", "wrist")
    assert np.array_equal(measured.alike, measure(buffer, "thumbnail", "wrist", live).alike)
    for path in split.glob("*/index/thumbnail@wrist"):
        shutil.rmtree(path)
    with pytest.raises(MissingIndexError, match="camera 'wrist'") as caught:
        load_buffer(EPISODE, "k1", split=split).embeddings("thumbnail", "wrist")
    assert str(caught.value.hint).endswith("--encoder thumbnail --camera wrist")


# --- how it is made ----------------------------------------------------------------------------


def test_an_index_is_the_same_bytes_every_time(indexed: Path, split: Path) -> None:
    assert make_index(split, threads=3) == frames_in(split)
    assert files_of(split) == files_of(indexed)
    assert make_index(split) == [0, 0]  # it is there and right
    assert make_index(split, force=True) == frames_in(split)
    assert files_of(split) == files_of(indexed)


def test_an_interrupted_run_goes_on(indexed: Path, split: Path) -> None:
    # Units come first, two batches of 16 each: three are done, and the first of the fourth.
    with pytest.raises(KeyboardInterrupt):
        make_index(split, Interrupted(after=7))
    with pytest.raises(MissingIndexError):
        load_buffer(EPISODE, "k0", split=split).embeddings("thumbnail")
    demonstrations, units = frames_in(split)
    assert make_index(split) == [demonstrations, units - 3 * 32]
    assert files_of(split) == files_of(indexed)


def test_an_interrupted_run_of_another_batch_is_not_gone_on_with(
    split: Path, indexed: Path
) -> None:
    other = Interrupted(after=9)
    other.batch = 8
    with pytest.raises(KeyboardInterrupt):
        make_index(split, other)
    assert make_index(split) == frames_in(split)
    assert files_of(split) == files_of(indexed)


def test_each_dataset_is_made_by_itself(indexed: Path, split: Path) -> None:
    make_index(split)
    demonstrations, units = frames_in(split)
    for kind, embedded in (("distractors", [0, units]), ("demonstrations", [demonstrations, 0])):
        drop(split, kind)
        assert make_index(split) == embedded
        assert files_of(split) == files_of(indexed)


def test_an_index_of_another_device_is_kept(split: Path) -> None:
    make_index(split)
    computed = {"in": "cuda, bfloat16", "batch": 32}
    for path in split.glob("*/index/thumbnail/index.json"):
        path.write_text(json.dumps(json.loads(path.read_text()) | {"computed": computed}))
    reports = build_index(roots_of(split), Thumbnail(), QUIET)
    assert [r.embedded for r in reports] == [0, 0]
    assert [r.header.computed for r in reports] == [computed] * 2
    assert make_index(split, force=True) == frames_in(split)


@pytest.mark.parametrize(
    "name",
    ["chunk-000/episode-000003.npy", "SHA256SUMS", "centre.npy", "index.json", "stray.txt"],
)
def test_a_damaged_index_is_made_again(indexed: Path, split: Path, name: str) -> None:
    shutil.copytree(indexed, split, dirs_exist_ok=True)
    path = split / "distractors" / "index" / "thumbnail" / name
    path.write_bytes((path.read_bytes()[:-2] if path.exists() else b"") + b"xx")
    assert make_index(split)[1] == frames_in(split)[1]
    assert files_of(split) == files_of(indexed)


def test_other_units_make_it_anew(split: Path) -> None:
    # As if the units had changed: the demonstrations' centre is of others.
    make_index(split)
    header = split / "demonstrations/index/thumbnail/index.json"
    header.write_text(json.dumps(json.loads(header.read_text()) | {"pool": "0" * 64}))
    assert make_index(split) == [frames_in(split)[0], 0]


# --- refusals ----------------------------------------------------------------------------------


def test_what_is_not_finite_is_not_stored(split: Path) -> None:
    class Holed(Thumbnail):
        def features(self, prepared: Any) -> Any:
            prepared[-1, 5] = np.inf
            return prepared

    with pytest.raises(BuildError, match=r"not finite for \w+/train/\d"):
        make_index(split, Holed())
    assert not list(split.glob("*/index/thumbnail"))


def test_an_encoder_that_breaks_is_told(split: Path) -> None:
    class Broken(Thumbnail):
        def features(self, prepared: Any) -> Any:
            raise RuntimeError("out of memory")

    with pytest.raises(BuildError, match=r"/train/\d cannot be embedded: .*out of memory"):
        make_index(split, Broken())


def test_two_do_not_make_one_index(split: Path) -> None:
    folder = split / "demonstrations" / "index" / ".thumbnail"
    folder.mkdir(parents=True)
    with hold(folder / "lock", BuildError("busy")), pytest.raises(BuildError, match="another"):
        make_index(split)


def test_what_cannot_be_indexed(tiny_split: Path) -> None:
    with pytest.raises(InvalidOptionError, match="demonstrations; expected distractor units"):
        build_index([tiny_split / "demonstrations"], Thumbnail(), QUIET)
    with pytest.raises(UnknownNameError, match="camera 'side'"):
        make_index(tiny_split, camera="side")
    with pytest.raises(InvalidOptionError, match="threads 0"):
        make_index(tiny_split, threads=0)
    assert not list(tiny_split.glob("*/index"))


# --- the files ---------------------------------------------------------------------------------


def test_the_files_are_the_golden_ones(split: Path) -> None:
    """A change here is a change of the format: `docs/format.md`, and the format version."""
    make_index(split, TwoSums())
    written = split / "distractors" / "index" / "thumbnail"
    golden = GOLDEN / "index" / "thumbnail"
    if os.environ.get("UPDATE_GOLDEN"):
        shutil.rmtree(golden, ignore_errors=True)
        shutil.copytree(written, golden)
    for folder in (written, golden):
        names = {p.relative_to(folder).as_posix(): p for p in folder.rglob("*") if p.is_file()}
        if folder == written:
            found = names
    assert found.keys() == names.keys()
    for name, path in names.items():
        assert found[name].read_bytes() == path.read_bytes(), name


def test_a_golden_index_is_read() -> None:
    header = json.loads((GOLDEN / "index" / "thumbnail" / "index.json").read_text())
    index = EmbeddingIndex(LocalFiles(GOLDEN), header["revision"], "thumbnail")
    index.check(dict.fromkeys(range(header["frames"] // 32), 32))
    found = index.span(6, 30, 32)
    assert found.shape == (2, 3) and found.dtype == np.float16
    assert np.linalg.norm(found.astype(float), axis=1) == pytest.approx([1, 1], abs=2e-3)
    assert index.centre is not None and index.centre[2] == 16
    assert index.header.camera == "front" and index.header.size == 3
