"""The commands `card`, `publish` and `publish-results`."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from robomme_interference_data.cli.console import check_output, echo, print_json, say, stoppable
from robomme_interference_data.cli.options import AsJson, SplitFolder, with_settings
from robomme_interference_data.errors import InvalidOptionError, MissingFileError
from robomme_interference_data.evaluate.score.config import Grid

from .publish_config import PublishConfig, VersionConfig

if TYPE_CHECKING:
    from robomme_interference_data.data.buffer_set import Split
    from robomme_interference_data.storage.files import Files

    from .publication import Publication
    from .publishing import Publishing
    from .step import Step

Private = Annotated[bool, typer.Option("--private", help="New repositories are private.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Only tell what would be sent.")]
Yes = Annotated[bool, typer.Option("--yes", help="Do not ask.")]


def card(
    source: Annotated[
        str,
        typer.Argument(
            metavar="DIR", help="Folder of a split, of demonstrations or of a run; or a Hub id."
        ),
    ],
    repo_id: Annotated[
        str, typer.Option(help="Repository that the card is for.")
    ] = "namespace/name",
    version: Annotated[str, typer.Option(help="Version that it is of.")] = "1.0.0",
    licence: Annotated[
        str,
        typer.Option("--license", help="Its licence, such as cc-by-4.0; other: the recordings'."),
    ] = "other",
) -> None:
    """Print the card of a split, of demonstrations or of a run: README.md, all of it from data.

    Examples:
    ```
    robomme-interference card my-split --repo-id my-name/my-split
    robomme-interference card my-split/demonstrations --license cc-by-4.0
    robomme-interference card my-run --repo-id my-name/my-results
    ```
    """
    from .publication import Publication

    echo(card_text(source, Publication(repo_id, version, licence)), nl=False)


def card_text(source: str, about: "Publication") -> str:
    """Return the card of whatever lies in a folder, or on the Hub under a name.

    Raises:
        MissingFileError: There is no split, no dataset and no run.
        InvalidOptionError: It is neither a folder nor the name of a repository.
        MissingExtraError: jinja2 is not installed.
        InterferenceError: It cannot be read.
    """
    from robomme_interference_data.constants import (
        IDENTITY_PATH,
        MANIFEST_PATH,
        RUN_HEADER,
        RUN_RECORD,
        RUN_TABLES,
    )
    from robomme_interference_data.data.dataset import Dataset
    from robomme_interference_data.data.loading import load_split
    from robomme_interference_data.storage.hub import locate

    from . import render

    if Path(source).is_file():
        return render.results_text(Path(source), about)
    files = locate(source)
    if _has(files, MANIFEST_PATH):
        return render.split_text(load_split(files.location), about)
    if _has(files, IDENTITY_PATH):
        return render.demonstrations_text(Dataset(files), about)
    if _has(files, RUN_HEADER):
        return render.results_text(files.snapshot(RUN_HEADER, RUN_RECORD, *RUN_TABLES), about)
    raise MissingFileError(
        f"{files.describe()} holds no split, no demonstrations and no run: {MANIFEST_PATH}, "
        f"{IDENTITY_PATH} and {RUN_HEADER} are missing",
        "Point to the folder that robomme-interference build or evaluate wrote.",
    )


def _has(files: "Files", path: str) -> bool:
    try:
        return files.path(path).is_file()
    except MissingFileError:
        return False


@with_settings
def publish(
    split: SplitFolder,
    config: PublishConfig,
    private: Private = False,
    to: Annotated[
        Path | None,
        typer.Option(help="Folder to write the repositories into, instead of publishing them."),
    ] = None,
    dry_run: DryRun = False,
    yes: Yes = False,
    as_json: AsJson = False,
) -> None:
    """Publish a split on the Hub: its demonstrations, then its units and manifests, with cards.

    All hashes and rules are checked first. A version never changes: its tag, such as data-1.0.0,
    comes last, and is never moved. Stopped at any time, the same command goes on and sends what is
    missing.

    Examples:
    ```
    robomme-interference publish my-split --repo-id my-name/my-split --dry-run
    robomme-interference publish my-split --repo-id my-name/my-split --license cc-by-4.0
    robomme-interference publish my-split --repo-id my-name/my-split --version 1.1.0 --yes
    robomme-interference publish my-split --repo-id my-name/my-split --to export/
    ```
    """
    from robomme_interference_data.constants import DEMONSTRATIONS, INDEX_DIR
    from robomme_interference_data.data.loading import load_split
    from robomme_interference_data.runtime.progress import WorkProgress

    from .checks import check_split
    from .upload import HubRepository

    opened = load_split(split)
    here = opened.header.datasets[DEMONSTRATIONS].place is None  # else they are published already
    if here and not opened.place(DEMONSTRATIONS).list(INDEX_DIR):
        say(
            "The demonstrations go without embeddings; for some, type before: "
            f"robomme-interference index {split}"
        )
    if to is not None:
        check_output(to.resolve().parent)
    elif not dry_run:
        HubRepository(config.repo_id, say).check_rights(there=False)  # checks may take hours
    with WorkProgress(quiet=as_json) as progress:
        check_split(opened, progress)
    if to is not None:
        _export(opened, config, to, dry_run=dry_run, as_json=as_json)
    else:
        _publish(opened, config, private=private, dry_run=dry_run, yes=yes, as_json=as_json)


def _export(
    split: "Split", config: PublishConfig, to: Path, *, dry_run: bool, as_json: bool
) -> None:
    from .export import exported_tree, write_tree
    from .tree import total_size

    tree = exported_tree(split, config)
    written = not dry_run and write_tree(tree, to)
    told = {"to": str(to), "files": len(tree), "bytes": total_size(tree), "written": written}
    if as_json:
        print_json(told)
    else:
        done = "would be written" if dry_run else "written" if written else "was there"
        say(f"{to}: {len(tree):,} files, {total_size(tree):,} bytes; {done}")


def _publish(
    split: "Split",
    config: PublishConfig,
    *,
    private: bool,
    dry_run: bool,
    yes: bool,
    as_json: bool,
) -> None:
    from .publish import Publisher

    publisher = Publisher(split, config, private=private, tell=say)
    steps = publisher.plan()
    done = _carry_out(
        publisher, steps, lambda: publisher.run(steps), dry_run=dry_run, yes=yes, as_json=as_json
    )
    if done and not as_json:
        last = done[-1]
        say(f'load_split("{last.repository.repo_id}", revision="{last.version.tag}")')


def _carry_out(
    publishing: "Publishing",
    steps: "list[Step]",
    run: "Callable[[], list[Step]]",
    *,
    dry_run: bool,
    yes: bool,
    as_json: bool,
) -> "list[Step]":
    """Show what is to be done, ask, do it, and tell; return what was done."""
    from .step import step_table

    say(step_table(steps).text())
    if not dry_run and any(step.published is None for step in steps):
        publishing.check_rights(steps)
        _ask(yes)
        with stoppable("What was sent is kept; nothing is a version before its tag is there"):
            steps = run()
    if as_json:
        print_json([step.as_dict() for step in steps])
    elif not dry_run:
        say(f"{steps[-1].repository.page}/tree/{steps[-1].version.tag}")
    return [] if dry_run else steps


@with_settings
def publish_results(
    run: Annotated[Path, typer.Argument(help="Folder of a run.")],
    config: VersionConfig,
    grid: Annotated[
        Grid, typer.Option(help="Episodes of a complete cell, as for score.")
    ] = Grid.BENCHMARK,
    private: Private = False,
    dry_run: DryRun = False,
    yes: Yes = False,
    as_json: AsJson = False,
) -> None:
    """Publish the results of a run on the Hub: rows, scores, report and a card.

    Versions are kept as those of a split are. Videos of rollouts stay here.

    Examples:
    ```
    robomme-interference publish-results my-run --repo-id my-name/my-results --dry-run
    robomme-interference publish-results my-run --repo-id my-name/my-results --yes
    ```
    """
    from .publish_results import results_of, score_run
    from .publishing import Publishing

    goods = results_of(score_run(run, grid), run, config)
    publishing = Publishing(config, private=private, tell=say)
    steps = [publishing.step(goods)]
    _carry_out(
        publishing,
        steps,
        lambda: [publishing.put(steps[0])],
        dry_run=dry_run,
        yes=yes,
        as_json=as_json,
    )


def _ask(yes: bool) -> None:
    """Ask whether to go on.

    Raises:
        InvalidOptionError: Nobody is there to answer.
    """
    if yes:
        return
    if not sys.stdin.isatty():
        raise InvalidOptionError(
            "nobody is there to be asked whether this is to be published",
            "If it is, type the same command with --yes.",
        )
    typer.confirm("Publish this?", abort=True, err=True)
