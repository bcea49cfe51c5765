"""Encoders, the index beside the data, and the selector of rollouts."""

import io
import json
import shutil
from hashlib import sha256
from pathlib import Path
from typing import Any

import factories
import numpy as np
import pytest

from robomme_interference_data import load_buffer, load_split
from robomme_interference_data.build_dataset.sample import write_sample
from robomme_interference_data.build_dataset.verify import verify_split
from robomme_interference_data.embeddings import encoder_id, index_folder, normalised
from robomme_interference_data.errors import (
    BuildError,
    FormatError,
    InvalidOptionError,
    MissingFileError,
    MissingIndexError,
    StaleIndexError,
    UnknownNameError,
)
from robomme_interference_data.progress import BuildProgress
from robomme_interference_data.retrieval.commands import datasets_in
from robomme_interference_data.retrieval.encoders import make_encoder
from robomme_interference_data.retrieval.encoders.thumbnail import Thumbnail
from robomme_interference_data.retrieval.index import build_index
from robomme_interference_data.retrieval.segment import adaptive_threshold
from robomme_interference_data.retrieval.select import Rule
from robomme_interference_data.retrieval.selector import Selector, select

QUIET = BuildProgress(quiet=True)
EPISODE = "VideoRepick/test/0"


def make_index(split: Path, encoder: str = "thumbnail", **options: Any) -> list[int]:
    reports = build_index(datasets_in(split), make_encoder(encoder), QUIET, **options)
    return [report.embedded for report in reports]


def files_of(split: Path) -> dict[str, bytes]:
    return {
        path.relative_to(split).as_posix(): path.read_bytes()
        for path in split.glob("*/index/**/*")
        if path.is_file()
    }


@pytest.fixture
def split(tmp_path: Path) -> Path:
    return factories.copy_of_split(tmp_path / "split")


def test_thumbnail_by_hand() -> None:
    # 16 × 16 pixels, 2 × 2 a cell: upper half black, lower half red.
    image = np.zeros((16, 16, 3), np.uint8)
    image[8:, :, 0] = 255
    encoder = Thumbnail()
    (row,) = encoder.features(encoder.prepare(image[None]))
    colours, right, below = row[:192], row[192:360], row[360:]
    assert colours.reshape(8, 8, 3)[:, 0].tolist() == [[0, 0, 0]] * 4 + [[1, 0, 0]] * 4
    assert not right.any()
    steps = below.reshape(7, 8, 3)
    assert steps[3].tolist() == [[1, 0, 0]] * 8 and steps.sum() == 8
    with pytest.raises(InvalidOptionError, match="4 × 9 pixels"):
        encoder.prepare(np.zeros((1, 4, 9, 3), np.uint8))


def test_cells_of_uneven_size_are_means() -> None:
    image = np.random.default_rng(0).integers(0, 256, (21, 11, 3), np.uint8)
    (row,) = Thumbnail().prepare(image[None])
    # Cell (2, 7): rows 5 to 6 (42 // 8, 63 // 8 = 7 excluded), columns 9 and 10.
    expected = image[5:7, 9:11].mean(axis=(0, 1)) / 255
    assert row[:192].reshape(8, 8, 3)[2, 7] == pytest.approx(expected, abs=1e-6)


def test_normalising() -> None:
    rows = normalised(np.array([[3, 4], [1, 1]]), np.array([0, 0], np.float32))
    assert rows.dtype == np.float16
    assert rows[0] == pytest.approx([0.6, 0.8], abs=1e-3)
    # Nothing is left of the centre itself.
    assert normalised(np.array([[1, 1]]), np.array([1, 1], np.float32)).tolist() == [[0, 0]]


@pytest.mark.parametrize(
    ("encoder", "folder"),
    [
        ("thumbnail", "index/thumbnail"),
        ("siglip", "index/siglip"),
        ("siglip:google/siglip2-base@abc", "index/siglip-siglip2-base"),
        ("siglip:models/my model", "index/siglip-my-model"),
        ("siglip:google/siglip-so400m-patch14-384", "index/siglip"),
        ("siglip:google/siglip-so400m-patch14-384@main", "index/siglip"),
    ],
)
def test_folders(encoder: str, folder: str) -> None:
    assert index_folder(encoder) == index_folder(encoder, "observation.images.front") == folder
    assert index_folder(encoder, "wrist") == f"{folder}@wrist"


