"""What length, clock, place and first view reveal of the queries of days, by hand."""

from dataclasses import replace

import numpy as np
import pytest

from robomme_interference_data.evaluate.day_shortcuts import (
    DayCues,
    DayShortcut,
    day_shortcut_table,
    day_shortcuts,
    nearest,
)
from robomme_interference_data.retrieval.grade import ALL
from robomme_interference_data.schema.days import day_id

QUERY = DayCues("day-k2", day_id(30, "test", 0), "MoveCube", "easy", "recall", 0, 900, 900, 4, 300)


def of_days(*queries: DayCues) -> list[DayCues]:
    """The queries, each of another day."""
    return [replace(query, day=day_id(30, "test", n)) for n, query in enumerate(queries)]


def measured(queries: list[DayCues], target: str, ability: str, cue: str) -> DayShortcut:
    [found] = [
        shortcut
        for shortcut in day_shortcuts(queries)
        if (shortcut.target, shortcut.ability, shortcut.cue) == (target, ability, cue)
    ]
    return found


def test_a_clock_that_is_the_answer_reveals_it() -> None:
    """Of two answers, five queries each: by chance, a guess is right in 4 of 9 cases."""
    queries = of_days(*(replace(QUERY, answer=n % 2, clock=1000 * (n % 2)) for n in range(10)))
    found = measured(queries, "answer", ALL, "clock")
    assert (found.queries, found.right, found.p) == (10, 10, pytest.approx(2 / 252, rel=0.6))
    assert found.expected == pytest.approx(10 * 4 / 9, abs=0.2)
    unrelated = measured(queries, "answer", ALL, "task")  # all alike: the first other one
    assert unrelated.right == 4 and unrelated.p > 0.3


def test_answers_are_guessed_within_a_family_and_difficulty() -> None:
    queries = of_days(
        QUERY,
        replace(QUERY, answer=1),
        replace(QUERY, difficulty="hard", answer=0),
        replace(QUERY, family="RouteStick", answer=0),
    )
    found = measured(queries, "answer", ALL, "length")
    assert (found.queries, found.right) == (2, 0)
    abilities = measured(queries, "ability", ALL, "length")  # RouteStick has others
    assert (abilities.queries, abilities.right, abilities.p) == (3, 3, 1)


def test_each_ability_is_counted_by_itself() -> None:
    """Queries without a lesson are asked late here; their answers are not needed."""
    shown = (replace(QUERY, task=n, answer=n % 2) for n in range(6))
    queries = of_days(*shown, *(replace(QUERY, ability="absent", task=20 + n) for n in range(6)))
    absent = measured(queries, "ability", "absent", "task")
    assert (absent.queries, absent.right) == (6, 6) and absent.p < 0.05
    assert absent.expected == pytest.approx(6 * 5 / 11, abs=0.2)
    answers = {found.ability for found in day_shortcuts(queries) if found.target == "answer"}
    assert answers == {"recall", ALL}
    table = day_shortcut_table([*day_shortcuts(queries)], "title")
    assert [row[2] for row in table.rows] == ["recall", ALL, "recall", "absent", ALL]
    assert {row[-2] for row in table.rows} == {None}  # without images there is no view


def test_views_are_compared() -> None:
    shades = np.array([[10, 200], [12, 190], [200, 10], [190, 12]], np.uint8)
    views = np.repeat(np.repeat(shades[:, None, :, None], 16, 1), 8, 2).repeat(3, 3)
    queries = of_days(*(replace(QUERY, answer=n // 2, view=v) for n, v in enumerate(views)))
    assert measured(queries, "answer", ALL, "view").right == 4


def test_the_nearest_of_another_day() -> None:
    features = np.array([[0.0], [5.0], [1.0], [2.0]])
    near = nearest(features, np.array([0, 0, 1, 1]), np.arange(4))
    assert near.tolist() == [1, 0, 3, 2]
    near = nearest(features, np.zeros(4, np.int64), np.array([0, 1, 0, 1]))
    assert near.tolist() == [3, 2, 3, 2]
    tied = nearest(np.array([[1.0], [0.0], [2.0]]), np.zeros(3, np.int64), np.arange(3))
    assert tied.tolist() == [1, 0, 0]


def test_queries_of_one_day_are_not_compared() -> None:
    assert [*day_shortcuts([QUERY, replace(QUERY, answer=1)])] == []


def test_the_same_numbers_each_time() -> None:
    queries = of_days(*(replace(QUERY, answer=n % 3, length=n * n) for n in range(12)))
    assert [*day_shortcuts(queries)] == [*day_shortcuts(queries)]
