"""What is imported when it is asked for: public names of packages, and what needs an extra.

The command line and workers import packages first, and need few of their names.
"""

from collections.abc import Callable
from importlib import import_module
from typing import Any

from robomme_interference_data.errors import MissingExtraError


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


def load_extra(module: str, name: str, what: str, extra: str) -> Callable[..., Any]:
    """Import a module of ours that needs libraries of an extra, and return a name of it.

    Args:
        module: Its full name.
        name: The name.
        what: What needs it, for the message.
        extra: The extra, such as `evaluate`.

    Raises:
        MissingExtraError: A library is not installed.
    """
    try:
        loaded = import_module(module)
    except ImportError as error:
        missing = error.name or ""
        if missing.startswith(module.partition(".")[0]) or isinstance(error, MissingExtraError):
            raise
        raise MissingExtraError.needs(what, missing or "a library", extra) from error
    return getattr(loaded, name)  # type: ignore[no-any-return]
