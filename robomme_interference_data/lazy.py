"""Public names of a package, imported when they are asked for.

The command line and workers import packages first, and need few of their names.
"""

from collections.abc import Callable
from importlib import import_module
from typing import Any


def lazily(package: str, *modules: str) -> Callable[[str], Any]:
    """Return a package's `__getattr__`, which finds what its `__all__` names in its modules.

    Args:
        package: Its `__name__`.
        modules: Where its names are, in the order of looking, such as `.split`.
    """

    def find(name: str) -> Any:
        if name in import_module(package).__all__:
            for module in modules:
                if hasattr(found := import_module(module, package), name):
                    return getattr(found, name)
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return find
