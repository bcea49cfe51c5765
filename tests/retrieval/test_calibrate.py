"""Calibration against values worked out by hand."""

from pathlib import Path
from typing import Any

import pytest
from support.messages import raises
from support.retrieval import made

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.retrieval import charts
from robomme_interference_data.retrieval.calibrate import Calibration, Trial, calibrate
from robomme_interference_data.retrieval.grade import ALL
from robomme_interference_data.retrieval.measure import Similarities
from robomme_interference_data.retrieval.select import Rule


def found_in(*measured: Similarities, sweep: tuple[float, ...] = (0.5,)) -> Calibration:
    return calibrate(measured, Rule(), sweep)


def three() -> list[Similarities]:
    """Cuts of 0, 0.4 and 0.2 (each family's own), lessons with 0.9, 0.7 and 0.8 at lowest.

    Units of one frame: nothing is inside them.
    """
    made_of = (("MoveCube", 0.0, 0.9), ("InsertPeg", 0.4, 0.7), ("RouteStick", 0.2, 0.8))
    return [
        made(
            f"{family}/test/0",
            condition,
            cuts={6: cut, 3: low},
            high={1: 1},
            spans=((0, 6), (6, 7)),
        )
        for family, cut, low in made_of
        for condition in ("k1", "k2")  # nested: each cut returns
    ]


def test_the_released_rule_by_hand() -> None:
    # 99th percentile of 0, 0.2, 0.4: 0.2 + 0.98 · 0.2 = 0.396. 1st of 0.7, 0.8, 0.9: 0.7 + 0.02 ·
    # 0.1 = 0.702. Midway: 0.549.
    found = found_in(*three(), sweep=(0.3, 0.549, 0.95))
    fitted = found.threshold, found.cut_percentile, found.lowest_percentile
    assert fitted == pytest.approx((0.549, 0.396, 0.702), abs=1e-6)
    assert found.cuts == pytest.approx((0, 0.2, 0.4))
    assert found.lowest == pytest.approx((0.7, 0.8, 0.9))
    # Without InsertPeg: 0.2 − 0.01 · 0.2 = 0.198 and 0.8 + 0.01 · 0.1 = 0.801.
    held_out = {one.family: one for one in found.held_out}
    without = held_out["InsertPeg"]
    assert without.threshold == pytest.approx((0.198 + 0.801) / 2, abs=1e-6)
    # That misses its cut of 0.4? No: it is below 0.4995.
    assert (without.condition, without.purity, without.coverage) == (ALL, 1, 1)
    sweep = {(trial.threshold, trial.condition): trial for trial in found.sweep}
    assert list(sweep) == [(cut, name) for cut in (0.3, 0.549, 0.95) for name in ("k1", "k2")]
    # At 0.3 InsertPeg is not cut: 6 of 7 frames are lesson. At 0.95 lessons fall into 3 and 3.
    assert sweep[0.3, "k1"].purity == pytest.approx((1 + 1 + 6 / 7) / 3)
    assert (sweep[0.549, "k2"].purity, sweep[0.549, "k2"].coverage) == (1, 1)
    # All three parts are too short, so all may be chosen: the first half is.
    assert (sweep[0.95, "k2"].purity, sweep[0.95, "k2"].coverage) == (1, 0.5)


def test_every_session_counts_and_each_once() -> None:
    # MoveCube's lesson, then units A and B; InsertPeg's lesson, then the same A and B.
    units = ("RouteStick/train/0", "PatternLock/train/0")
    one = made(cuts={3: 0.9, 6: 0.1, 8: 0.5, 11: 0.2, 13: 0.6}, high={}, units=units)
    other = made(
        "InsertPeg/test/0", cuts={3: 0.8, 6: 0.3, 8: 0.5, 11: 0.2, 13: 0.6}, high={}, units=units
    )
    found = found_in(one, other)
    assert found.lowest == pytest.approx([0.5, 0.6, 0.8, 0.9])
    assert found.cuts == pytest.approx([0.1, 0.2, 0.3])  # A to B once
    # Without MoveCube its query goes as a whole. 99th percentile of 0.2, 0.3: 0.299; 1st of 0.5,
    # 0.6, 0.8: 0.502.
    first = next(trial for trial in found.held_out if trial.family == "MoveCube")
    assert first.threshold == pytest.approx((0.299 + 0.502) / 2, abs=1e-6)


def test_a_family_is_left_out_of_other_buffers_too() -> None:
    # MoveCube's buffer holds a unit of InsertPeg between two of RouteStick: with InsertPeg left
    # out, its inside (0.5) and both its borders (0.1, 0.2) go; the border of the two units of
    # RouteStick (0.4) and the insides of the lesson (0.9) and of these (1) stay.
    spans = ((0, 6), (6, 11), (11, 15), (15, 19))
    units = ("InsertPeg/train/0", "RouteStick/train/0", "RouteStick/train/1")
    one = made(cuts={3: 0.9, 6: 0.1, 8: 0.5, 11: 0.2, 15: 0.4}, high={}, spans=spans, units=units)
    own = made("InsertPeg/test/0", cuts={6: 0.3}, high={}, units=units[1:])
    found = found_in(one, own)
    without = next(trial for trial in found.held_out if trial.family == "InsertPeg")
    # 1st percentile of 0.9, 1, 1: 0.902.
    assert without.threshold == pytest.approx((0.4 + 0.902) / 2, abs=1e-6)


def test_nothing_to_fit() -> None:
    alone = made(condition="k0", cuts={}, high={}, spans=((0, 6),))
    with raises(InvalidOptionError):
        found_in(alone)
    short = made(cuts={}, high={}, spans=((0, 1), (1, 2)))
    with raises(InvalidOptionError):
        found_in(short)
    assert found_in(*three()[:2]).held_out == ()  # one family


def test_legends_of_the_chart_cover_no_curve(tmp_path: Path) -> None:
    """They are below the axes, wherever the curves are."""
    sweep = tuple(Trial(0.5 + n / 10, "all", "k7", n / 4, 1.0) for n in range(5))
    found = Calibration("max", 0.923, 0.9, (0.2, 0.5, 0.9), (0.9, 1.0), 99, 1, (), sweep)
    seen: list[tuple[float, float]] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(charts, "save_figure", lambda figure, out: seen.extend(legends(figure)))
        charts.draw_calibration(found, "Thresholds", tmp_path / "thresholds.png")
    assert len(seen) == 2 and all(legend_top < axes_bottom for legend_top, axes_bottom in seen)


def legends(figure: Any) -> list[tuple[float, float]]:
    """The top of each legend, and the bottom of its axes."""
    return [
        (axes.get_legend().get_window_extent().y1, axes.get_window_extent().y0)
        for axes in figure.axes
    ]
