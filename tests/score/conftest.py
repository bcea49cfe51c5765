"""What tests of scoring share."""

from pathlib import Path

import pytest
from support import full_grid
from support import scoring as made

from robomme_interference_data.evaluate.score.scoring import Score


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the rows of the scores below are."""
    return tmp_path_factory.mktemp("scored")


@pytest.fixture(scope="session")
def small(folder: Path) -> Score:
    """A score of `scoring.OUTCOMES`."""
    return made.score(made.write_parquet(folder / "small.parquet", made.rows()))


@pytest.fixture(scope="session")
def kinds(folder: Path) -> Score:
    """A score of `scoring.KINDS`."""
    return made.kinds(folder)


@pytest.fixture(scope="session")
def questions(folder: Path) -> Score:
    """A score of `scoring.ANSWERS`."""
    return made.questions(folder)


@pytest.fixture(scope="session")
def full(folder: Path) -> Score:
    """A score of the paper's full grid, beside the published rates."""
    return made.score(full_grid.write(folder / "full.parquet"), paper=True, draws=200)
