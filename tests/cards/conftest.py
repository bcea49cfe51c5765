"""What tests of cards share."""

from pathlib import Path

import pytest
from support.cards import cards


@pytest.fixture(scope="session")
def made() -> dict[str, dict[str, bytes]]:
    """The cards of the golden buffer set and run: their files by path, by name of the card."""
    return dict(cards())


@pytest.fixture(scope="session")
def published(made: dict[str, dict[str, bytes]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the trees that are published: `demonstrations`, `buffer_set` and `results`."""
    from support.cards import published_buffer_set, published_demonstrations, published_run

    root = tmp_path_factory.mktemp("published")
    published_demonstrations(root / "demonstrations", made["demonstrations"])
    published_buffer_set(root / "buffer_set", made["buffer_set"])
    published_run(root / "results", made["results"])
    return root
