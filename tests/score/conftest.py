"""What tests of scoring share."""

import pytest

from robomme_interference_data.schema.conditions import KINDS, Kind


@pytest.fixture
def filler(monkeypatch: pytest.MonkeyPatch) -> None:
    """A kind of conditions, `filler-k<n>`, of which scoring knows nothing."""
    monkeypatch.setitem(KINDS, "filler", Kind("filler", KINDS["k"].rule))
