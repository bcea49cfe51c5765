"""The text of an error: settings appear as options, with the command to run next."""

import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from robomme_interference_data.errors import InterferenceError, InvalidOptionError, NoRendererError

PROGRAM = "robomme-interference"

NEXT_COMMANDS: dict[type[InterferenceError], str] = {NoRendererError: "doctor"}
"""Commands to run after errors of a type, unless the error names one."""

_SETTING = re.compile(
    r"""(?P<tick>`?)\b(?P<name>[a-z]\w*)=(?P<quote>["'])(?P<value>.*?)(?P=quote)(?P=tick)|`(\w+)`"""
)


def option_names(root: Any, arguments: Sequence[str]) -> dict[str, str]:
    """Return the options of the command that `arguments` call, by the names of their settings."""
    command = root
    for word in arguments:
        if word not in getattr(command, "commands", {}):
            break
        command = command.commands[word]
    options = {one.name: max(one.opts, key=len) for one in command.params}
    return {name: option for name, option in options.items() if option.startswith("--")}


@dataclass(frozen=True)
class ShownError:
    """An error as the command line shows it: as lines, or with `--json` as these fields.

    Attributes:
        type: Name of its class.
        message: What was given and what was expected.
        hint: What to do next, or None.
        command: A whole command that helps, or None.
    """

    type: str
    message: str
    hint: str | None = None
    command: str | None = None

    @property
    def lines(self) -> list[str]:
        """The message, the hint and the command."""
        command = self.command and f"Run: {self.command}"
        return [line for line in (self.message, self.hint, command) if line]


def shown_error(error: InterferenceError, options: Mapping[str, str]) -> ShownError:
    """Name settings in an error by their options; `options` are those of `option_names`."""

    def as_option(match: re.Match[str]) -> str:
        option = options.get(match["name"] or match[5])
        if option is None:
            return match[0]
        return option if match["name"] is None else f"{option} {shlex.quote(match['value'])}"

    message = error.message
    name = isinstance(error, InvalidOptionError) and error.option
    if name and name in options:
        message = re.sub(rf"(?<![\w-]){re.escape(name)}\b", options[name], message, count=1)
    command = error.command or NEXT_COMMANDS.get(type(error))
    return ShownError(
        type(error).__name__,
        _SETTING.sub(as_option, message),
        error.hint and _SETTING.sub(as_option, error.hint),
        command and f"{PROGRAM} {command}",
    )
