"""Trackers: what they get as rollouts end, and that they never end a run."""

import csv
import sys
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from support.runs import run

from robomme_interference_data.errors import InvalidOptionError, MissingExtraError

pytestmark = pytest.mark.usefixtures("world")

CONDITIONS = ("no-history", "k0", "k7")


class FakeRun:
    """A run of wandb or trackio that keeps what it gets; one of its calls may fail."""

    def __init__(self, fails: str = ""):
        self.fails, self.logged, self.calls = fails, list[tuple[int, dict[str, float]]](), []

    def init(self, **settings: Any) -> "FakeRun":
        sys.stdout.write("a line of the tracker")
        self.settings = settings
        return self._call("init")

    def log(self, metrics: Mapping[str, float], step: int) -> "FakeRun":
        self._call("log")
        self.logged.append((step, dict(metrics)))
        return self

    def finish(self) -> "FakeRun":
        return self._call("finish")

    def _call(self, name: str) -> "FakeRun":
        self.calls.append(name)
        if self.fails == name:
            raise ConnectionError(f"{name} failed")
        return self


def track(monkeypatch: pytest.MonkeyPatch, fake: FakeRun, name: str = "wandb") -> None:
    spec = SimpleNamespace(name=name)  # for find_spec
    monkeypatch.setitem(sys.modules, name, SimpleNamespace(init=fake.init, __spec__=spec))


def test_metrics_in_csv(tmp_path: Path) -> None:
    out = tmp_path / "run"
    result = run(out, conditions=CONDITIONS[:2], track="csv")
    path = out / "metrics.csv"
    lines = list(csv.DictReader(path.open()))
    last = {one["metric"]: float(one["value"]) for one in lines}
    assert int(lines[-1]["rollouts"]) == len(result.rows) == 4
    for condition in CONDITIONS[:2]:
        won = [row.success for row in result.rows if row.condition == condition]
        assert last[f"success/{condition}"] == sum(map(bool, won)) / len(won)
    assert (last["rollouts"], last["errors"]) == (4, 0)
    # A resumed run counts what is done, and appends.
    before = path.read_text()
    whole = run(out, conditions=CONDITIONS, track="csv")
    assert path.read_text().startswith(before)
    lines = list(csv.DictReader(path.open()))
    assert int(lines[-1]["rollouts"]) == 6
    last = {one["metric"]: float(one["value"]) for one in lines}
    assert last["success"] == sum(bool(row.success) for row in whole.rows) / 6


@pytest.mark.parametrize("name", ["wandb", "trackio"])
def test_metrics_in_a_library(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    fake = FakeRun()
    track(monkeypatch, fake, name)
    result = run(tmp_path / "run", track=name)
    assert [step for step, _ in fake.logged] == [1, 2, 3, 4]
    assert fake.logged[-1][1]["success"] == sum(bool(row.success) for row in result.rows) / 4
    assert (fake.settings["project"], fake.settings["name"]) == ("robomme-interference", "run")
    assert fake.settings["config"]["protocol_version"] == 1
    assert fake.calls[-1] == "finish"
    assert "a line of the tracker" not in capsys.readouterr().out
    monkeypatch.setenv(f"{name.upper()}_PROJECT", "mine")
    run(tmp_path / "second", track=name)
    assert fake.settings["project"] == "mine"


@pytest.mark.parametrize("fails", ["init", "log", "finish"])
def test_a_tracker_that_fails_does_not_end_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, fails: str
) -> None:
    fake = FakeRun(fails)
    track(monkeypatch, fake)
    result = run(tmp_path / "run", track="wandb")
    assert len(result.rows) == 4 and result.stopped is None
    assert fake.calls.count(fails) == 1
    warnings = [one.message for one in caplog.records if "tracking with wandb" in one.message]
    assert len(warnings) == 1 and f"{fails} failed" in warnings[0]


def test_trackers_are_checked_before_anything_is_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(MissingExtraError) as missing:
        run(tmp_path / "run", track="wandb", policy="lerobot:no/where")
    assert missing.value.hint == "Install it: pip install wandb"
    with pytest.raises(InvalidOptionError) as unknown:
        run(tmp_path / "run", track="tensorboard")
    assert unknown.value.option == "track"
    assert not (tmp_path / "run").exists()
