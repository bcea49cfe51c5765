"""The commands `card`, `publish` and `publish-results`."""

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from robomme_interference_data.cli.console import (
    check_output,
    confirm,
    echo,
    graceful_interrupt,
    print_json,
    print_status,
)
from robomme_interference_data.cli.options import AsJson, BufferSetFolder, with_settings
from robomme_interference_data.errors import MissingExtraError, MissingFileError, counted
from robomme_interference_data.evaluate.score.config import Expected

from .publication import OTHER, Publication, PublishConfig

if TYPE_CHECKING:
    from robomme_interference_data.storage.files import Files

    from .facts import Facts
    from .repo import RepoFiles
    from .repo_plan import RepoPlan

_GROUP = "Publishing"

Private = Annotated[
    bool, typer.Option("--private", help="Make new repositories private.", rich_help_panel=_GROUP)
]
To = Annotated[
    Path | None,
    typer.Option(
        help="Write the files into this folder instead of publishing them.", rich_help_panel=_GROUP
    ),
]
DryRun = Annotated[
    bool, typer.Option("--dry-run", help="Only show what would be sent.", rich_help_panel=_GROUP)
]
PublishYes = Annotated[
    bool, typer.Option("--yes", help="Do not ask for confirmation.", rich_help_panel=_GROUP)
]


def card(
    source: Annotated[
        str,
        typer.Argument(
            metavar="DIR",
            help="Folder of a buffer set, of demonstrations or of a run; or a repository.",
        ),
    ],
    repo_id: Annotated[str, typer.Option(help="Repository, namespace/name.")] = "namespace/name",
    version: Annotated[str, typer.Option(help="Version, such as 1.0.0.")] = "1.0.0",
    license: Annotated[
        str, typer.Option(help="License, such as cc-by-4.0; other: the license of the recordings.")
    ] = OTHER,
) -> None:
    """Print the card (README.md) of a buffer set, of demonstrations or of a run.

    The whole text is computed from the data.

    Examples:
    ```
    robomme-interference card my-buffers --repo-id my-name/my-buffers
    robomme-interference card my-buffers/demonstrations --license cc-by-4.0
    robomme-interference card my-run --repo-id my-name/my-results
    ```
    """
    from .render import card_text

    publication = Publication(repo_id, version, license)
    echo(card_text(facts_of(source), publication), nl=False)


def facts_of(source: str) -> "Facts":
    """Return what the card of a folder or repository states."""
    from robomme_interference_data.constants import (
        IDENTITY_PATH,
        MANIFEST_PATH,
        RUN_HEADER,
        RUN_RECORD,
        RUN_TABLES,
    )
    from robomme_interference_data.data.dataset import Dataset
    from robomme_interference_data.data.loading import load_buffer_set
    from robomme_interference_data.storage.hub import locate

    from .dataset_facts import buffer_set_facts, demonstrations_facts
    from .results import results_facts

    if Path(source).is_file():
        return results_facts(Path(source))
    files = locate(source)
    if _has(files, MANIFEST_PATH):
        return buffer_set_facts(load_buffer_set(files.location))
    if _has(files, IDENTITY_PATH):
        return demonstrations_facts(Dataset(files))
    if _has(files, RUN_HEADER):
        return results_facts(files.snapshot(RUN_HEADER, RUN_RECORD, *RUN_TABLES))
    raise MissingFileError(
        f"{files.describe()} is no buffer set, no demonstrations and no run: {MANIFEST_PATH}, "
        f"{IDENTITY_PATH} and {RUN_HEADER} are missing",
        "Give the folder of a buffer set, of demonstrations or of a run.",
    )


def _has(files: "Files", path: str) -> bool:
    try:
        return files.path(path).is_file()
    except MissingFileError:
        return False


