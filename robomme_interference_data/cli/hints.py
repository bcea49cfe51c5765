"""The text of an error: settings appear as options, with the command to run next."""

import re
import shlex
from collections.abc import Mapping, Sequence
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


def error_lines(error: InterferenceError, options: Mapping[str, str]) -> list[str]:
    """Return the message, the hint and the next command; `options` are those of `option_names`."""

    def as_option(match: re.Match[str]) -> str:
        option = options.get(match["name"] or match[5])
        if option is None:
            return match[0]
        return option if match["name"] is None else f"{option} {shlex.quote(match['value'])}"

    message = error.message
    name = isinstance(error, InvalidOptionError) and error.option
    if name and name in options:
        message = re.sub(rf"(?<![\w-]){re.escape(name)}\b", options[name], message, count=1)
    lines = [_SETTING.sub(as_option, text) for text in (message, error.hint) if text]
    command = error.command or NEXT_COMMANDS.get(type(error))
    return lines if command is None else [*lines, f"Run: {PROGRAM} {command}"]
