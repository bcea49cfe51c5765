"""The estimate of a build: measured on its first episodes, logged if the build is long or large."""

import logging
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from robomme_interference_data.build_dataset.dataset import estimate
from robomme_interference_data.build_dataset.dataset.estimate import BuildEstimate, estimate_text


def test_an_estimate_in_words() -> None:
    assert estimate_text(89, 59.9, 499.9, 1e6) is None
    hours = estimate_text(89, 9000, 1234.5, 9e4)
    assert hours is not None and "2.5 h and 1,234 MB for the other 89 episodes" in hours
    minutes = estimate_text(1, 90, 0.2, 9e4)
    assert minutes is not None and "2 min and 0 MB for the other 1 episode," in minutes
    full = estimate_text(10, 10, 600, 1199)
    assert full is not None and full.endswith("1,199 MB free: too little")


@pytest.mark.parametrize(("free", "level"), [(10**12, logging.INFO), (10**8, logging.WARNING)])
def test_the_first_episodes_of_all_workers_are_measured(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    free: int,
    level: int,
) -> None:
    caplog.set_level(logging.INFO)
    clock = iter([100.0, 140.0])
    monkeypatch.setattr(estimate, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
    for number, size in enumerate((1_000_000, 2_000_000, 9_000_000)):
        (tmp_path / str(number)).mkdir()
        (tmp_path / str(number) / "front.mp4").write_bytes(bytes(size))
    progress = BuildEstimate(tmp_path, 102, 2)
    progress.take(tmp_path / "0")
    assert caplog.records == []
    for number in (1, 2):
        progress.take(tmp_path / str(number))
    # 40 s for two episodes of 1.5 MB on average, 100 more: 2,000 s and 150 MB.
    [record] = caplog.records
    assert record.levelno == level
    assert "33 min and 150 MB for the other 100 episodes" in record.message


def test_a_short_build_is_not_estimated(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    BuildEstimate(tmp_path, 10, 1).take(tmp_path)
    assert caplog.records == []
