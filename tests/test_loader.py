"""Splits: list, filter and load."""

import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import factories
import numpy as np
import pytest

from robomme_interference_data import DecodedCache, EpisodeId, load_buffer, load_split
from robomme_interference_data.cache import default_cache_folder
from robomme_interference_data.errors import (
    InvalidIdError,
    InvalidOptionError,
    MissingFileError,
    UnknownNameError,
)

EPISODE = "VideoUnmask/test/1"


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
