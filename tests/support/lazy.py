"""Modules that take seconds to import, imported where a test first uses them.

Every worker of pytest collects every file, but runs only some of them.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import Any

import pytest


class _Module:
    def __init__(self, name: str):
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        if attribute.startswith("_") or attribute == "pytestmark":  # pytest looks for these
            raise AttributeError(attribute)
        return getattr(import_module(self._name), attribute)


def lazy(name: str) -> Any:
    """Return what acts as a module; skip the tests of a file where its package is missing."""
    if find_spec(name.partition(".")[0]) is None:
        pytest.skip(f"needs {name}", allow_module_level=True)
    return _Module(name)
