"""Properties of every source of recordings, opening sources, and the synthetic sample."""

import os
import pickle
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.lerobot_layouts import write_lerobot
from support.messages import raises
from support.recordings import (
    EPISODES,
    SEEDS,
    check_recording,
    make_episode,
    rows_of,
    write_frames,
    write_h5,
    write_images,
    write_table,
)

from robomme_interference_data.build_dataset.sources import SOURCES, Recording, Source, open_source
from robomme_interference_data.build_dataset.sources.base import compose, demonstration_length
from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.errors import (
    InvalidIdError,
    InvalidOptionError,
    MissingFileError,
    SourceError,
    UnknownNameError,
)

TOLD = {"seed": list(SEEDS.values()), "difficulty": ["hard"] * 3}
LAYOUTS: dict[str, Callable[..., Any]] = {
    "frames": write_frames,
    "robomme-h5": write_h5,
    "lerobot": partial(write_lerobot, **TOLD),
    "lerobot v3.0 video": partial(write_lerobot, stored="video", **TOLD),
    "lerobot v2.1": partial(write_lerobot, version="v2.1", **TOLD),
    "lerobot v2.1 video": partial(write_lerobot, version="v2.1", stored="video", **TOLD),
    "lerobot v2.0 video": partial(write_lerobot, version="v2.0", stored="video", **TOLD),
}


@pytest.fixture(params=LAYOUTS)
def source(request: pytest.FixtureRequest, tmp_path: Path) -> Source:
    LAYOUTS[request.param](tmp_path / "made", EPISODES)
    return open_source(f"{request.param.split()[0]}:{tmp_path / 'made'}")


def recorded(folder: Path) -> list[Path]:
    """The files that hold frames."""
    files = [path for path in folder.glob("made/**/*.*") if path.is_file()]
    return [path for path in files if "meta" not in path.parts and path.name != "frames.parquet"]


def test_episodes_and_frames(source: Source) -> None:
    listed = source.episodes()
    assert [str(episode.id) for episode in listed] == list(EPISODES)
    copy, again = pickle.loads(pickle.dumps((source, listed)))  # as a worker process gets them
    for episode in again:
        recording = copy.read(episode, None)
        assert (recording.seed, recording.difficulty) == (SEEDS[str(episode.id)], "hard")
        assert recording.simulator == ("robomme" if source.provenance["kind"][0] == "r" else None)
        assert recording.exact is True
        check_recording(recording, EPISODES[str(episode.id)])
    assert list(source.provenance) == ["kind"]  # no local paths
    assert source.time_limit_s == 1800


def test_only_the_cameras_asked_for_are_read(source: Source) -> None:
    episode = source.episodes()[0]
    frames = list(source.read(episode, ("wrist",)).frames)
    assert [list(frame.images) for frame in frames] == [["wrist"]] * 12
    with raises(InvalidOptionError):
        source.read(episode, ("front", "wirst"))


def test_keys_tell_when_a_file_changes(source: Source, tmp_path: Path) -> None:
    before = [episode.key for episode in source.episodes()]
    assert [episode.key for episode in source.episodes()] == before
    for path in recorded(tmp_path):
        os.utime(path, (4e9, 4e9))
    after = [episode.key for episode in source.episodes()]
    assert all(new != old for new, old in zip(after, before, strict=True))


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="looks for open files in /proc")
def test_stopping_early_releases_the_files(source: Source, tmp_path: Path) -> None:
    frames = source.read(source.episodes()[0], None).frames
    next(frames)
    frames.close()

    def opened() -> list[str]:
        paths = [str(path.resolve()) for path in Path("/proc/self/fd").iterdir()]
        return [path for path in paths if path.startswith(str(tmp_path))]

    for _ in range(100):  # threads of pyarrow that read ahead end a little later
        if not opened():
            break
        time.sleep(0.1)
    assert opened() == []


def test_files_that_are_gone_since_they_were_listed(source: Source, tmp_path: Path) -> None:
    episode = source.episodes()[0]
    for path in recorded(tmp_path):
        path.unlink()
    with raises((SourceError, MissingFileError)):
        list(source.read(episode, None).frames)


