"""Import on first use: the public names of packages, and modules that need an extra.

The command line and workers import packages first, and need few of their names.
"""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

from robomme_interference_data.errors import MissingExtraError


def lazy_exports(package: str, modules: Mapping[str, str]) -> Callable[[str], Any]:
    """Return a package's `__getattr__`, which imports the module of a name, and no other.

    Args:
        package: Its `__name__`.
        modules: Module, relative or absolute, to the names it provides, separated by spaces.
    """
    module_of = {name: module for module, names in modules.items() for name in names.split()}

    def find(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(module_of[name], package), name)

    return find


def load_extra(module: str, name: str, what: str, extra: str) -> Callable[..., Any]:
    """Import a module of ours that needs libraries of an extra, and return a name of it.

    Args:
        module: Its full name.
        name: The name.
        what: What needs it, for the message.
        extra: The extra, such as `evaluate`.
    """
    try:
        loaded = import_module(module)
    except ImportError as error:
        missing = error.name or ""
        if missing.startswith(module.partition(".")[0]) or isinstance(error, MissingExtraError):
            raise
        raise MissingExtraError.needs(what, missing or "a library", extra) from error
    return getattr(loaded, name)  # type: ignore[no-any-return]
