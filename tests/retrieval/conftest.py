"""The golden buffer set with an index of thumbnails."""

import shutil
from pathlib import Path

import pytest
from support.retrieval import make_index


@pytest.fixture(scope="session")
def indexed(tiny_buffers: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The golden buffer set with its index of thumbnails of the front camera; read-only."""
    folder = shutil.copytree(tiny_buffers, tmp_path_factory.mktemp("indexed") / "buffer_set")
    make_index(folder)
    return folder
