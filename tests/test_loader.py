"""Splits: list, filter and load; and every kind of damage gives the one right error."""

import json
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import factories
import numpy as np
import pyarrow.parquet as pq
import pytest

from robomme_interference_data import DecodedCache, EpisodeId, load_buffer, load_split
from robomme_interference_data.cache import default_cache_folder
from robomme_interference_data.errors import (
    FormatError,
    HashMismatchError,
    InterferenceError,
    InvalidIdError,
    InvalidOptionError,
    MissingFileError,
    TruncatedVideoError,
    UnknownNameError,
)

EPISODE = "VideoUnmask/test/1"


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    return factories.copy_of_split(tmp_path / "split")


# --- list, filter, load ------------------------------------------------------------------------


def test_what_a_split_lists() -> None:
    split = load_split(factories.split())
    assert list(map(str, split.episode_ids)) == [
        f"{family}/test/{index}" for family in factories.FAMILIES for index in (0, 1)
    ]
    assert split.families == ("VideoRepick", "VideoUnmask", "MoveCube", "PatternLock")
    assert split.k_values == (0, 1, 3)
    assert len(split) == 24
    manifests = list(split.manifests())
    assert [(str(m.episode_id), m.k) for m in manifests] == [
        (str(episode), k) for episode in split.episode_ids for k in (0, 1, 3)
    ]


@pytest.mark.parametrize(
    ("filters", "count"),
    [
        ({}, 24),
        ({"family": "MoveCube"}, 6),
        ({"k": 3}, 8),
        ({"k": 0}, 8),
        ({"difficulty": "easy"}, 12),  # the sample's index 0
        ({"family": "MoveCube", "k": 1, "difficulty": "medium"}, 1),
    ],
)
def test_filters(filters: dict[str, Any], count: int) -> None:
    split = load_split(factories.split())
    found = list(split.manifests(**filters))
    assert len(found) == count
    for manifest in found:
        assert all(getattr(manifest, name) == value for name, value in filters.items())
    assert [buffer.manifest for buffer in split.buffers(**filters)] == found


@pytest.mark.parametrize(
    ("filters", "message", "hint"),
    [
        ({"family": "MoveCub"}, "family 'MoveCub' is not in", "Did you mean 'MoveCube'?"),
        ({"k": 7}, "k 7 is not in", "Known: 0, 1, 3"),
        ({"difficulty": "esay"}, "difficulty 'esay' is not in", "Did you mean 'easy'?"),
        ({"difficulty": "hard"}, "difficulty 'hard' is not in", "Known: easy, medium"),
    ],
)
def test_filters_for_what_is_not_there(filters: dict[str, Any], message: str, hint: str) -> None:
    with pytest.raises(UnknownNameError, match=message) as caught:
        load_split(factories.split()).manifests(**filters)
    assert caught.value.hint == hint


def test_ways_to_name_a_buffer() -> None:
    root = factories.split()
    split = load_split(root)
    expected = split.manifest(EPISODE, 3)
    for buffer in (
        load_buffer(EPISODE, 3, root),
        load_buffer(EPISODE, k=3, split=str(root)),
        load_buffer(EpisodeId("VideoUnmask", "test", 1), 3, split),
        load_buffer(EPISODE, np.int64(3), split),  # type: ignore[arg-type]
        split.load(EPISODE, 3, verify=True),
    ):
        assert buffer.manifest == expected
        assert len(buffer) == 36 + 3 * 32
    assert expected.goal == "watch the video carefully, then do the VideoUnmask task again"
    assert expected.difficulty == "medium"
    assert expected.simulator == "sample"


def test_the_share_of_the_lesson_is_recorded() -> None:
    split = load_split(factories.split())
    # ⌊j·132/31⌋ < 36 for j ≤ 8 (34.06 → 34; 38.3): 9 of 32. At k=0: all but the last of 32.
    assert split.manifest(EPISODE, 3).lesson_share == 9 / 32
    assert split.manifest(EPISODE, 0).lesson_share == 31 / 32
    # 20 lesson frames and the live observation: fewer than 32, so all are taken.
    assert split.manifest("VideoUnmask/test/0", 0).lesson_share == 20 / 21


def test_verify_of_every_buffer() -> None:
    split = load_split(factories.split())
    for manifest in split.manifests(k=3):
        split.load(manifest.episode_id, 3, verify=True)


