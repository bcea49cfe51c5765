"""What a run shows while it goes on."""

import io
import re
from typing import Any

import pytest
from rich.console import Console

from robomme_interference_data.evaluate import progress as progress_module
from robomme_interference_data.evaluate.plan import WorkItem
from robomme_interference_data.evaluate.progress import RunProgress, rate_table
from robomme_interference_data.evaluate.rows import Rollout
from robomme_interference_data.ids import EpisodeId

FAMILIES = (
    *("VideoRepick", "VideoPlaceOrder", "VideoPlaceButton", "VideoUnmask", "VideoUnmaskSwap"),
    *("MoveCube", "InsertPeg", "PatternLock", "RouteStick"),
)
CONDITIONS = ("no-history", "k0", "k1", "k3", "k7")
PLAN = [
    WorkItem(condition, EpisodeId(family, "test", index))
    for family in FAMILIES
    for index in range(50)
    for condition in CONDITIONS
]


def row(item: WorkItem, status: str) -> Rollout:
    success = None if status == "error" else status == "success"
    return Rollout(
        *("mine", "world", "split", "r", item.episode.family, item.condition, "test"),
        *(item.episode.index, 0, 1, 7, "easy", "a goal", status, success, 0, 0, 0, None),
        error="it broke" if status == "error" else None,
    )


class Clock:
    now = 1000.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(progress_module, "time", clock)
    return clock


def shown(what: Any, width: int = 80) -> list[str]:
    console = Console(file=io.StringIO(), width=width, color_system=None)
    console.print(what)
    return console.file.getvalue().splitlines()  # type: ignore[attr-defined]


def test_the_time_left_is_by_the_mean_rollout(clock: Clock) -> None:
    """However far apart rollouts end: 2 250 of them, 200 done before, 4 workers or one."""
    progress = RunProgress(quiet=True)
    progress.start(PLAN, [row(item, "fail") for item in PLAN[:200]])
    assert progress.left() is None
    clock.now += 400  # the first ends after 400 s: 2 049 to go
    progress.row(row(PLAN[200], "success"))
    assert progress.left() == 2049 * 400
    clock.now += 100  # three more within 100 s: 4 in 500 s, 2 046 to go
    for item in PLAN[201:204]:
        progress.row(row(item, "fail"))
    assert progress.left() == 2046 * 125
    clock.now += 60  # time goes by
    assert progress.left() == 2046 * 125 - 60
    (line,) = [line for line in shown(progress._draw(), 100) if "rollouts" in line]
    assert "204/2250" in line
    # 255 690 s are 71 h 1 min 30 s.
    assert line.endswith("71:01:30 left")


def test_nine_families_and_five_conditions_fit_into_80_columns(clock: Clock) -> None:
    progress = RunProgress(quiet=True)
    progress.start(PLAN, [row(item, "success") for item in PLAN])
    lines = shown(progress._draw())
    assert max(map(len, lines)) <= 80
    for family in FAMILIES:
        (line,) = [line for line in lines if line.startswith(f"{family} ")]
        assert line.split()[1:] == ["50/50", "100%"] * 5


def test_each_cell_has_a_bar_with_its_success_rate(clock: Clock) -> None:
    progress = RunProgress(quiet=True)
    plan = [item for item in PLAN if item.episode.family in ("VideoPlaceButton", "MoveCube")]
    ends = {0: "success", 1: "fail", 2: "success", 3: "timeout", 4: "success", 5: "error"}
    k0 = [item for item in plan if item.condition == "k0"][:6]
    progress.start(plan, [])
    for number, item in enumerate(k0):
        progress.row(row(item, ends[number]))
    lines = shown(progress._draw())
    (place,) = [number for number, line in enumerate(lines) if line.startswith("VideoPlaceButton")]
    # Six of 50 ended; of the five that did not break three succeeded.
    assert re.split(r"\s{2,}", lines[place].strip())[1:] == [
        *("0/50", "6/50 60%", "0/50", "0/50", "0/50")
    ]
    assert lines[place + 1].split() == ["━"]  # 6 / 50 of ten; the rest is in colour only


def test_the_last_table_names_families_whole() -> None:
    lines = shown(rate_table([row(item, "timeout") for item in PLAN]))
    assert [line.split()[0] for line in lines[1:10]] == list(FAMILIES)
    assert lines[1].split()[1:] == ["0/50", "0%"] * 5
