"""Import on first use: public names of packages, and modules that need an extra."""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

from robomme_interference_data.errors import MissingExtraError


def lazy_exports(package: str, modules: Mapping[str, str]) -> Callable[[str], Any]:
    """Return a package's `__getattr__`, which imports only the module of the requested name.

    `modules` maps modules, relative or absolute, to their public names, separated by spaces.
    """
    module_of = {name: module for module, names in modules.items() for name in names.split()}

    def find(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(module_of[name], package), name)

    return find


def load_extra(module: str, name: str, what: str, extra: str) -> Callable[..., Any]:
    """Import `name` from a module of this package that needs the libraries of an extra.

    `what` needs them, for the message.
    """
    try:
        loaded = import_module(module)
    except ImportError as error:
        missing = error.name or ""
        if missing.startswith(module.partition(".")[0]) or isinstance(error, MissingExtraError):
            raise
        raise MissingExtraError.needs(what, missing or "a library", extra) from error
    return getattr(loaded, name)  # type: ignore[no-any-return]
