"""The layout of `--help`: summary, arguments, options in groups, examples last, in 80 columns."""

import inspect
import textwrap
from collections.abc import Callable
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from robomme_interference_data.errors import with_addresses

_Rows = list[tuple[str, str]]


class App(typer.Typer):
    """A group of commands whose help has this layout."""

    def __init__(self, cls: "type[Group] | None" = None, **settings: Any):
        settings["rich_markup_mode"] = None  # importing rich takes longer than everything else
        super().__init__(cls=cls or Group, no_args_is_help=True, **settings)

    def command(self, name: str | None = None, **settings: Any) -> Callable[..., Any]:
        """Declare a command; see `typer.Typer.command`."""
        return super().command(name, cls=_Command, **settings)


class _Layout:
    """Formats the help of a command or group."""

    help: str | None
    epilog: str | None

    def sections(self) -> dict[str, list[str]]:
        """Return the names of a group's commands by title."""
        return {"Commands": list(getattr(self, "commands", ()))}

    def collect_usage_pieces(self: Any, ctx: Any) -> list[str]:
        """Return the words of the usage, which errors of usage show too."""
        params = self.get_params(ctx)
        names = [_argument(one) for one in params if one.param_type_name == "argument"]
        command = ["COMMAND [ARGS]..."] if hasattr(self, "commands") else []
        return ["[OPTIONS]", *names, *command]

    def format_help(self: Any, ctx: Any, formatter: Any) -> None:
        """Write the help."""
        arguments: _Rows = []
        groups: dict[str, _Rows] = {"Options": []}
        last: _Rows = []
        for param in self.get_params(ctx):
            name, text = param.get_help_record(ctx)
            text = with_addresses(text)
            group = getattr(param, "rich_help_panel", None) or "Options"
            if param.param_type_name == "argument":
                arguments.append((_argument(param), text.removesuffix("[required]").rstrip()))
            elif param.name in ("as_json", "help"):
                last.append((name, text))
            else:
                groups.setdefault(group, []).append((name, text))
        groups.setdefault("Options" if len(groups) == 1 else "Other options", []).extend(last)

        commands = getattr(self, "commands", {})
        self.format_usage(ctx, formatter)
        description, heading, examples = inspect.cleandoc(self.help).partition("\nExample")
        _write_prose(formatter, description)
        for title, rows in [("Arguments", arguments), *groups.items()]:
            _write_section(formatter, title, rows)
        for title, names in self.sections().items():
            summaries = [(name, commands[name].get_short_help_str(200)) for name in names]
            _write_section(formatter, title, summaries)
        _write_prose(formatter, heading + examples + (self.epilog or ""))


class _Command(_Layout, TyperCommand):
    """A command, whose errors of usage are plain."""

    def make_context(self, *args: Any, **settings: Any) -> Any:
        """Parse the arguments."""
        try:
            return super().make_context(*args, **settings)
        except typer.BadParameter as error:
            # Typer's newer versions let pydantic check values, which says what it raised.
            error.message = error.message.removeprefix("Value error, ")
            raise


class Group(_Layout, TyperGroup):
    """A group of commands."""


def _argument(param: Any) -> str:
    """Return the name of an argument as users see it."""
    name = param.metavar or param.name.upper()
    return (name if param.required else f"[{name}]") + ("..." if param.nargs != 1 else "")


def _write_section(formatter: Any, title: str, rows: _Rows) -> None:
    if rows:
        formatter.write(f"\n{title}:\n")
    column = min(28, max((len(name) for name, _ in rows), default=0))
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
            paragraphs = [[line for text in commands for line in _fold(text, width)]]
        else:
            paragraphs = [_wrap(part, width) for part in block.replace("`", "").split("\n\n")]
        for lines in filter(None, paragraphs):
            formatter.write("\n" + "".join(f"  {line}".rstrip() + "\n" for line in lines))


def _fold(command: str, width: int) -> list[str]:
    """Break a shell command that is too long before its options."""
    command = " ".join(command.split())
    if len(command) <= width:
        return [command]
    unbroken = command.replace(" ", "\xa0").replace("\xa0--", " --")
    lines = [line.replace("\xa0", " ") for line in _wrap(unbroken, width - 4)]
    ends = [" \\"] * (len(lines) - 1) + [""]
    return [f"{'  ' * (n > 0)}{line}{ends[n]}" for n, line in enumerate(lines)]


def _wrap(text: str, width: int) -> list[str]:
    return textwrap.wrap(text.strip(), width, break_long_words=False, break_on_hyphens=False)
