"""The `robomme-interference` command: a thin root, and how errors are shown.

Each area has its own commands file; only this one sees all of them.
"""

import os
import sys
from typing import Any

import typer
from typer.core import TyperGroup

from robomme_interference_data import commands
from robomme_interference_data.build_dataset import check_commands
from robomme_interference_data.build_dataset import commands as build_commands
from robomme_interference_data.errors import InterferenceError
from robomme_interference_data.evaluate import commands as evaluate_commands
from robomme_interference_data.evaluate.score import commands as score_commands
from robomme_interference_data.retrieval import commands as retrieval_commands
from robomme_interference_data.simulators import commands as simulator_commands

__all__ = ["app", "main"]


SEVERAL = {
    "build": ("--k",),
    "evaluate": ("--conditions", "--families"),
    "retrieval-score": ("--rules",),
}
"""Options that take several values, by command."""


class _Root(TyperGroup):
    """Lets options take several values, as in `--k 0 1 3 7`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        return super().parse_args(ctx, spread(args))


def spread(args: list[str]) -> list[str]:
    """Repeat an option before each of its values: click's options take one value each."""
    options = SEVERAL.get(args[0], ()) if args else ()
    spreaded: list[str] = []
    option: str | None = None
    for arg in args:
        if arg.startswith("-"):
            option = arg if arg in options else None
        elif option is not None and spreaded[-1] != option:
            spreaded.append(option)
        spreaded.append(arg)
    return spreaded


app = typer.Typer(
    cls=_Root,
    name="robomme-interference",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help="History buffers for RoboMME-Interference: build, load, stream and check.",
    epilog="""A split is a folder with demonstrations, distractor units and manifests of buffers.

```
robomme-interference doctor
robomme-interference build all --source robomme-h5:recordings/ --out my-split
robomme-interference verify my-split
robomme-interference list my-split
robomme-interference show MoveCube/train/0 --split my-split --k 3 --out strip.png
```
""",
)
app.add_typer(build_commands.app, name="build")
app.command()(check_commands.verify)
app.command()(check_commands.audit)
app.command(name="list")(commands.list_buffers)
app.command()(commands.show)
app.command()(retrieval_commands.index)
app.command()(retrieval_commands.retrieve)
app.command(name="retrieval-score")(retrieval_commands.retrieval_score)
app.command()(retrieval_commands.calibrate)
app.command()(commands.doctor)
app.command()(simulator_commands.simulate)
app.command()(score_commands.score)
app.command()(score_commands.compare)
app.command()(evaluate_commands.evaluate)
app.command()(evaluate_commands.merge)


def main() -> None:
    """Run the command line; known errors are shown without a traceback."""
    try:
        app()
    except InterferenceError as error:
        typer.secho(f"Error: {error.message}", fg=typer.colors.RED, err=True)
        if error.hint:
            typer.echo(error.hint, err=True)
        sys.exit(1)
    except BrokenPipeError:  # the reader of stdout (head, less) has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except OSError as error:
        if error.errno is None:  # not the system's word on a file
            raise
        where = f"{error.filename}: " if error.filename is not None else ""
        typer.secho(f"Error: {where}{error.strerror}", fg=typer.colors.RED, err=True)
        typer.echo("Check the path, its permissions and the space left on the disk.", err=True)
        sys.exit(1)


if __name__ == "__main__":
    main()
