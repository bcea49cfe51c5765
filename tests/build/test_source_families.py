"""How the episodes of a LeRobot dataset get their ids, and which goals fit which family."""

import unicodedata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.goal_texts import GOALS, UNMASK
from support.messages import raises

from robomme_interference_data.build_dataset.sources.lerobot.families import (
    ids_by_block,
    ids_by_columns,
)
from robomme_interference_data.build_dataset.sources.lerobot.families_file import (
    read_families,
    template,
)
from robomme_interference_data.build_dataset.sources.robomme_families import (
    ROBOMME,
    families_for_goal,
)
from robomme_interference_data.errors import FormatError, SourceError


def written(folder: Path, text: str, name: str = "families.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def ids_by_file(path: Path, count: int) -> dict:
    return ids_by_columns(read_families(path, [()] * count, "set"), str(path)) or {}


def names(ids: dict | None) -> dict[int, str]:
    return {index: str(name) for index, name in (ids or {}).items()}


def test_block() -> None:
    ids = names(ids_by_block())
    assert list(ids) == list(range(1600))
    assert len(set(ids.values())) == 1600
    assert (ids[0], ids[99]) == ("PatternLock/train/0", "PatternLock/train/99")
    assert (ids[345], ids[1599]) == ("VideoPlaceButton/train/45", "VideoUnmask/train/99")


def test_a_csv_file_in_any_form(tmp_path: Path) -> None:
    lines = ["episode_index, family, split", "2,InsertPeg,val", "", "0,MoveCube,"]
    path = written(tmp_path, "\n".join([*lines, "3,MoveCube,train", "1,MoveCube,val"]))
    expected = ["MoveCube/train/0", "MoveCube/val/0", "InsertPeg/val/0", "MoveCube/train/1"]
    assert names(ids_by_file(path, 4)) == dict(enumerate(expected))
    path = written(tmp_path, "\ufefffamily,index,episode_index\r\nA,7,0\r\nA,3,1\r\n")
    assert names(ids_by_file(path, 2)) == {0: "A/train/7", 1: "A/train/3"}


@given(st.lists(st.sampled_from(["A", "B", "MoveCube"]), min_size=1, max_size=20), st.randoms())
def test_the_order_of_lines_does_not_matter(tmp_path_factory, families, random) -> None:
    folder = tmp_path_factory.mktemp("families")
    lines = [f"{index},{family}" for index, family in enumerate(families)]
    random.shuffle(lines)
    path = written(folder, "episode_index,family\n" + "\n".join(lines))
    ids = ids_by_file(path, len(families))
    assert [name.family for name in ids.values()] == families
    for family in set(families):
        mine = [name.index for name in ids.values() if name.family == family]
        assert mine == list(range(len(mine)))


HEADER = "episode_index,family"


@pytest.mark.parametrize(
    "text",
    [
        "",
        "episode_index,famly\n0,A\n",
        f"{HEADER}\n0,A\n1\n",
        f"{HEADER}\n0,A\n-1,A\n",
        f"{HEADER}\n0,A\n{'9' * 5000},A\n",
        f"{HEADER}\n0,A\n2,A\n",
        f"{HEADER}\n0,A\n\n0,B\n",
        f"{HEADER}\n0,A\n",
        f"{HEADER}\n0,A\n1,9lives\n",
        f"{HEADER},split\n0,A,train\n1,A,trian\n",
        f"{HEADER},index\n0,A,0\n1,A,0\n",
        f"{HEADER},exec_start_idx\n0,A,-1\n",
        f"{HEADER},exec_start_idx\n0,A,\n",
        f"{HEADER}\n0,{'A' * 200_000}\n",
        f"task,{HEADER}\nx,0,A\n",
        "task,family,index\nx,A,0\n",
        "task,family\nx,A\n x ,B\n",
    ],
)
def test_errors_name_the_line_or_episode(tmp_path: Path, text: str) -> None:
    path = written(tmp_path, text)
    with raises(SourceError) as caught:
        ids_by_file(path, 2)
    assert str(path) in caught.value.message


def test_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "latin.csv").write_bytes("episode_index,famílie\n".encode("latin1"))
    for name, kind in (("none.csv", SourceError), ("latin.csv", FormatError)):
        with raises(kind):
            ids_by_file(tmp_path / name, 1)
    (tmp_path / "excel.csv").write_text("episode_index,family\n0,Öffnen\n", "utf-16")
    with raises(SourceError):  # it is read, and the family has a letter that no id has
        ids_by_file(tmp_path / "excel.csv", 1)


