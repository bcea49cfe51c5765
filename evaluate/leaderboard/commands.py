"""The commands `submit` and `leaderboard`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from robomme_interference_data.cli.console import check_output, echo, print_status
from robomme_interference_data.errors import InvalidOptionError, PublishError, counted, named

if TYPE_CHECKING:
    from .rules import BrokenRule

_MEMORY_BYTES = 8 << 30
"""Memory for rows, which come from strangers, as in `score`."""

File = Annotated[Path, typer.Argument(metavar="RESULTS.yaml", help="The file of the leaderboard.")]


def submit(
    file: File,
    results: Annotated[
        list[str] | None,
        typer.Option(
            metavar="REPOSITORY",
            help="What publish-results published, such as my-name/my-results@data-1.0.0, or its "
            "folder (--to). Once for each training run of the system.",
        ),
    ] = None,
    checkpoint: Annotated[
        list[str] | None,
        typer.Option(help="Where the weights are, such as my-name/my-model@v1; for each result."),
    ] = None,
    weights: Annotated[
        list[Path] | None,
        typer.Option(
            help="File of the weights, or code of a policy without weights, whose SHA-256 is "
            "stated; for each result."
        ),
    ] = None,
    memory: Annotated[
        str | None,
        typer.Option(help="What the system remembers: none, frames, tokens, state or text."),
    ] = None,
    trained_on: Annotated[
        str | None,
        typer.Option(
            help="What it was trained on: interference (histories with distractor sessions), "
            "other, or nothing."
        ),
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Write nothing; without results, check the whole file.")
    ] = False,
) -> None:
    r"""Add the results of a system to a leaderboard, if they keep its twelve rules.

    Everything that is missing or wrong is listed, each with what to do.

    Examples:
    ```
    robomme-interference submit results.yaml --results my-name/my-results \
      --checkpoint my-name/my-model@v1 --weights model.safetensors \
      --memory frames --trained-on other
    robomme-interference submit results.yaml --check
    ```
    """
    from dataclasses import replace

    from robomme_interference_data.runtime.memory import memory_limit

    from .entries import add_submission, read_entries
    from .site import check_all
    from .submitting import new_submission

    entries = read_entries(file)
    given = {
        "results": results,
        "checkpoint": checkpoint,
        "weights": weights,
        "memory": memory,
        "trained_on": trained_on,
    }
    missing = [named(option) for option, value in given.items() if not value]
    new = None
    if missing and (len(missing) < len(given) or not check):
        raise InvalidOptionError(
            f"{', '.join(missing)} missing: a submission states all of them",
            f"Add them; to check what {file} holds, give {named('check')} alone.",
        )
    with memory_limit(_MEMORY_BYTES):
        if not missing:
            new = new_submission(
                entries,
                results or [],
                checkpoint or [],
                weights or [],
                memory=str(memory),
                trained_on=str(trained_on),
            )
            entries = replace(entries, submissions=(*entries.submissions, new))
        problems = check_all(entries)
    if new is not None:
        problems = [problem for problem in problems if problem.system == new.system]
    _print_problems(problems)
    if problems:
        raise PublishError(
            f"{counted(len(problems), 'problem')}, and nothing was written",
            "Mend what is listed, then run the same command again.",
        )
    if new is None:
        print_status(f"{counted(len(entries.submissions), 'submission')}: all rules hold")
    elif check:
        print_status(f"{new.system}: all rules hold; nothing was written")
    else:
        add_submission(file, new)
        print_status(f"{new.system} is on the board {new.board} of {file}")


def leaderboard(
    file: File,
    out: Annotated[Path, typer.Option(help="Folder of the site.")],
    released: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="Rows of the paper's systems: canonical_rollouts.csv, retrieval_rollouts.csv.",
        ),
    ] = None,
) -> None:
    r"""Check and score all submissions of a leaderboard, and write its page.

    The site is index.html, the same numbers in leaderboard.json, and rows/. Submissions that break
    a rule are listed with the reason, and not scored.

    Examples:
    ```
    robomme-interference leaderboard results.yaml --out site
    robomme-interference leaderboard results.yaml --out site \
      --released canonical_rollouts.csv --released retrieval_rollouts.csv
    ```
    """
    from robomme_interference_data.runtime.memory import memory_limit

    from .entries import read_entries
    from .site import PAGE, make_leaderboard, write_site

    check_output(out)
    entries = read_entries(file)
    with memory_limit(_MEMORY_BYTES):
        made = make_leaderboard(entries, released or [])
        data = write_site(made, out)
    _print_problems(made.problems)
    for board in data["boards"]:
        ranked = [system for system in board["systems"] if system["rank"] is not None]
        others = len(board["systems"]) - len(ranked)
        echo(f"{board['board']}: {len(ranked)} ranked, {others} beside them")
    print_status(f"Page: {out / PAGE}")


def _print_problems(problems: "Sequence[BrokenRule]") -> None:
    for problem in problems:
        print_status(str(problem))
        print_status(f"  {problem.rule.fix}")
