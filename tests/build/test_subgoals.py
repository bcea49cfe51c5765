"""Subtasks of LeRobot datasets as evidence, and recordings of which a part is used."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.lerobot_layouts import DATA, edit_columns, edit_info, write_lerobot
from support.messages import raises
from support.recordings import MOVE, make_episode

from robomme_interference_data.build_dataset.sources import Recording, open_source
from robomme_interference_data.build_dataset.sources.lerobot.trim import Trim
from robomme_interference_data.errors import FormatError, SourceError
from robomme_interference_data.schema.records import EvidenceSpan

NAME = "MoveCube/train/0"
EPISODE = make_episode(1, 6, MOVE, 4)
REACH_PUT = (EvidenceSpan(0, "reach", 0, 2), EvidenceSpan(1, "put", 2, 4))


def read(root: Path, **options: Any) -> Recording:
    source = open_source(f"lerobot:{root}", **options)
    return source.read(source.episodes()[0], None)


def annotated(root: Path, column: str, dtype: str, values: Any) -> Path:
    """Write a dataset with a further column of an episode of 6 frames, 4 of a demonstration."""
    write_lerobot(root, {NAME: EPISODE})
    edit_columns(root / DATA, **{column: values})
    declared = {column: {"dtype": dtype, "shape": [1]}}
    edit_info(root, lambda info: info["features"].update(declared))
    return root


def test_a_column_of_texts(tmp_path: Path) -> None:
    root = annotated(tmp_path, "phase", "string", ["reach", "reach", "put", "put", "put", ""])
    assert read(root).evidence is None  # nobody named the column
    assert read(root, columns={"subgoal": "phase"}).evidence == REACH_PUT


@pytest.mark.parametrize("name", ["subtask", "__index_level_0__"])
@pytest.mark.parametrize("numbered", [True, False])
def test_numbers_of_subtasks(tmp_path: Path, name: str, numbered: bool) -> None:
    root = annotated(tmp_path, "subtask_index", "int64", [1, 1, 0, 0, -1, -1])
    table = {name: ["put", "reach"]} | ({"subtask_index": [0, 1]} if numbered else {})
    with raises(SourceError):  # the table is missing
        read(root, columns={"subgoal": "subtask_index"})
    pq.write_table(pa.table(table), root / "meta/subtasks.parquet")
    assert read(root, columns={"subgoal": "subtask_index"}).evidence == REACH_PUT


@pytest.mark.parametrize(
    "table", [{"subtask": ["put"]}, {"subtask_index": [0, 1]}, {"a": ["x", "y"], "b": ["u", "v"]}]
)
def test_subtasks_that_are_wrong(tmp_path: Path, table: dict[str, Any]) -> None:
    root = annotated(tmp_path, "subtask_index", "int64", [1, 1, 0, 0, -1, -1])
    pq.write_table(pa.table(table), root / "meta/subtasks.parquet")
    with raises(FormatError):
        read(root, columns={"subgoal": "subtask_index"})


def persistent(*rows: tuple[str | None, float, str]) -> pa.Array:
    """LeRobot's column: each of the 6 frames has all annotations of the episode.

    Each is given as content, time and style.
    """
    every = list(rows) * 6
    fields = {
        "role": pa.array(["assistant"] * len(every)),
        "content": pa.array([content for content, _, _ in every], pa.string()),
        "style": pa.array([style for _, _, style in every], pa.string()),
        "timestamp": pa.array([time for _, time, _ in every], pa.float32()),
        "camera": pa.nulls(len(every), pa.string()),
        "tool_calls": pa.nulls(len(every), pa.list_(pa.json_())),
    }
    values = pa.StructArray.from_arrays([*fields.values()], [*fields])
    return pa.ListArray.from_arrays(np.arange(7) * len(rows), values)


def test_annotations_of_lerobot(tmp_path: Path) -> None:
    """At 10 frames a second, 0.2 s is frame 2; frame 4 is the first at 0.31 s or later."""
    rows = [("put", 0.2, "subtask"), ("plan", 0.0, "plan"), ("reach", 0.0, "subtask")]
    values = persistent(*rows, ("gone", 0.31, "subtask"))
    root = annotated(tmp_path, "language_persistent", "language", values)
    assert read(root).evidence is None
    assert read(root, columns={"subgoal": "language_persistent"}).evidence == REACH_PUT
    twice = persistent(("x", 0.2, "subtask"), ("y", 0.2, "subtask"))
    for wrong in (twice, pa.array([[{"content": "x"}]] * 6)):
        edit_columns(root / DATA, language_persistent=None)
        edit_columns(root / DATA, language_persistent=wrong)
        with raises(SourceError):
            read(root, columns={"subgoal": "language_persistent"})
    edit_columns(root / DATA, language_persistent=None)
    edit_columns(root / DATA, language_persistent=persistent())
    assert read(root, columns={"subgoal": "language_persistent"}).evidence is None


# --- a part of a recording ------------------------------------------------------------------------

HEADER = "episode_index,family,exec_start_idx,start,stop\n"


@pytest.mark.parametrize("version", ["v3.0", "v2.0"])
@pytest.mark.parametrize("stored", ["png", "video"])
def test_a_part_of_a_recording(tmp_path: Path, version: str, stored: str) -> None:
    """Of 6 frames, 2 to 4 are used; frame 2 alone is of the demonstration, which ends before 3."""
    root = write_lerobot(
        *(tmp_path / "set", {NAME: EPISODE}),
        version=version,
        stored=stored,
        marked=False,
        episode_id=None,
    )
    edit_info(root, fps=10)
    names = tmp_path / "names.csv"
    names.write_text(f"{HEADER}0,MoveCube,3,2,5\n")
    frames = list(read(root, families_from=str(names)).frames)
    assert [frame.is_demonstration for frame in frames] == [True, False, False]
    for frame, number in zip(frames, (2, 3, 4), strict=True):
        np.testing.assert_array_equal(frame.state, EPISODE.state[number])
        np.testing.assert_array_equal(frame.action, EPISODE.action[number])
        for camera, image in frame.images.items():
            np.testing.assert_array_equal(image, EPISODE.images[camera][number])
    names.write_text(f"{HEADER}0,MoveCube,0,,\n")
    assert len(list(read(root, families_from=str(names)).frames)) == 6


def test_a_part_of_a_marked_recording(tmp_path: Path) -> None:
    root = annotated(tmp_path / "set", "phase", "string", ["a", "reach", "put", "put", "x", "x"])
    names = tmp_path / "names.csv"
    names.write_text("episode_index,family,start\n0,MoveCube,1\n")
    recording = read(root, families_from=str(names), columns={"subgoal": "phase"})
    marks = [frame.is_demonstration for frame in recording.frames]
    assert marks == [True, True, True, False, False]
    assert recording.evidence == (EvidenceSpan(0, "reach", 0, 1), EvidenceSpan(1, "put", 1, 3))


@pytest.mark.parametrize("line", ["0,5,5", "0,4,3", "0,0,7", "2,3,6", "6,1,5"])
def test_parts_that_are_not_in_the_recording(tmp_path: Path, line: str) -> None:
    root = write_lerobot(tmp_path / "set", {NAME: EPISODE}, marked=False)
    live, start, stop = line.split(",")
    names = tmp_path / "names.csv"
    names.write_text(f"{HEADER}0,MoveCube,{live},{start},{stop}\n")
    [episode] = open_source(f"lerobot:{root}", families_from=str(names)).episodes()
    with raises(SourceError):
        episode.check()


@given(st.data())
def test_lessons_of_parts(data: st.DataObject) -> None:
    """A frame is of the demonstration in the part if it is in the recording."""
    length = data.draw(st.integers(1, 30))
    start = data.draw(st.integers(0, length - 1))
    stop = data.draw(st.integers(start + 1, length))
    lesson = data.draw(st.integers(0, length))
    trim = Trim.of({"start": start, "stop": stop}, length)
    assert trim.lesson(lesson) == sum(frame < lesson for frame in range(start, stop))
    assert trim.lesson(None) is None


def test_evidence_of_parts() -> None:
    trim = Trim(2, 8)
    assert trim.evidence([EvidenceSpan(0, "x", 2, 5)]) == (EvidenceSpan(0, "x", 0, 3),)
    with raises(SourceError):
        trim.evidence([EvidenceSpan(0, "x", 1, 5)])


def test_states_of_several_columns(tmp_path: Path) -> None:
    """LeRobot stores a column of one value as plain numbers."""
    root = write_lerobot(tmp_path, {NAME: EPISODE})
    grip = np.arange(6, dtype=np.float64) / 4
    edit_columns(root / DATA, gripper=pa.array(grip), turns=pa.array([[3, -2]] * 6))
    declared = {
        "gripper": {"dtype": "float64", "shape": [1], "names": ["opening"]},
        "turns": {"dtype": "int64", "shape": [2], "names": ["left", "right"]},
    }
    edit_info(root, lambda info: info["features"].update(declared))
    recording = read(root, columns={"state": "gripper+turns", "action": "gripper"})
    assert recording.robot.names == {
        "observation.state": ("opening", "left", "right"),
        "action": ("opening",),
    }
    frames = list(recording.frames)
    assert [frame.state.tolist() for frame in frames] == [[value, 3, -2] for value in grip]
    assert frames[5].action is not None and frames[5].action.tolist() == [1.25]
    assert frames[0].state.dtype == np.float32
