"""The tiny split with an index of thumbnails."""

import shutil
from pathlib import Path

import pytest
from support.retrieval import make_index

GOLDEN = Path(__file__).parent.parent / "golden"


@pytest.fixture(scope="session")
def tiny_split() -> Path:
    """A split of 32 × 32 pixels, committed; read-only."""
    return GOLDEN / "split"


@pytest.fixture(scope="session")
def indexed(tiny_split: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny split with its index of thumbnails of the front camera; read-only."""
    folder = shutil.copytree(tiny_split, tmp_path_factory.mktemp("indexed") / "split")
    make_index(folder)
    return folder


@pytest.fixture
def split(tiny_split: Path, tmp_path: Path) -> Path:
    """A copy of the tiny split, without an index."""
    return shutil.copytree(tiny_split, tmp_path / "split")
