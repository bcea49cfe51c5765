"""The limit on memory of commands that read files of strangers."""

import sys

import pytest

from robomme_interference_data.errors import FormatError
from robomme_interference_data.runtime.memory import memory_limit

resource = pytest.importorskip("resource")


def test_the_former_limit_applies_again() -> None:
    before = resource.getrlimit(resource.RLIMIT_DATA)
    with memory_limit(1 << 40):
        assert resource.getrlimit(resource.RLIMIT_DATA)[0] == 1 << 40
        with memory_limit(1 << 41):  # a lower limit stays
            assert resource.getrlimit(resource.RLIMIT_DATA)[0] == 1 << 40
    with pytest.raises(FormatError), memory_limit(1 << 40):
        raise MemoryError
    assert resource.getrlimit(resource.RLIMIT_DATA) == before


def test_without_limits_as_on_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "resource", None)
    with memory_limit(1):
        assert len(bytes(1 << 20)) == 1 << 20
