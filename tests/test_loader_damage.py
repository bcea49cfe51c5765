"""Every kind of damage to a split gives the one right error."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import factories
import numpy as np
import pyarrow.parquet as pq
import pytest

from robomme_interference_data import load_buffer
from robomme_interference_data.errors import (
    FormatError,
    HashMismatchError,
    InterferenceError,
    InvalidIdError,
    MissingFileError,
    TruncatedVideoError,
)

EPISODE = "VideoUnmask/test/1"


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    return factories.copy_of_split(tmp_path / "split")


MP4 = "demonstrations/videos/observation.images.front/chunk-000/file-001.mp4"
UNIT_MP4 = "distractors/videos/observation.images.wrist/chunk-000/file-000.mp4"
DATA = "demonstrations/data/chunk-000/file-001.parquet"
PARQUET = "manifests/buffers.parquet"
HEADER = "manifests/manifest.json"


def use_everything(root: Path, verify: bool) -> None:
    """Load and read the k3 buffer: it holds the lesson and a unit of each other family."""
    buffer = load_buffer(EPISODE, 3, root, verify=verify)
    for camera in buffer.cameras:
        buffer.frames(camera)
    assert len(buffer.states) == len(buffer)


def cut(path: Path, share: float) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])


def edit_json(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


def without(path: Path, column: str) -> None:
    pq.write_table(pq.ParquetFile(path).read().drop_columns([column]), path)


def swap(one: Path, other: Path) -> None:
    between = one.with_suffix(".between")
    one.rename(between)
    other.rename(one)
    between.rename(other)


Damage = tuple[Callable[[Path], object], type[InterferenceError], str]
DAMAGES: dict[str, Damage] = {
    "missing video": (
        lambda root: (root / MP4).unlink(),
        MissingFileError,
        r"file-001\.mp4 is missing in .*demonstrations\nThe folder is not a complete dataset",
    ),
    "missing video of a unit": (
        lambda root: (root / UNIT_MP4).unlink(),
        MissingFileError,
        r"videos/observation\.images\.wrist/chunk-000/file-000\.mp4 is missing in .*distractors",
    ),
    "video cut in the middle": (
        lambda root: cut(root / MP4, 0.5),
        TruncatedVideoError,
        r"file-001\.mp4: .*\nThe file is damaged or incomplete: download or build it again",
    ),
    "video cut before its header": (
        lambda root: cut(root / MP4, 0.002),
        FormatError,
        r"file-001\.mp4 is not a readable video",
    ),
    "empty video": (
        lambda root: (root / MP4).write_bytes(b""),
        FormatError,
        r"file-001\.mp4 is not a readable video",
    ),
    "garbage instead of a video": (
        lambda root: (root / MP4).write_bytes(b"garbage" * 1000),
        FormatError,
        r"file-001\.mp4 is not a readable video",
    ),
    "a shorter video": (
        lambda root: (
            shutil.copyfile(root / MP4.replace("file-001", "file-000"), root / MP4)
            and cut(root / MP4, 0.3)
        ),
        TruncatedVideoError,
        r"file-001\.mp4",
    ),
    "missing data": (
        lambda root: (root / DATA).unlink(),
        MissingFileError,
        r"data/chunk-000/file-001\.parquet is missing in .*demonstrations",
    ),
    "garbage instead of data": (
        lambda root: (root / DATA).write_bytes(b"garbage" * 100),
        FormatError,
        r"data/chunk-000/file-001\.parquet cannot be read: .*\nThe file is damaged",
    ),
    "empty data": (
        lambda root: (root / DATA).write_bytes(b""),
        FormatError,
        r"data/chunk-000/file-001\.parquet cannot be read",
    ),
    "data cut": (
        lambda root: cut(root / DATA, 0.7),
        FormatError,
        r"data/chunk-000/file-001\.parquet cannot be read",
    ),
    "data of fewer frames": (
        lambda root: pq.write_table(pq.ParquetFile(root / DATA).read().slice(0, 40), root / DATA),
        TruncatedVideoError,
        r"file-001\.parquet: episode 3 has 19 frames in the data file; 37 are recorded",
    ),
    "data of no frame": (
        lambda root: pq.write_table(pq.ParquetFile(root / DATA).read().slice(0, 20), root / DATA),
        TruncatedVideoError,
        r"file-001\.parquet: episode 3 has 0 frames in the data file; 37 are recorded",
    ),
    "data without the states": (
        lambda root: without(root / DATA, "observation.state"),
        FormatError,
        r"data/chunk-000/file-001\.parquet lacks observation\.state",
    ),
    "data without frame numbers": (
        lambda root: without(root / DATA, "frame_index"),
        FormatError,
        r"data/chunk-000/file-001\.parquet lacks frame_index",
    ),
    "data without episode numbers": (
        lambda root: without(root / DATA, "episode_index"),
        FormatError,
        r"data/chunk-000/file-001\.parquet lacks episode_index",
    ),
    "missing episodes": (
        lambda root: shutil.rmtree(root / "demonstrations/meta/episodes"),
        MissingFileError,
        "meta/episodes holds no parquet file in .*demonstrations",
    ),
    "garbage instead of episodes": (
        lambda root: (root / "distractors/meta/episodes/chunk-000/file-000.parquet").write_bytes(
            b"garbage"
        ),
        FormatError,
        r"distractors/meta/episodes/chunk-000/file-000\.parquet cannot be read",
    ),
    "no demonstrations": (
        lambda root: shutil.rmtree(root / "demonstrations"),
        MissingFileError,
        r"meta/info\.json is missing in .*demonstrations",
    ),
    "no distractors": (
        lambda root: shutil.rmtree(root / "distractors"),
        MissingFileError,
        r"meta/info\.json is missing in .*distractors",
    ),
    "another dataset": (
        lambda root: swap(root / "demonstrations", root / "distractors"),
        HashMismatchError,
        r"demonstrations has revision [0-9a-f]{12}…; the manifests were made for [0-9a-f]{12}…\n"
        "Put the right dataset there, or build the manifests again: robomme-interference build",
    ),
    "another revision": (
        lambda root: edit_json(
            root / "distractors/meta/interference.json", lambda v: v.update(revision="0" * 64)
        ),
        HashMismatchError,
        "distractors has revision 000000000000…; the manifests were made for",
    ),
    "manifests of an unknown version": (
        lambda root: edit_json(root / HEADER, lambda v: v.update(format_version=99)),
        FormatError,
        "has format version 99; this package reads 1\nInstall the version of robomme-interference",
    ),
    "manifests without a version": (
        lambda root: edit_json(root / HEADER, lambda v: v.pop("format_version")),
        FormatError,
        "has format version None; this package reads 1",
    ),
    "header is no JSON": (
        lambda root: cut(root / HEADER, 0.5),
        FormatError,
        r"manifest\.json is not JSON",
    ),
    "header is a list": (
        lambda root: (root / HEADER).write_text("[]"),
        FormatError,
        r"manifest\.json holds no JSON object",
    ),
    **{
        f"header without {key}": (
            lambda root, key=key: edit_json(root / HEADER, lambda v: v.pop(key)),
            FormatError,
            rf"manifest\.json lacks {key}",
        )
        for key in ("k", "datasets", "counts")
    },
    "no manifest table": (
        lambda root: (root / PARQUET).unlink(),
        MissingFileError,
        r"buffers\.parquet is missing in .*manifests",
    ),
    "manifest table cut": (
        lambda root: cut(root / PARQUET, 0.5),
        FormatError,
        r"buffers\.parquet cannot be read",
    ),
    "garbage instead of the manifest table": (
        lambda root: (root / PARQUET).write_bytes(b"garbage" * 100),
        FormatError,
        r"buffers\.parquet cannot be read",
    ),
    "manifest table without goals": (
        lambda root: without(root / PARQUET, "goals"),
        FormatError,
        r"buffers\.parquet does not have the columns of format version 1: goals missing\nBuild",
    ),
}


@pytest.mark.parametrize("verify", [False, True])
@pytest.mark.parametrize("name", DAMAGES)
def test_damage_is_named(name: str, verify: bool, copy: Path) -> None:
    damage, error, message = DAMAGES[name]
    damage(copy)
    with pytest.raises(error, match=message):
        use_everything(copy, verify)


def test_the_undamaged_copy_is_fine(copy: Path) -> None:
    use_everything(copy, verify=True)


@pytest.mark.parametrize("relative", [MP4, DATA, PARQUET, "demonstrations/meta/episodes"])
def test_a_flipped_bit_is_found_or_changes_nothing(relative: str, copy: Path) -> None:
    """With `verify`, whatever loads is what was built; and there is never another error."""
    expected = load_buffer(EPISODE, 3, factories.split())
    frames, states = expected.frames(), expected.states
    path = copy / relative
    if path.is_dir():
        (path,) = path.rglob("*.parquet")
    data = path.read_bytes()
    errors = 0
    rng = np.random.default_rng(0)
    for place in rng.integers(0, len(data), 25):
        damaged = bytearray(data)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.unlink()  # a new file, as the old one may still be mapped
        path.write_bytes(damaged)
        try:
            buffer = load_buffer(EPISODE, 3, copy, verify=True)
            found = buffer.frames(), buffer.states
        except InterferenceError as error:
            errors += 1
            assert error.hint or isinstance(error, FormatError | InvalidIdError)
            continue
        np.testing.assert_array_equal(found[0], frames)
        np.testing.assert_array_equal(found[1], states)
    assert errors > 0


def test_wrong_pixels_without_any_decoding_error_are_found(copy: Path) -> None:
    """A video that decodes well, but is another episode's."""
    other = copy / MP4.replace("file-001", "file-002")
    shutil.copyfile(other, copy / MP4)
    assert load_buffer(EPISODE, 3, copy).frames().any()
    with pytest.raises(HashMismatchError) as caught:
        load_buffer(EPISODE, 3, copy, verify=True)
    assert caught.value.message.startswith(
        f"{EPISODE} at k=3: lesson {EPISODE} (demonstrations episode 3, frames 0 to 35) does not "
        "have the SHA-256 of the manifest; differing: observation.images.front"
    )


def test_wrong_states_are_found(copy: Path) -> None:
    table = pq.ParquetFile(copy / DATA).read()
    place = table.column_names.index("observation.state")
    states = table["observation.state"].combine_chunks()
    values = states.flatten().to_numpy().copy()
    values[-8 * 20] += 1
    changed = type(states).from_arrays(values, 8)
    pq.write_table(table.set_column(place, table.schema.field(place), changed), copy / DATA)
    with pytest.raises(HashMismatchError, match=r"differing: observation\.state$|state\n"):
        load_buffer(EPISODE, 3, copy, verify=True)
