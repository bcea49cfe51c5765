"""What a run shows while it goes on."""

import pytest

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.evaluate.run.progress import RunProgress, rate_table
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.conditions import DEFAULT_CONDITIONS
from robomme_interference_data.schema.rollouts import Rollout

PLAN = [
    WorkItem(condition, EpisodeId(family, "test", index))
    for family in FAMILIES
    for index in range(50)
    for condition in DEFAULT_CONDITIONS
]


def row(item: WorkItem, status: str) -> Rollout:
    success = None if status == "error" else status == "success"
    return Rollout(
        *("mine", "world", "buffer_set", "r", item.episode.family, item.condition, "test"),
        *(item.episode.index, "none", 0, 1, 7, "easy", "a goal", status, success, 0, 0, 0, None),
        error="it \x1b[2Jbroke" if status == "error" else None,
    )


def test_nine_families_and_five_conditions_fit_into_80_columns() -> None:
    progress = RunProgress(quiet=True)
    progress.start(PLAN, [row(item, "success") for item in PLAN])
    lines = progress.rates().splitlines()
    assert max(map(len, lines)) <= 80
    for family in FAMILIES:
        (line,) = [line for line in lines if line.startswith(f"{family} ")]
        assert line.split()[1:] == ["50/50", "100%"] * 5


def test_errors_stand_beside_the_rate() -> None:
    items = [item for item in PLAN if item.condition == "k0"][:7]
    ends = ("success", "fail", "success", "timeout", "success", "error")
    rows = [row(item, end) for item, end in zip(items, ends, strict=False)]
    other = WorkItem("no-history", EpisodeId("MoveCube", "test", 0))
    table = rate_table([*rows, row(other, "error")])
    assert [column.name for column in table.columns] == ["family", "no-history", "k0"]
    assert table.rows == (
        ("VideoRepick", "", "3/5 60%, 1 broke"),
        ("MoveCube", "1 broke", ""),
        ("all", "1 broke", "3/5 60%, 1 broke"),
    )


def test_without_a_terminal_a_line_is_written_for_each_cell(
    capsys: pytest.CaptureFixture[str],
) -> None:
    plan = [WorkItem(c, EpisodeId("MoveCube", "test", 0)) for c in ("no-history", "k0", "k1")]
    with RunProgress() as progress:
        progress.start(plan, [row(plan[0], "fail")])
        progress.row(row(plan[1], "success"))
        progress.row(row(plan[2], "error"))
    assert capsys.readouterr().err.splitlines() == [
        "1 of 3 rollouts are already done",
        "MoveCube k0: 1/1 100%  (2 of 3)",
        r"MoveCube/test/0 under k1 broke: it \x1b[2Jbroke",
        "MoveCube k1: 1 broke  (3 of 3)",
    ]
