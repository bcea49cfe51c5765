"""What tests of cards share."""

from collections.abc import Callable
from pathlib import Path

import pytest
from support.buffer_sets import CONDITIONS, copy_buffer_set, plan_again
from support.cards import cards
from support.publishing import plain_cards

from robomme_interference_data.cards import checks


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


@pytest.fixture
def _somebody(login: Callable[..., None], monkeypatch: pytest.MonkeyPatch) -> None:
    """Log in, and write plain cards, which take no time."""
    login("someone")
    plain_cards(monkeypatch)


@pytest.fixture
def _unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the checks, which decode everything and import lerobot."""
    monkeypatch.setattr(checks, "check_buffer_set", lambda *_: None)


@pytest.fixture
def extended(tmp_path: Path) -> Path:
    """The golden buffer set with one condition more."""
    root = copy_buffer_set(tmp_path / "extended")
    plan_again(root, [*CONDITIONS, "k2"])
    return root
