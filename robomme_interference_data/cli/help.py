"""The layout of `--help`: summary, arguments, options in groups, examples last, in 80 columns."""

import inspect
import textwrap
from collections.abc import Callable, Iterable
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

_LAST = ("as_json", "help")
"""Options that follow the groups."""

_Rows = list[tuple[str, str]]


class App(typer.Typer):
    """A group of commands whose help has this layout."""

    def __init__(self, cls: "type[Group] | None" = None, **settings: Any):
        settings["rich_markup_mode"] = None  # importing rich takes longer than everything else
        super().__init__(cls=cls or Group, no_args_is_help=True, **settings)

    def command(self, name: str | None = None, **settings: Any) -> Callable[..., Any]:
        """Declare a command; see `typer.Typer.command`."""
        return super().command(name, cls=_Command, **settings)


class _Command(TyperCommand):
    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        arguments = [_argument_name(param) for param in self.params if not _is_option(param)]
        return ["[OPTIONS]", *arguments]

    def format_help_text(self, ctx: Any, formatter: Any) -> None:
        _write_prose(formatter, inspect.cleandoc(self.help or "").partition("\nExample")[0])

    def format_options(self, ctx: Any, formatter: Any) -> None:
        _write_options(self, ctx, formatter)

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        _, heading, examples = inspect.cleandoc(self.help or "").partition("\nExample")
        _write_prose(formatter, heading + examples)


class Group(TyperGroup):
    """A group of commands; its help shows the whole first sentence of each."""

    @property
    def sections(self) -> dict[str, list[str]]:
        """The names of the commands by title."""
        return {"Commands": list(self.commands)}

    def format_help_text(self, ctx: Any, formatter: Any) -> None:
        """Write the description."""
        _write_prose(formatter, self.help or "")

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the options and the commands."""
        _write_options(self, ctx, formatter)
        for title, names in self.sections.items():
            rows = [(name, self.commands[name].get_short_help_str(200)) for name in names]
            _write_section(formatter, title, rows)

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the examples."""
        _write_prose(formatter, self.epilog or "")


def _is_option(param: Any) -> bool:
    return bool(param.param_type_name == "option")


def _argument_name(param: Any) -> str:
    name = param.metavar or param.name.upper()
    return f"{name if param.required else f'[{name}]'}{'...' if param.nargs != 1 else ''}"


def _write_options(command: Any, ctx: Any, formatter: Any) -> None:
    """Write the arguments, the options without a group, each group, and `--json` and `--help`."""
    sections: dict[str, _Rows] = {"Arguments": [], "Options": []}
    last: _Rows = []
    for param in command.get_params(ctx):
        record = param.get_help_record(ctx)
        if record is None:
            continue
        group = getattr(param, "rich_help_panel", None) or "Options"
        if not _is_option(param):
            help = record[1].removesuffix("[required]").rstrip()
            sections["Arguments"].append((_argument_name(param), help))
        elif param.name in _LAST:
            last.append(record)
        else:
            sections.setdefault(group, []).append(record)
    sections.setdefault("Options" if len(sections) == 2 else "Other options", []).extend(last)
    for title, rows in sections.items():
        _write_section(formatter, title, rows)


def _write_section(formatter: Any, title: str, rows: _Rows) -> None:
    if not rows:
        return
    formatter.write(f"\n{title}:\n")
    column = min(28, max(len(name) for name, _ in rows))
    for name, text in rows:
        lines = _wrap(text, formatter.width - column - 4)
        if len(name) > column:
            lines.insert(0, "")
        for number, line in enumerate(lines):
            shown = name if number == 0 else ""
            formatter.write(f"  {shown:{column}}  {line}".rstrip() + "\n")


def _write_prose(formatter: Any, text: str) -> None:
    """Write paragraphs, and shell commands, one per line, from blocks fenced by ```."""
    width = formatter.width - 2
    for number, block in enumerate(text.split("```")):
        if number % 2:
            commands = block.strip().replace("\\\n", " ").split("\n")
            _write_lines(formatter, (line for text in commands for line in _fold(text, width)))
        else:
            for paragraph in block.replace("`", "").split("\n\n"):
                _write_lines(formatter, _wrap(paragraph, width))


def _write_lines(formatter: Any, lines: Iterable[str]) -> None:
    text = "\n".join(f"  {line}".rstrip() for line in lines)
    if text:
        formatter.write(f"\n{text}\n")


def _fold(command: str, width: int) -> list[str]:
    """Break a shell command that is too long before its options."""
    command = " ".join(command.split())
    if len(command) <= width:
        return [command]
    unbroken = command.replace(" ", "\xa0").replace("\xa0--", " --")
    first, *rest = _wrap(unbroken, width - 6)
    lines = [first, *(f"    {line}" for line in rest)]
    return [line.replace("\xa0", " ") for line in " \\\n".join(lines).split("\n")]


def _wrap(text: str, width: int) -> list[str]:
    return textwrap.wrap(text.strip(), width, break_long_words=False, break_on_hyphens=False)
