"""How the command line prints errors and messages."""

import logging

import pytest
import typer

from robomme_interference_data.cli.hints import error_lines, option_names
from robomme_interference_data.cli.main import app, log_to_stderr
from robomme_interference_data.errors import InterferenceError, InvalidOptionError, NoRendererError

EVALUATE = option_names(typer.main.get_command(app), ["evaluate", "my-split", "--json"])


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
    assert error_lines(error, EVALUATE) == lines


def test_what_the_package_logs_is_printed_without_obeying_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    log_to_stderr()
    logger = logging.getLogger("robomme_interference_data.storage.hub")
    logger.info("fetched %s", "\x1b[2Jname")
    logger.debug("not shown")
    assert capsys.readouterr().err == "fetched \\x1b[2Jname\n"