def test_a_model_in_a_folder_is_called_by_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "tiny"
    folder.mkdir()
    monkeypatch.chdir(folder)
    for model in (".", "../tiny", str(folder)):
        assert encoder_id(f"siglip:{model}") == "siglip:tiny"
        assert index_folder(f"siglip:{model}") == "index/siglip-tiny"
    assert index_folder("siglip:/") == "index/siglip-"  # not the paper's model


def test_two_models_of_one_name_are_told_apart(split: Path) -> None:
    encoder = Thumbnail()
    encoder.name = "siglip:one/tiny"
    build_index(datasets_in(split), encoder, QUIET)
    buffer = load_buffer(EPISODE, 1, split)
    assert len(buffer.embeddings("siglip:one/tiny@v2")) == 20 + 32
    with pytest.raises(StaleIndexError, match="of encoder 'siglip:one/tiny'") as caught:
        buffer.embeddings("siglip:two/tiny")
    assert "index --data" in str(caught.value.hint)


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


def test_what_identifies_a_selector(split: Path) -> None:
    make_index(split)
    buffer = load_buffer(EPISODE, 1, split)
    index = buffer.query_index("thumbnail")
    assert Selector("thumbnail").identity(buffer) == {
        "encoder": "thumbnail",
        "fingerprint": index.fingerprint,
        "camera": "front",
        "method": "max",
        "cut": "adaptive",
        "threshold": (1 + index.typical_cosine) / 2,
    }
    fixed = Selector("thumbnail", rule="mean/0.5").identity(buffer)
    assert (fixed["method"], fixed["cut"], fixed["threshold"]) == ("mean", 0.5, 0.5)


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


def test_the_selector(split: Path) -> None:
    make_index(split)
    selector = Selector("thumbnail")
    assert (selector.name, selector.camera) == ("thumbnail/max/adaptive", "front")
    assert Selector("thumbnail", rule="mean/0.9").name == "thumbnail/mean/0.9"
    for buffer in load_split(split).buffers(k=3):
        index = buffer.query_index("thumbnail")
        assert selector.rule.threshold(index.typical_cosine) == adaptive_threshold(
            index.typical_cosine
        )
        chosen = selector.select(buffer, buffer.query_frame())
        stored = select(buffer, "thumbnail", selector.rule)
        assert (chosen.start, chosen.stop) == (stored.start, stored.stop)
        # An even sample of the span with the live observation as the last of its frames.
        roles = [*buffer.session_index[chosen.start : chosen.stop], -1]
        count = min(len(roles), 32)
        sample = [roles[j * (len(roles) - 1) // (count - 1)] for j in range(count)]
        assert chosen.lesson_fraction == sample.count(0) / count
        assert chosen.filler_fraction == sum(role > 0 for role in sample) / count
        assert chosen.query_fraction == 1 / count
    whole = select(load_buffer(EPISODE, 1, split), "thumbnail", Rule(cut=-1.0))
    # One segment of 52 frames; j · 52 // 31 is below 20 for j = 0 … 11, 52 for j = 31.
    assert (whole.start, whole.stop) == (0, 52)
    assert whole.lesson_fraction == 12 / 32
    assert (whole.filler_fraction, whole.query_fraction) == (19 / 32, 1 / 32)


def test_the_selector_refuses() -> None:
    for rule, error in (
        ("top32", InvalidOptionError),
        ("best", UnknownNameError),
        ("max/2.0", InvalidOptionError),
    ):
        with pytest.raises(error):
            Selector("thumbnail", rule=rule)
    with pytest.raises(UnknownNameError, match="'thumbnial'"):
        Selector("thumbnial")
    with pytest.raises(InvalidOptionError, match="no models"):
        make_encoder("thumbnail:x")


def test_what_is_no_data_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="neither a split"):
        datasets_in(tmp_path)
    with pytest.raises(UnknownNameError, match="camera 'side'"):
        build_index([factories.split() / "distractors"], Thumbnail(), QUIET, camera="side")
