"""The goals of LeRobot episodes: the tasks of their frames, and a choice if these are several."""

import unicodedata
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.lerobot_layouts import DATA, TABLE, edit_columns, write_lerobot
from support.messages import raises
from support.recordings import Episode, make_episode

from robomme_interference_data.build_dataset.sources import open_source
from robomme_interference_data.build_dataset.sources.lerobot.goals import (
    SEVERAL_TASKS,
    goal_wordings,
)
from robomme_interference_data.errors import InvalidOptionError, MissingFileError, SourceError

OPEN, CLOSE = "Öffne die Schublade", "then close it"
FOUR = make_episode(1, 4, OPEN, 2)
EPISODES = {"Drawer/test/0": FOUR, "Drawer/test/1": replace(FOUR, goal=CLOSE)}
TASKS = "meta/tasks.parquet"


def goals(root: Path, **options: Any) -> list[tuple[str, ...]]:
    """The goals of all episodes."""
    source = open_source(f"lerobot:{root}", **options)
    return [source.read(episode, None).goals for episode in source.episodes()]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_lerobot(tmp_path / "dataset", EPISODES)


def edit_tasks(root: Path, **columns: Any) -> None:
    pq.write_table(pa.table(columns), root / TASKS)


def test_goals_are_wordings_of_the_task(root: Path) -> None:
    wordings = [[OPEN, "open it"], [CLOSE, "shut it"]]
    edit_columns(root / TABLE, goals=wordings)
    assert goals(root) == [(OPEN, "open it"), (CLOSE, "shut it")]


def test_goals_of_an_earlier_task_are_not_used(root: Path) -> None:
    """LeRobot's `modify_tasks` changes tasks, frames and `tasks`, not columns that it ignores."""
    edit_columns(root / TABLE, goals=[["old words"], [CLOSE, "shut it"]])
    assert goals(root) == [(OPEN,), (CLOSE, "shut it")]


@pytest.mark.parametrize("tasks", [None, [[], []], [None, None], [float("nan")] * 2])
def test_tasks_of_the_frames_where_episodes_list_none(root: Path, tasks: Any) -> None:
    edit_columns(root / TABLE, tasks=None)
    if tasks is not None:
        edit_columns(root / TABLE, tasks=tasks)
    assert goals(root) == [(OPEN,), (CLOSE,)]


def test_frames_that_are_not_here_have_no_tasks_yet(root: Path) -> None:
    edit_columns(root / TABLE, tasks=None)
    (root / DATA).unlink()
    source = open_source(f"lerobot:{root}")
    listed = source.episodes()
    assert len(listed) == 2
    with raises(MissingFileError):
        source.read(listed[0], None)


def test_listed_tasks_and_wordings_where_frames_have_none(root: Path) -> None:
    edit_columns(root / DATA, task_index=None)
    assert goals(root) == [(OPEN,), (CLOSE,)]
    edit_columns(root / TABLE, tasks=None, goals=[["words"], ["others", "more"]])
    assert goals(root) == [("words",), ("others", "more")]


def test_the_list_of_tasks_has_the_last_word_on_their_text(root: Path) -> None:
    """Its text counts; another form of the same characters is the same text."""
    edit_columns(root / TABLE, tasks=[[unicodedata.normalize("NFD", OPEN)], [CLOSE]])
    edit_columns(root / TABLE, goals=[[unicodedata.normalize("NFD", OPEN), "x"], [CLOSE]])
    first = unicodedata.normalize("NFD", OPEN)
    assert goals(root) == [(first, "x"), (CLOSE,)]
    edit_columns(root / TABLE, goals=None)
    assert goals(root) == [(OPEN,), (CLOSE,)]


def test_frames_of_another_task_than_the_listed_one(root: Path) -> None:
    edit_columns(root / DATA, task_index=[1] * 4 + [1] * 4)
    with raises(SourceError):
        goals(root)


def test_a_task_that_is_not_in_the_list(root: Path) -> None:
    edit_tasks(root, task_index=[0, 1], task=["open the drawer", CLOSE])
    with raises(SourceError):
        goals(root)


# --- several tasks -------------------------------------------------------------------------------

CHOSEN = {
    "wordings": (CLOSE, OPEN),
    "joined": (f"{CLOSE}; {OPEN}",),
    "first": (CLOSE,),
    "last": (OPEN,),
}


@pytest.mark.parametrize("choice", SEVERAL_TASKS)
def test_several_tasks_are_what_the_user_says(root: Path, choice: str) -> None:
    """In the order of the frames: LeRobot lists them in any order."""
    edit_columns(root / TABLE, tasks=[[OPEN, CLOSE], [CLOSE]])
    edit_columns(root / DATA, task_index=[1, 1, 0, 0] + [1] * 4)
    with raises(SourceError):
        goals(root)
    assert goals(root, several_tasks=choice) == [CHOSEN[choice], (CLOSE,)]


def test_listed_tasks_that_no_frame_has_come_last(root: Path) -> None:
    edit_columns(root / TABLE, tasks=[[OPEN, CLOSE], [CLOSE, OPEN]])
    assert goals(root, several_tasks="wordings") == [(OPEN, CLOSE), (CLOSE, OPEN)]


def test_an_unknown_choice(root: Path) -> None:
    with raises(InvalidOptionError):
        goals(root, several_tasks="frist")


@given(
    st.lists(st.text(min_size=1, max_size=5), unique=True, max_size=4),
    st.lists(st.text(max_size=5), max_size=3),
    st.sampled_from([None, *SEVERAL_TASKS]),
)
def test_a_goal_is_of_the_tasks_if_there_are_any(
    tasks: list[str], wordings: list[str], choice: str | None
) -> None:
    try:
        found = goal_wordings(tasks, wordings, choice)
    except SourceError:
        assert len(tasks) > 1 and choice is None
        return
    if not tasks:
        assert found == tuple(wordings)
    elif len(tasks) == 1:
        same = wordings and unicodedata.normalize("NFC", wordings[0]) == unicodedata.normalize(
            "NFC", tasks[0]
        )
        assert found == (tuple(wordings) if same else tuple(tasks))
    else:
        assert all(any(task in text for text in found) for task in tasks) or choice in (
            "first",
            "last",
        )


def test_the_choice_is_a_setting_of_a_build(tmp_path: Path, run: Any) -> None:
    episodes: dict[str, Episode] = {
        "Drawer/test/0": make_episode(1, 6, OPEN, 2),
        "Cups/train/0": make_episode(2, 6, "stack"),
    }
    root = write_lerobot(tmp_path / "dataset", episodes)
    edit_columns(root / TABLE, tasks=[[OPEN, "stack"], ["stack"]])
    build = ("build", tmp_path / "set", "--source", f"lerobot:{root}", "--unit", "3x2")
    options = ("--split", "test", "--conditions", "k0,k1", "--workers", "1")
    code, _, error = run(*build, *options)
    assert code == 1 and "several_tasks=joined" in error
    assert run(*build, *options, "--set", "several_tasks=joined")[0] == 0
    _, printed, _ = run("show", tmp_path / "set", "Drawer/test/0", "k0", "--json")
    assert f"{OPEN}; stack" in printed
