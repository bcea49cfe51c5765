"""The golden split with an index of thumbnails."""

import shutil
from pathlib import Path

import pytest
from support.retrieval import make_index


@pytest.fixture(scope="session")
def indexed(tiny_split: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The golden split with its index of thumbnails of the front camera; read-only."""
    folder = shutil.copytree(tiny_split, tmp_path_factory.mktemp("indexed") / "split")
    make_index(folder)
    return folder