@with_settings
def publish(
    buffer_set: BufferSetFolder,
    config: PublishConfig,
    private: Private = False,
    to: To = None,
    dry_run: DryRun = False,
    yes: PublishYes = False,
    as_json: AsJson = False,
) -> None:
    r"""Publish a buffer set on the Hub, as two repositories with cards.

    The demonstrations come first, then the units with the manifests. All hashes and rules are
    checked before anything is sent. A published version never changes; its tag, such as data-1.0.0,
    is created last. Re-run the same command after an interruption to resume.

    Examples:
    ```
    robomme-interference publish my-buffers --repo-id my-name/my-buffers \
      --dry-run
    robomme-interference publish my-buffers --repo-id my-name/my-buffers \
      --license cc-by-4.0
    robomme-interference publish my-buffers --repo-id my-name/my-buffers \
      --to export/
    ```
    """
    from robomme_interference_data.constants import DEMONSTRATIONS, INDEX_DIR
    from robomme_interference_data.data.loading import load_buffer_set
    from robomme_interference_data.progress import WorkProgress

    from .buffer_set_content import BufferSetContent, plan_buffer_set, publish_buffer_set
    from .checks import check_buffer_set, missing_extras
    from .repo import HubRepository

    missing = missing_extras()
    install = f'pip install "robomme-interference-data[{",".join(missing)}]"'
    if missing and not dry_run:
        raise MissingExtraError("publishing needs libraries that are not installed", install)
    if missing:
        print_status(
            "This dry run leaves out what needs more libraries: cards with their pictures (extra "
            f"score), opening the datasets with LeRobot (extra build). For these: {install}"
        )
    opened = load_buffer_set(buffer_set)
    unpublished = opened.header.datasets[DEMONSTRATIONS].location is None
    if unpublished and not opened.dataset_files(DEMONSTRATIONS).list(INDEX_DIR):
        print_status(
            "The demonstrations have no embeddings. To add them before publishing: "
            f"robomme-interference index {shlex.quote(buffer_set)}"
        )
    if to is not None:
        check_output(to.resolve().parent)
    elif not dry_run:
        HubRepository(config.repo_id).check_rights(exists=False)  # checks may take hours
    with WorkProgress(quiet=as_json) as progress:
        check_buffer_set(opened, progress)
    content = BufferSetContent(opened, config)
    if to is not None:
        _export(content.folder(), to, dry_run=dry_run, as_json=as_json)
        return
    plans = plan_buffer_set(content)
    done = _carry_out(
        plans,
        lambda: publish_buffer_set(content, plans, private=private),
        dry_run=dry_run,
        yes=yes,
        as_json=as_json,
    )
    if done and not as_json:
        last = done[-1]
        print_status(f'load_buffer_set("{last.repository.repo_id}", revision="{last.version.tag}")')


@with_settings
def publish_results(
    run: Annotated[Path, typer.Argument(help="Folder of a run.")],
    config: Publication,
    expected: Annotated[
        Expected, typer.Option(help="Episodes of a complete cell, as in score.")
    ] = Expected.BENCHMARK,
    private: Private = False,
    to: To = None,
    dry_run: DryRun = False,
    yes: PublishYes = False,
    as_json: AsJson = False,
) -> None:
    r"""Publish the results of a run on the Hub: rows, scores, a report and a card.

    A published version never changes. Videos of rollouts are not published.

    Examples:
    ```
    robomme-interference publish-results my-run --repo-id my-name/my-results \
      --dry-run
    robomme-interference publish-results my-run --repo-id my-name/my-results \
      --yes
    ```
    """
    from .repo_plan import plan_version, publish_version
    from .results import results_content, score_run

    content = results_content(score_run(run, expected), run, config)
    if to is not None:
        _export(
            content.files(config.requested or content.first), to, dry_run=dry_run, as_json=as_json
        )
        return
    plan = plan_version(content, config.requested)
    _carry_out(
        [plan],
        lambda: [publish_version(plan, private=private)],
        dry_run=dry_run,
        yes=yes,
        as_json=as_json,
    )


def _export(files: "RepoFiles", to: Path, *, dry_run: bool, as_json: bool) -> None:
    """Write files into a folder, and report it."""
    from .repo import total_size, write_folder

    written = not dry_run and write_folder(files, to)
    if as_json:
        size = total_size(files)
        print_json({"to": str(to), "files": len(files), "bytes": size, "written": written})
    else:
        outcome = "dry run" if dry_run else "written" if written else "unchanged"
        count = f"{counted(len(files), 'file')}, {total_size(files):,} bytes"
        print_status(f"{to}: {count}; {outcome}")


def _carry_out(
    plans: "list[RepoPlan]",
    publish_plans: "Callable[[], list[RepoPlan]]",
    *,
    dry_run: bool,
    yes: bool,
    as_json: bool,
) -> "list[RepoPlan]":
    """Show plans, ask for confirmation, carry them out and report; return the published ones."""
    from .repo_plan import check_rights, plan_table

    print_status(plan_table(plans).text())
    if not dry_run and any(plan.published is None for plan in plans):
        check_rights(plans)
        confirm("Publish this?", "publishing", yes=yes)
        with graceful_interrupt("What was sent is kept; a version exists once it has its tag"):
            plans = publish_plans()
    if as_json:
        print_json([plan.to_dict() for plan in plans])
    elif not dry_run:
        print_status(f"{plans[-1].repository.page}/tree/{plans[-1].version.tag}")
    return [] if dry_run else plans
