"""Every public name and option is documented."""

import inspect
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

from robomme_interference_data.cli.main import app

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs" / "_ext"))

import reference_pages  # noqa: E402 - it lies beside the pages


def public() -> Iterator[tuple[str, Any]]:
    for module in map(sys.modules.get, reference_pages.PUBLIC_MODULES):
        assert module is not None
        for name in reference_pages._exported(module):
            value = getattr(module, name)
            yield f"{module.__name__}.{name}", value
            if inspect.isclass(value):
                for inner, member in vars(value).items():
                    if not inner.startswith("_") and (
                        inspect.isroutine(member) or isinstance(member, property)
                    ):
                        yield f"{module.__name__}.{name}.{inner}", getattr(value, inner, member)


def test_public_names_have_docstrings() -> None:
    for name in reference_pages.PUBLIC_MODULES:
        __import__(name)
    names = dict(public())
    assert len(names) > 60
    assert [
        name for name, value in names.items() if callable(value) and not inspect.getdoc(value)
    ] == []


def test_every_option_has_a_help_text_and_is_on_the_reference_page() -> None:
    text = "\n".join(reference_pages.command_pages())

    def options(command: Any) -> Iterator[Any]:
        for inner in getattr(command, "commands", {}).values():
            yield from options(inner)
        yield from command.params

    found = [
        one
        for one in options(typer.main.get_command(app))
        if one.name not in ("help", "version", "install_completion", "show_completion")
    ]
    assert len(found) > 100
    assert [one.name for one in found if not one.help] == []
    assert [
        one.opts[0] for one in found if one.opts[0].startswith("-") and one.opts[0] not in text
    ] == []
