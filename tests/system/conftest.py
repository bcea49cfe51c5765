"""Fixtures of tests with real processes."""

from pathlib import Path

import pytest
from support import shared_policies, worlds


@pytest.fixture
def world(tiny_buffers: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Let `support.worlds` find the buffer set, and its faults in `tmp_path`, in all processes."""
    monkeypatch.setenv(worlds.BUFFER_SET, str(tiny_buffers))
    for name in (worlds.TROUBLE, shared_policies.FAULT, "VLA_EVAL_NOTES"):
        monkeypatch.setenv(name, str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))
