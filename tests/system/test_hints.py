"""How the command line prints errors and messages."""

import json
import logging
from typing import Any
from unittest.mock import Mock

import pytest
import typer

from robomme_interference_data.cli import main
from robomme_interference_data.cli.console import echo, log_to_stderr, print_json
from robomme_interference_data.cli.hints import option_names, shown_error
from robomme_interference_data.errors import InterferenceError, InvalidOptionError, NoRendererError

EVALUATE = option_names(typer.main.get_command(main.app), ["evaluate", "my-buffers", "--json"])


@pytest.mark.parametrize(
    ("error", "lines"),
    [
        (InterferenceError("a", "b", "verify S"), ["a", "b", "Run: robomme-interference verify S"]),
        (NoRendererError("no device"), ["no device", "Run: robomme-interference doctor"]),
        (
            InvalidOptionError.expected("policy_options", "x", "NAME=VALUE"),
            ["--policy-option 'x'; expected NAME=VALUE"],
        ),
        (
            InvalidOptionError('not with executor="ray"', 'Add `retrieval="a b"` to `workers`.'),
            ["not with --executor ray", "Add --retrieval 'a b' to --workers."],
        ),
        # What is no setting of the command stays.
        (
            InvalidOptionError("`codec` of workers", 'Give device="cpu" or policy_options=x.'),
            ["`codec` of workers", 'Give device="cpu" or policy_options=x.'],
        ),
    ],
)
def test_settings_are_printed_as_options(error: InterferenceError, lines: list[str]) -> None:
    assert shown_error(error, EVALUATE).lines == lines


def test_logged_control_characters_are_escaped(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logging.getLogger("robomme_interference_data"), "propagate", True)
    log_to_stderr()
    logger = logging.getLogger("robomme_interference_data.storage.hub")
    logger.info("fetched %s", "\x1b[2Jname")
    logger.debug("not shown")
    assert capsys.readouterr().err == "fetched \\x1b[2Jname\n"


HOSTILE = "\x1b[2J\x9b2J\x1b]0;title\x07"
TO_OBEY = {"\x1b", "\x9b", "\x07"}


@pytest.mark.parametrize(
    "error", [InterferenceError(HOSTILE, HOSTILE), OSError(1, HOSTILE, HOSTILE), KeyError(HOSTILE)]
)
def test_control_characters_in_errors_are_escaped(
    error: Exception, run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "robomme_interference_data.cli.main.check_endpoint", Mock(side_effect=error)
    )
    code, out, err = run("conditions")
    assert (code, out) == (1, "")
    assert "[2J" in err and not TO_OBEY & {*err}


def test_control_characters_in_output_are_escaped(capsys: pytest.CaptureFixture[str]) -> None:
    echo(f"a\n\t{HOSTILE}")
    print_json({"key": HOSTILE})
    first, *rest = capsys.readouterr().out.splitlines()
    assert first == "a"
    assert not TO_OBEY & {*"".join(rest)}
    assert json.loads("\n".join(rest[1:])) == {"key": HOSTILE}  # JSON has escapes of its own