@pytest.mark.parametrize("layout", ["frames", "lerobot", "lerobot v2.1"])
def test_actions_marks_and_a_camera_may_be_missing(tmp_path: Path, layout: str) -> None:
    root, bare = tmp_path / "made", make_episode(5, 4, cameras=("front",), actions=False)
    if layout == "frames":
        write_table(root, rows_of("MoveCube/train/0", bare))
        write_images(root / "images/front/MoveCube/train/0", bare.images["front"])
    else:
        version = "v2.1" if "v2.1" in layout else "v3.0"
        write_lerobot(root, {"MoveCube/train/0": bare}, version=version, marked=False)
    source = open_source(f"{layout.split(maxsplit=1)[0]}:{root}")
    check_recording(source.read(source.episodes()[0], None), bare, marked=False)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("frames", "frames:FOLDER"),
        ("robome-h5:recordings", "'robomme-h5'"),
        ("tabletop:fast", "tabletop"),
        ("no_such_module:Lamp", "PYTHONPATH"),
        ("support.nowhere:Lamp", "PYTHONPATH"),
        ("frame:recordings", "frames:FOLDER"),
        ("frame:recordings", "Did you mean 'frames'?"),
    ],
)
def test_unknown_source(text: str, expected: str) -> None:
    with pytest.raises((InvalidOptionError, UnknownNameError)) as caught:
        open_source(text)
    assert repr(text) in caught.value.message and expected in str(caught.value)


def test_a_folder_without_the_kind_of_its_content(source: Source, tmp_path: Path) -> None:
    text = str(tmp_path / "made")
    with pytest.raises(InvalidOptionError) as caught:
        open_source(text)
    assert caught.value.hint == f"Write {source.provenance['kind']}:{text}"


def test_a_folder_of_another_kind_of_source(source: Source, tmp_path: Path) -> None:
    kind, folder = source.provenance["kind"], tmp_path / "made"
    other = "lerobot" if kind == "frames" else "frames"
    with pytest.raises(InvalidOptionError) as caught:
        open_source(f"{other}:{folder}")
    assert caught.value.hint == f"Write {kind}:{folder}"


def test_folders_that_hold_no_recordings(tmp_path: Path) -> None:
    with raises(MissingFileError):
        open_source(f"frames:{tmp_path / 'nowhere'}")
    (tmp_path / "episode_0.hdf5").write_text("of another kind")
    with raises(InvalidOptionError):
        open_source(str(tmp_path))
    with raises(SourceError) as caught:
        open_source(f"robomme-h5:{tmp_path}")
    assert "your-own-recordings" in (caught.value.hint or "")


def test_the_docs_know_all_kinds() -> None:
    table = (Path(__file__).parents[2] / "docs" / "reference" / "sources.md").read_text()
    for kind in SOURCES.kinds.values():
        assert "| `" + kind.form.replace(" or ", "` or `") in table


@given(st.integers(0, 30), st.integers(0, 30))
def test_a_demonstration_comes_first_and_in_one_piece(lesson: int, rest: int) -> None:
    flags = [True] * lesson + [False] * rest
    assert demonstration_length(flags, "it") == lesson
    if rest:
        with pytest.raises(SourceError, match=f"it is true in {lesson + 1} frames, not all"):
            demonstration_length([*flags, True], "it")


@pytest.mark.parametrize(
    "values", [{"goals": ()}, {"goals": ("do it", " ")}, {"difficulty": "esy"}]
)
def test_recordings_check_themselves(values: dict[str, Any]) -> None:
    known = {"goals": ("do it",), "seed": None, "difficulty": None, "simulator": None}
    frames = compose({}, np.zeros((0, 1), np.float32), None, None)
    with raises(SourceError):
        Recording(**(known | values), exact=True, frames=frames)


def test_families_of_the_sample() -> None:
    assert {one.id.family for one in open_source("sample").episodes()} == set(FAMILIES)
    one, other = (open_source(f"sample:{names}").episodes() for names in ("A,B", "B,A"))
    assert [episode.id for episode in one] == [episode.id for episode in other]
    # Another order makes other episodes, so the key tells it.
    assert all(a.key != b.key for a, b in zip(one, other, strict=True))
    with pytest.raises(InvalidIdError):
        open_source("sample:9lives").episodes()
