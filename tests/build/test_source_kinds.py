"""What every source of recordings does, whatever the layout: one table of kinds."""

import os
import pickle
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from support.lerobot_layouts import write_lerobot
from support.recordings import EPISODES, SEEDS, check_recording, write_frames, write_h5

from robomme_interference_data.build_dataset.sources import Source, open_source
from robomme_interference_data.errors import InvalidOptionError, MissingFileError, SourceError

TOLD = {"seed": list(SEEDS.values()), "difficulty": ["hard"] * 3}
LAYOUTS: dict[str, Callable[..., Any]] = {
    "frames": write_frames,
    "robomme-h5": write_h5,
    "lerobot": partial(write_lerobot, **TOLD),
    "lerobot v3.0 video": partial(write_lerobot, stored="video", **TOLD),
    "lerobot v2.1": partial(write_lerobot, version="v2.1", **TOLD),
    "lerobot v2.1 video": partial(write_lerobot, version="v2.1", stored="video", **TOLD),
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
    assert (source.time_limit, source.whole) == (1800, True)


def test_only_the_cameras_asked_for_are_read(source: Source) -> None:
    episode = source.episodes()[0]
    frames = list(source.read(episode, ("wrist",)).frames)
    assert [list(frame.images) for frame in frames] == [["wrist"]] * 12
    with pytest.raises(InvalidOptionError, match="'wirst' is none of front, wrist.*\n.*'wrist'"):
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
    opened = {str(path.resolve()) for path in Path("/proc/self/fd").iterdir()}
    assert not [path for path in opened if path.startswith(str(tmp_path))]


def test_files_that_are_gone_since_they_were_listed(source: Source, tmp_path: Path) -> None:
    episode = source.episodes()[0]
    for path in recorded(tmp_path):
        path.unlink()
    with pytest.raises((SourceError, MissingFileError), match=r"made|changed"):
        list(source.read(episode, None).frames)
