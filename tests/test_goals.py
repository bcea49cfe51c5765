"""Which goal texts can belong to which family."""

import numpy as np
import pytest
from goal_texts import GOALS, UNMASK
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data.build_dataset.sources.families import BLOCK_FAMILIES
from robomme_interference_data.build_dataset.sources.goals import (
    GOAL_FAMILIES,
    families_for_goal,
    goal_fits,
)


@pytest.mark.parametrize(("goal", "families"), GOALS.items())
def test_families_for_goal(goal: str, families: tuple[str, ...]) -> None:
    assert families_for_goal(goal) == families
    assert [family for family in GOAL_FAMILIES if goal_fits(family, goal)] == list(families)


def test_every_family_has_a_rule() -> None:
    assert sorted(GOAL_FAMILIES) == sorted(BLOCK_FAMILIES)
    assert len(set(GOAL_FAMILIES)) == 16
    assert {family for families in GOALS.values() for family in families} == set(GOAL_FAMILIES)


@given(st.text())
def test_other_families_take_any_goal(goal: str) -> None:
    assert goal_fits("OpenDrawer", goal)


@given(st.sampled_from(sorted(GOALS)), st.data())
def test_case_and_spaces_do_not_matter(goal: str, data: st.DataObject) -> None:
    spaces = st.sampled_from([" ", "  ", "\n", "\t "])
    changed = "".join(data.draw(spaces) if letter == " " else letter for letter in goal)
    changed = data.draw(st.sampled_from([changed.upper(), changed.title(), f" {changed} "]))
    assert families_for_goal(changed) == GOALS[goal]


def test_real_lessons(shared_data) -> None:
    files = sorted((shared_data / "lessons").glob("*.npz"))
    assert len(files) == 9
    for file in files:
        with np.load(file) as lesson:
            family = str(lesson["env_id"])
            expected = UNMASK if family in UNMASK else (family,)
            for goal in lesson["task_goal"]:
                assert families_for_goal(str(goal)) == expected


def test_real_recordings(shared_data) -> None:
    h5py = pytest.importorskip("h5py")
    checked = 0
    for file in sorted((shared_data / "robomme_h5").glob("*_noimg.h5")):
        family = file.name.removesuffix("_noimg.h5")
        with h5py.File(file) as recording:
            for episode in recording.values():
                for goal in episode["setup/task_goal"][()]:
                    assert goal_fits(family, goal.decode())
                    checked += 1
    assert checked >= 6
