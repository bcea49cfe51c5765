"""Records check themselves, and carry every kind of session that the format allows."""

import json
from dataclasses import FrozenInstanceError, replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data.errors import FormatError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.manifest_io import QUERY_TYPE, SCHEMA, SESSION_TYPE
from robomme_interference_data.schema import ROLES, BufferManifest, QueryFrame, SessionEntry

LESSON = SessionEntry(
    role="lesson",
    family="MoveCube",
    source=EpisodeId("MoveCube", "test", 3),
    dataset="demonstrations",
    revision="d" * 64,
    episode_index=12,
    start=0,
    stop=20,
    repeat=1,
    sha256="a" * 64,
)
UNIT = replace(
    LESSON,
    role="distractor",
    family="InsertPeg",
    source=EpisodeId("InsertPeg", "train", 7),
    dataset="distractors",
    stop=32,
)


def manifest(sessions: tuple[SessionEntry, ...], **changes: Any) -> BufferManifest:
    values: dict[str, Any] = {
        "episode_id": EpisodeId("MoveCube", "test", 3),
        "k": sum(session.role != "lesson" for session in sessions),
        "goals": ("move the cube", "shift the cube"),
        "seed": 630300,
        "difficulty": "hard",
        "simulator": "robomme",
        "exact": True,
        "lesson_frames": 20,
        "history_frames": sum(session.num_frames for session in sessions),
        "lesson_share": 0.375,
        "query": QueryFrame("demonstrations", "d" * 64, 12, 20),
        "sessions": sessions,
    }
    return BufferManifest(**{**values, **changes})


@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize("dataset", ["demonstrations", "distractors"])
def test_every_role_may_come_from_either_dataset(role: str, dataset: str) -> None:
    assert replace(LESSON, role=role, dataset=dataset).role == role


@given(st.integers(0, 1000), st.integers(1, 1000), st.integers(1, 100))
def test_num_frames(start: int, length: int, repeat: int) -> None:
    entry = replace(LESSON, start=start, stop=start + length, repeat=repeat)
    assert entry.num_frames == length * repeat


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"role": "distracter"}, "'distracter' is none of lesson, distractor, filler"),
        ({"role": ""}, "'' is none of"),
        ({"dataset": "demos"}, "'demos' is none of demonstrations, distractors"),
        ({"start": -1}, r"\[-1, 20\) × 1 of MoveCube/test/3 is empty or negative"),
        ({"start": 20}, r"\[20, 20\) × 1"),
        ({"start": 21}, r"\[21, 20\) × 1"),
        ({"repeat": 0}, r"\[0, 20\) × 0"),
        ({"repeat": -2}, r"\[0, 20\) × -2"),
    ],
)
def test_wrong_sessions(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(FormatError, match=message):
        replace(LESSON, **changes)


def test_records_are_frozen() -> None:
    with pytest.raises(FrozenInstanceError):
        LESSON.start = 1  # type: ignore[misc]
    with pytest.raises(FrozenInstanceError):
        manifest((LESSON,)).k = 1  # type: ignore[misc]


def test_manifest_properties() -> None:
    one = manifest((LESSON, UNIT, UNIT))
    assert one.condition == "k2"
    assert one.family == "MoveCube"
    assert one.goal == "move the cube"
    assert one.history_frames == 84


@pytest.mark.parametrize(
    "sessions",
    [
        (),  # no lesson, nothing else: an empty history
        (UNIT,),  # the lesson is absent
        (UNIT, LESSON),  # it is not first
        (replace(LESSON, stop=8), UNIT, replace(LESSON, start=8)),  # it comes in two parts
        (LESSON, replace(UNIT, role="filler", start=5, stop=6, repeat=32)),  # a held frame
        (LESSON, replace(UNIT, role="contradiction")),
        (LESSON, *([UNIT] * 63)),
    ],
)
def test_later_splits_need_no_new_format(sessions: tuple[SessionEntry, ...]) -> None:
    one = manifest(sessions)
    assert one.sessions == sessions
    assert one.history_frames == sum(session.num_frames for session in sessions)


@pytest.mark.parametrize("history_frames", [0, 51, 53])
def test_history_frames_must_fit_the_sessions(history_frames: int) -> None:
    with pytest.raises(FormatError, match=f"hold 52 frames, history_frames says {history_frames}"):
        manifest((LESSON, UNIT), history_frames=history_frames)


def test_as_dict_has_the_columns_of_the_table() -> None:
    value = manifest((LESSON, UNIT)).as_dict()
    assert value.keys() == set(SCHEMA.names)
    assert value["query"].keys() == {field.name for field in QUERY_TYPE}
    assert all(
        session.keys() == {field.name for field in SESSION_TYPE} for session in value["sessions"]
    )
    assert value["episode_id"] == "MoveCube/test/3"
    assert (value["family"], value["split"], value["index"]) == ("MoveCube", "test", 3)
    assert value["condition"] == "k1"
    assert value["sessions"][1]["source"] == "InsertPeg/train/7"
    assert json.loads(json.dumps(value)) == value  # plain values only
