"""One thing has one name, in plain English, and every public name and option is documented."""

import inspect
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from robomme_interference_data.cli.main import app

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs" / "_ext"))

import reference_pages  # noqa: E402 - it lies beside the pages

REPLACED = (  # noqa: SIM905
    # names that have another one now
    "Material QueryMaterial Asked Answered Answerer Goods EpisodePlace FURTHER ExchangeFamily "
    "Obeying unusual_retrieval cannot_be_told go_on --grid --go-on --split-dir new-split my-split "
    "load_split SplitFolder "
    # habits of prose
    "whatever anybody anybody's anyone's told tells mended mends"
).split()
PHRASES = (
    *("is told of", "stands under", "stand under", "goes before", "at hand", "of itself"),
    *("is refused", "are refused", "goes on with", "go on with", "gone on with", "as it is"),
    *("a split of buffers", "split of your own", "policy hold", "policy obey"),
)
"""Terms that documentation and help pages do not use, as another word is clearer."""


def pages() -> Iterator[tuple[str, str]]:
    for path in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]:
        if "generated" not in path.parts:
            yield path.name, path.read_text(encoding="utf-8")
    for name, page in reference_pages.PAGES.items():
        yield f"generated/{name}", "\n".join(page())


@pytest.mark.parametrize(("name", "text"), [pytest.param(*one, id=one[0]) for one in pages()])
def test_pages_and_help_use_the_words_of_the_field(name: str, text: str) -> None:
    prose = re.sub(r"```.*?```", "", text, flags=re.S)
    found = [word for word in REPLACED if re.search(rf"(?<![\w-]){word}(?![\w-])", prose)]
    found += [phrase for phrase in PHRASES if re.search(rf"\b{phrase}\b", prose)]
    assert not found


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
