"""The root of the command line, and the display of errors. Each area declares its own commands."""

import json
import os
import signal
import sys
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib import metadata
from typing import Annotated, Any, NoReturn, Self

import typer
from typer.core import TyperCommand

from robomme_interference_data.build_dataset import commands as building
from robomme_interference_data.cards import commands as publishing
from robomme_interference_data.constants import DOCS_URL
from robomme_interference_data.errors import (
    InterferenceError,
    NoRendererError,
    first_line,
    naming_options,
)
from robomme_interference_data.evaluate import commands as evaluating
from robomme_interference_data.evaluate.leaderboard import commands as boards
from robomme_interference_data.evaluate.score import commands as scoring
from robomme_interference_data.evaluate.vla_eval import commands as vla_eval
from robomme_interference_data.retrieval import commands as retrieving
from robomme_interference_data.storage.hub import check_endpoint
from robomme_interference_data.training import commands as training

from . import commands, merge_command, show_command, simulate_command, verify_command
from .console import echo, log_to_stderr, print_status, write_utf8

PROGRAM = "robomme-interference"


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

    @classmethod
    def of(cls, error: InterferenceError) -> Self:
        """Return an error of this package as it is shown."""
        command = error.command
        if command is None and isinstance(error, NoRendererError):
            command = "doctor"
        whole = None if command is None else f"{PROGRAM} {command}"
        return cls(type(error).__name__, error.message, error.hint, whole)


class _Command(TyperCommand):
    """A command whose errors name its own options and arguments."""

    def make_context(self, *args: Any, **settings: Any) -> Any:
        """Parse the arguments."""
        try:
            return super().make_context(*args, **settings)
        except typer.BadParameter as error:
            # Typer's newer versions let pydantic check values, which says what it raised.
            error.message = error.message.removeprefix("Value error, ")
            raise

    def invoke(self, ctx: Any) -> Any:
        """Run the command; say so if it is interrupted, which Typer does not."""
        try:
            with naming_options(dict(map(_name_and_option, self.params))):
                return super().invoke(ctx)
        except KeyboardInterrupt:  # outside `graceful_interrupt`
            print_status("\nInterrupted.")
            raise typer.Exit(128 + signal.SIGINT) from None


def _name_and_option(parameter: Any) -> tuple[str, str]:
    """Return the Python name of a parameter, and its option, or the argument in the usage."""
    if parameter.param_type_name == "argument":
        return parameter.name, parameter.metavar or parameter.name.upper()
    return parameter.name, max(parameter.opts, key=len)


app = typer.Typer(
    name=PROGRAM,
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help="History buffers for RoboMME-Interference: build, load, stream and score.",
    epilog=f"""A buffer set is a folder with demonstrations, distractor units and manifests.
Options shown with NAME,… accept several values: separate them by commas or repeat the option.
Pages that help names, such as docs/reference/policies.md, are at {DOCS_URL}.

```
robomme-interference doctor
robomme-interference build my-buffers --source robomme-h5:recordings/
robomme-interference verify my-buffers
robomme-interference list my-buffers
robomme-interference show my-buffers MoveCube/train/0 k3 --out strip.png
```
""",
)

_GROUPS: dict[str, tuple[tuple[str, Callable[..., None]], ...]] = {
    "Data": (
        ("doctor", commands.doctor),
        ("build", building.build),
        ("verify", verify_command.verify),
        ("fetch", commands.fetch),
    ),
    "Look": (
        ("conditions", commands.list_conditions),
        ("list", commands.list_buffers),
        ("show", show_command.show),
        ("simulate", simulate_command.simulate),
    ),
    "Training": (("train", training.train),),
    "Retrieval": (
        ("index", retrieving.index),
        ("retrieve", retrieving.retrieve),
        ("retrieval-score", retrieving.retrieval_score),
    ),
    "Rollouts": (
        ("ceiling", evaluating.ceiling),
        ("evaluate", evaluating.evaluate),
        ("ask", evaluating.ask),
        ("merge", merge_command.merge),
        ("vla-eval-config", vla_eval.vla_eval_config),
    ),
    "Scores": (("score", scoring.score), ("compare", scoring.compare), ("power", scoring.power)),
    "Publish": (
        ("card", publishing.card),
        ("publish", publishing.publish),
        ("publish-results", publishing.publish_results),
        ("submit", boards.submit),
        ("leaderboard", boards.leaderboard),
    ),
}
"""Commands by title, in their order of use."""


_USAGE_ERROR: Any = typer.BadParameter.__mro__[1]
"""Click's error for a command that is called in a wrong way; Typer gives it no name."""


def _print_version(requested: bool) -> None:
    if requested:
        echo(f"{PROGRAM} {metadata.version('robomme-interference-data')}")
        raise typer.Exit


@app.callback()
def _root(
    context: typer.Context,
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the version.", callback=_print_version, is_eager=True
        ),
    ] = False,
) -> None:
    if context.invoked_subcommand != "doctor":  # which reports it beside the other checks
        check_endpoint()  # before libraries that use the Hub are imported


for _title, _commands in _GROUPS.items():
    for _name, _command in _commands:
        app.command(_name, cls=_Command, rich_help_panel=_title)(_command)


def main() -> None:
    """Run the command line; print known errors without a traceback.

    With `--json`, an error is one line of JSON, the last one on stderr: see `ShownError`.
    """
    write_utf8()
    log_to_stderr()
    as_json = "--json" in sys.argv[1:]
    try:
        command = typer.main.get_command(app)
        # Outside its standalone mode, Typer returns the exit code and raises errors of usage.
        sys.exit(command(prog_name=PROGRAM, standalone_mode=not as_json))
    except InterferenceError as error:
        _fail(ShownError.of(error), as_json)
    except _USAGE_ERROR as error:  # only with --json
        name, hint = type(error).__name__, None
        if error.ctx is not None:
            hint = f"Try: {error.ctx.command_path} --help"
        _fail(ShownError(name, error.format_message(), hint), as_json, error.exit_code)
    except typer.Abort as error:
        _fail(ShownError(type(error).__name__, "aborted"), as_json)
    except KeyboardInterrupt:  # outside `graceful_interrupt`
        sys.exit(128 + signal.SIGINT)
    except BrokenPipeError:  # head or less closed stdout
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except Exception as error:
        kind = type(error).__name__
        if not isinstance(error, OSError) or error.errno is None:  # a bug
            print_status(traceback.format_exc())
            if as_json:
                _fail(ShownError(kind, first_line(error)), as_json)
            sys.exit(1)
        names = [str(name) for name in (error.filename, error.filename2) if name is not None]
        hint = "Check the path, its permissions and the free disk space."
        if isinstance(error, FileExistsError | NotADirectoryError):
            hint = "The path must be a folder, but a file has this name. Use another path."
        message = ": ".join(filter(None, (" -> ".join(names), error.strerror)))
        _fail(ShownError(kind, message, hint), as_json)


def _fail(error: ShownError, as_json: bool, code: int = 1) -> NoReturn:
    if as_json:
        print_status(json.dumps(asdict(error)))
        sys.exit(code)
    print_status(f"Error: {error.message}", fg=typer.colors.RED)
    if error.hint is not None:
        print_status(error.hint)
    if error.command is not None:
        print_status(f"Run: {error.command}")
    sys.exit(code)


if __name__ == "__main__":
    main()