@pytest.mark.parametrize(
    ("episode", "k", "message", "hint"),
    [
        ("VideoUnmask/test/7", 3, "VideoUnmask/test/7 is not in", "'VideoUnmask/test/1'"),
        ("VideoUnmask/train/0", 3, "VideoUnmask/train/0 is not in", "'VideoUnmask/test/0'"),
        ("VideoUnmsk/test/0", 3, "family 'VideoUnmsk' is not in", "Did you mean 'VideoUnmask'?"),
        ("videounmask/test/0", 3, "family 'videounmask' is", "Did you mean 'VideoUnmask'?"),
        ("InsertPeg/test/0", 3, "family 'InsertPeg' is not in", "Known: MoveCube, PatternLock"),
        (EPISODE, 7, "k=7 is not in", "Planned there: 0, 1, 3. For another k, run "),
        (EPISODE, -1, "k=-1 is not in", "Planned there: 0, 1, 3"),
        (EPISODE, 2**40, "is not in", "Planned there: 0, 1, 3"),
        (EPISODE, "3", "k='3' is not in", "Planned there: 0, 1, 3"),
        (EPISODE, None, "k=None is not in", "Planned there: 0, 1, 3"),
    ],
)
def test_unknown_buffers(episode: str, k: Any, message: str, hint: str) -> None:
    with pytest.raises(UnknownNameError, match=message) as caught:
        load_buffer(episode, k, factories.split())
    assert hint in str(caught.value.hint)


@pytest.mark.parametrize("episode", ["VideoUnmask", "VideoUnmask/test/01", "VideoUnmask/tests/1"])
def test_not_an_episode_id(episode: str) -> None:
    with pytest.raises(InvalidIdError):
        load_buffer(episode, 3, factories.split())


def test_not_a_split(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "nowhere", factories.split() / "demonstrations"):
        with pytest.raises(
            MissingFileError, match=r"is not a split: manifests/manifest\.json"
        ) as c:
            load_split(folder)
        assert "robomme-interference build all --source KIND:PATH" in str(c.value.hint)


def test_options_of_the_split_reach_its_buffers(tmp_path: Path) -> None:
    cache = DecodedCache(tmp_path)
    split = load_split(factories.split(), cache=cache, threads=1)
    load_buffer(EPISODE, 3, split).frames()
    assert len(list(tmp_path.iterdir())) == 4
    next(split.buffers(family="MoveCube", k=0)).frames()
    assert len(list(tmp_path.iterdir())) == 5
    with pytest.raises(InvalidOptionError, match="threads=0"):
        load_buffer(EPISODE, 3, factories.split(), threads=0)


def test_the_default_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    frames = load_buffer(EPISODE, 1, factories.split(), cache=True).frames()
    files = list(default_cache_folder().iterdir())
    assert default_cache_folder().is_relative_to(tmp_path)
    assert len(files) == 2
    again = load_buffer(EPISODE, 1, factories.split(), cache=True).frames()
    np.testing.assert_array_equal(again, frames)


def test_splits_and_buffers_can_be_sent_to_other_processes() -> None:
    split = load_split(factories.split())
    buffer = split.load(EPISODE, 3)
    frames, states = buffer.frames(), buffer.states
    assert pickle.loads(pickle.dumps(split)).manifest(EPISODE, 3) == buffer.manifest
    copy = pickle.loads(pickle.dumps(buffer))
    np.testing.assert_array_equal(copy.frames(), frames)
    np.testing.assert_array_equal(copy.states, states)


@pytest.mark.parametrize("name", ["k=3", "episode_index=4", "family=other", "a b", "ü"])
def test_the_name_of_the_folder_says_nothing(name: str, tmp_path: Path) -> None:
    """Parquet readers take folders named COLUMN=VALUE for columns."""
    root = factories.copy_of_split(tmp_path / name / "split")
    buffer = load_buffer(EPISODE, 1, root, verify=True)
    assert (buffer.k, buffer.manifest.family) == (1, "VideoUnmask")
    assert buffer.states.shape == (68, 8)


def test_loading_imports_no_heavy_library() -> None:
    """Pandas is not named here: pyarrow imports it where it is installed."""
    code = (
        "import sys\n"
        "from robomme_interference_data import load_buffer, load_split\n"
        f"buffer = load_buffer({EPISODE!r}, 3, {str(factories.split())!r}, verify=True)\n"
        "buffer.frames(), buffer.query_frame(), buffer.states, list(buffer.stream(50))\n"
        "list(load_split(sys.argv[1]).manifests(k=1))\n"
        "heavy = {'torch', 'lerobot', 'datasets', 'h5py', 'transformers', 'typer',\n"
        "    'matplotlib', 'sapien', 'mani_skill', 'huggingface_hub', 'pyarrow.dataset'}\n"
        "print(sorted(heavy & sys.modules.keys()))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(factories.split())],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.stdout == "[]\n", done.stderr


# --- damage ----------------------------------------------------------------------------------

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
