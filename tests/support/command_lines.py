"""Command lines of help pages and documents: parsed as the program would, without running them."""

from collections.abc import Sequence

import typer

from robomme_interference_data.cli.main import app


def parse(words: Sequence[str]) -> None:
    """Parse a command line down to its command; raises `click.UsageError` if it is none."""
    command = typer.main.get_command(app)
    context = command.make_context("robomme-interference", list(words))
    rest = [*context._protected_args, *context.args]
    name, found, rest = command.resolve_command(context, rest)  # type: ignore[attr-defined]
    while hasattr(found, "resolve_command"):
        context = found.make_context(name, list(rest), parent=context)
        rest = [*context._protected_args, *context.args]
        name, found, rest = found.resolve_command(context, rest)
    found.make_context(name, list(rest), parent=context)