TASKS = [["open the drawer"], ['stack, then "wait"'], ["open  the drawer "], ["push"]]


def test_a_line_for_each_task(tmp_path: Path) -> None:
    path = written(tmp_path, template(TASKS))
    lines = path.read_text().splitlines()
    assert lines[0] == "task,family" and len(lines) == 4
    with raises(SourceError):  # the families are not filled in
        ids_by_columns(read_families(path, TASKS, "set"), "here")
    for name in ("Open", "Stack", "Push"):
        path.write_text(path.read_text().replace("<family>", name, 1))
    ids = names(ids_by_columns(read_families(path, TASKS, "set"), "here"))
    assert ids == dict(enumerate(["Open/train/0", "Stack/train/0", "Open/train/1", "Push/train/0"]))


def test_a_task_in_another_form_of_unicode(tmp_path: Path) -> None:
    """macOS writes "ö" as two characters, and most keyboards as one."""
    one, two = (unicodedata.normalize(form, "öffne") for form in ("NFC", "NFD"))
    path = tmp_path / "families.csv"
    for written, recorded in ((one, two), (two, one)):
        path.write_text(f"task,family\n{written},Drawer\n", encoding="utf-8")
        assert read_families(path, [[recorded]], "set") == [{"family": "Drawer"}]


def test_lines_that_a_file_lacks_are_offered(tmp_path: Path) -> None:
    path = written(tmp_path, "family,task,split\nOpen,open the drawer,test\n")
    with raises(SourceError) as caught:
        read_families(path, TASKS, "set")
    *_, stack, push = (caught.value.hint or "").splitlines()
    assert (stack, push) == ('"stack, then ""wait""",<family>,<split>', "push,<family>,<split>")
    path = written(tmp_path, f"{HEADER}\n0,A\n")
    with raises(SourceError) as caught:
        read_families(path, [()] * 60, "set")
    hint = (caught.value.hint or "").splitlines()
    assert hint[1:3] == ["1,<family>", "2,<family>"] and hint[-1] == "and 19 more"


def test_an_episode_of_several_tasks(tmp_path: Path) -> None:
    path = written(tmp_path, "task,family\nopen,Drawer\nclose,Drawer\npush,Push\n")
    assert read_families(path, [["open", "close"], ["push"]], "set") == [
        {"family": "Drawer"},
        {"family": "Push"},
    ]
    with raises(SourceError):
        read_families(path, [["open", "push"]], "set")


ROWS: list[tuple[list[dict[str, Any]], list[str] | str]] = [
    (
        [{"episode_id": "MoveCube/val/3"}, {"episode_id": "A/test/0"}],
        ["MoveCube/val/3", "A/test/0"],
    ),
    ([{"family": "A", "split": "val", "index": 12}, {"family": "A"}], ["A/val/12", "A/train/0"]),
    ([{"family": "A", "split": None}, {"family": "A", "index": None}], ["A/train/0", "A/train/1"]),
    ([{"tasks": ["x"], "index": 3}], []),
    ([], []),
    ([{"episode_id": "MoveCube"}], "here, episode 0: 'MoveCube' is not"),
    ([{"family": "A", "index": "7"}], "episode 0: '7' is not an episode index"),
    ([{"family": "A"}, {"family": None}], "episode 1: None is not a family"),
    ([{"episode_id": "A/val/1"}] * 2, "episodes 0 and 1 are both named A/val/1"),
]


@pytest.mark.parametrize(("rows", "expected"), ROWS)
def test_columns(rows: list[dict[str, Any]], expected: list[str] | str) -> None:
    if isinstance(expected, list):
        assert names(ids_by_columns(rows, "here")) == dict(enumerate(expected))
        return
    with raises(SourceError):
        ids_by_columns(rows, "here")


def test_every_goal_fits_its_families_and_no_others() -> None:
    for goal, families in GOALS.items():
        for text in (goal, goal.upper(), f" {goal.title().replace(' ', '  ')}\n"):
            assert families_for_goal(text) == families
    assert {family for families in GOALS.values() for family in families} == set(ROBOMME)


def test_real_goals(shared_data: Path) -> None:
    files = sorted((shared_data / "lessons").glob("*.npz"))
    assert len(files) == 9
    for file in files:
        with np.load(file) as lesson:
            family = str(lesson["env_id"])
            for goal in lesson["task_goal"]:
                expected = UNMASK if family in UNMASK else (family,)
                assert families_for_goal(str(goal)) == expected
