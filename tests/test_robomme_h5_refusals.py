"""RoboMME's recordings with something missing or wrong."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from h5_recordings import edit, listed, record

from robomme_interference_data.build_dataset.sources import open_source
from robomme_interference_data.build_dataset.sources.robomme_h5 import RoboMMEH5Source
from robomme_interference_data.errors import (
    InvalidIdError,
    InvalidOptionError,
    MissingExtraError,
    SourceError,
)


def refused(folder: Path) -> str:
    with pytest.raises(SourceError) as raised:
        listed(folder)
    return str(raised.value)


@pytest.mark.parametrize(
    "missing",
    [
        "setup",
        "setup/task_goal",
        "timestep_0/obs",
        "timestep_7/info",
        "timestep_7/info/is_video_demo",
    ],
)
def test_a_missing_piece(tmp_path: Path, missing: str) -> None:
    def change(group: h5py.Group) -> None:
        del group[missing]

    path = record(tmp_path)
    edit(path, change)
    message = refused(tmp_path)
    assert message.startswith(f"{path}: episode_0 is not a complete RoboMME recording: ")
    assert "Record or download the file again" in message


@pytest.mark.parametrize("step", [5, 11])
@pytest.mark.parametrize(
    "missing",
    [
        "obs/front_rgb",
        "obs/wrist_rgb",
        "obs/joint_state",
        "obs/gripper_state",
        "action/joint_action",
    ],
)
def test_a_piece_that_is_missing_only_when_it_is_read(
    tmp_path: Path, missing: str, step: int
) -> None:
    path = record(tmp_path)

    def change(group: h5py.Group) -> None:
        del group[f"timestep_{step}/{missing}"]

    edit(path, change)
    source = open_source(f"robomme-h5:{tmp_path}")
    frames = source.read(source.episodes()[0])
    for _ in range(step):
        next(frames)
    with pytest.raises(
        SourceError, match=rf"MoveCube.h5: episode_0/timestep_{step} cannot be read"
    ):
        next(frames)


@pytest.mark.parametrize("step", [0, 4, 10])
def test_a_gap(tmp_path: Path, step: int) -> None:
    def change(group: h5py.Group) -> None:
        del group[f"timestep_{step}"]

    edit(record(tmp_path), change)
    if step == 0:  # then it begins at 1, as some files do
        assert listed(tmp_path)[0].raw_length == 11
    else:
        assert "episode_0 does not hold consecutive timestep_<T> groups" in refused(tmp_path)


def test_no_steps(tmp_path: Path) -> None:
    edit(record(tmp_path, steps=1), lambda group: group.pop("timestep_0"))
    assert "does not hold consecutive timestep_<T> groups" in refused(tmp_path)


@pytest.mark.parametrize("again", [5, 8, 11])
def test_demonstration_frames_that_come_back(tmp_path: Path, again: int) -> None:
    def change(group: h5py.Group) -> None:
        group["timestep_4/info/is_video_demo"][()] = False
        group[f"timestep_{again}/info/is_video_demo"][()] = True

    edit(record(tmp_path), change)
    message = refused(tmp_path)
    assert "demonstration frames come after live ones" in message
    assert f"set again at timestep_{again})" in message


def test_no_camera(tmp_path: Path) -> None:
    def change(group: h5py.Group) -> None:
        for camera in ("front", "wrist"):
            del group[f"timestep_0/obs/{camera}_rgb"]

    edit(record(tmp_path), change)
    assert "episode_0 has no front_rgb or wrist_rgb" in refused(tmp_path)


def test_no_goal(tmp_path: Path) -> None:
    def change(group: h5py.Group) -> None:
        del group["setup/task_goal"]
        group["setup"].create_dataset("task_goal", shape=(0,), dtype=h5py.string_dtype())

    edit(record(tmp_path), change)
    assert "episode_0 has no task_goal" in refused(tmp_path)


def test_a_goal_that_is_not_text(tmp_path: Path) -> None:
    def change(group: h5py.Group) -> None:
        del group["setup/task_goal"]
        group["setup/task_goal"] = np.bytes_(b"\xff\xfe")

    edit(record(tmp_path), change)
    assert "episode_0 is not a complete RoboMME recording: " in refused(tmp_path)


def test_no_episodes(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "record_dataset_MoveCube.h5", "w") as file:
        file["note"] = "empty"
    assert "record_dataset_MoveCube.h5 holds no episode_<N> group" in refused(tmp_path)


@pytest.mark.parametrize("keep", [0, 100, 0.5, 0.99])
def test_a_truncated_file(tmp_path: Path, keep: float) -> None:
    path = record(tmp_path)
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data)) if keep < 1 else int(keep)])
    assert refused(tmp_path).startswith(f"{path} is not a complete RoboMME recording: ")


@pytest.mark.parametrize("harm", ["truncated", "removed", "episode removed"])
def test_a_file_that_changes_after_it_was_listed(tmp_path: Path, harm: str) -> None:
    path = record(tmp_path)
    source = open_source(f"robomme-h5:{tmp_path}")
    (episode,) = source.episodes()
    if harm == "truncated":
        path.write_bytes(path.read_bytes()[:2000])
    elif harm == "removed":
        path.unlink()
    else:
        with h5py.File(path, "r+") as file:
            del file["episode_0"]
    with pytest.raises(SourceError, match=r"MoveCube.h5: episode_0\S* cannot be read"):
        next(source.read(episode))


def test_a_folder_without_recordings(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"holds no record_dataset_<Family>\.h5 file") as raised:
        open_source(f"robomme-h5:{tmp_path}")
    assert "--source robomme-h5:FOLDER" in str(raised.value)
    with pytest.raises(InvalidOptionError, match="does not exist"):
        open_source(f"robomme-h5:{tmp_path / 'missing'}")


def test_a_family_that_is_no_name(tmp_path: Path) -> None:
    record(tmp_path, "Move Cube")
    with pytest.raises(InvalidIdError, match="'Move Cube' is not a family name"):
        listed(tmp_path)


def test_without_h5py(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record(tmp_path)
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    with pytest.raises(MissingExtraError, match="needs h5py") as raised:
        RoboMMEH5Source(tmp_path)
    assert 'pip install "robomme-interference-data[build]"' in str(raised.value)
