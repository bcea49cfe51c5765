"""A buffer set with executions, shifted views and an index, and datasets of its items."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.buffer_sets import copy_buffer_set
from support.retrieval import make_index
from support.shifted import add_shifted

from robomme_interference_data.training import HistoryDataset

Make = Callable[..., HistoryDataset]


@pytest.fixture(scope="session")
def buffers(executed_buffers: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The golden buffer set with executions, shifted views, and an index."""
    root = copy_buffer_set(tmp_path_factory.mktemp("training") / "buffers", executed_buffers)
    add_shifted(root)
    make_index(root)
    return root


@pytest.fixture(scope="session")
def make(buffers: Path, tmp_path_factory: pytest.TempPathFactory) -> Make:
    """Make a dataset of that buffer set; the cache is shared."""
    store = tmp_path_factory.mktemp("cache")

    def call(conditions: Any = ("k3",), **options: Any) -> HistoryDataset:
        usual: dict[str, Any] = {"cache": store, "quiet": True, "image_size": 16, "split": "test"}
        return HistoryDataset(buffers, conditions, **usual | options)

    return call
