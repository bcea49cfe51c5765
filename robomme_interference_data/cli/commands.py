"""Commands that list and fetch buffer sets, and check this machine."""

import shlex
from dataclasses import asdict
from operator import attrgetter
from pathlib import Path
from typing import Annotated

import typer

from robomme_interference_data.data.fetch_plan import FetchConfig
from robomme_interference_data.errors import counted

from .console import check_output, echo, graceful_interrupt, print_json, print_status
from .options import AsJson, BufferSetFolder, Conditions, Families, with_settings


def list_buffers(
    buffer_set: BufferSetFolder,
    families: Families = [],  # noqa: B006 - typer copies it
    conditions: Conditions = [],  # noqa: B006
    difficulty: Annotated[str | None, typer.Option(help="Only easy, medium or hard.")] = None,
    as_json: AsJson = False,
) -> None:
    """List the buffers of a buffer set.

    Examples:
    ```
    robomme-interference list my-buffers --conditions k3,k7
    robomme-interference list my-buffers --families MoveCube --json
    ```
    """
    from robomme_interference_data.data.loading import load_buffer_set
    from robomme_interference_data.schema.codec import to_dict
    from robomme_interference_data.viz.tables import Table

    opened = load_buffer_set(buffer_set)
    chosen = opened.manifests(family=families, condition=conditions, difficulty=difficulty)
    manifests = list(chosen)
    if as_json:
        print_json([to_dict(manifest) for manifest in manifests])
        return
    values = attrgetter(
        "episode_id", "condition", "difficulty", "lesson_frames", "history_frames", "lesson_share"
    )
    table = Table(
        "buffers",
        f"Buffers of {opened.location}",
        {
            "episode": "text",
            "condition": "text",
            "difficulty": "text",
            "lesson_frames": "count",
            "history_frames": "count",
            "lesson_share": "rate",
        },
        list(map(values, manifests)),
        "lesson share: of an even 32-frame sample of the history",
    ).without_empty("difficulty")
    episodes = len({manifest.episode_id for manifest in manifests})
    total = f"{counted(len(manifests), 'buffer')} of {counted(episodes, 'episode')}"
    echo(f"{table.text()}\n\n{total}")


def list_conditions(as_json: AsJson = False) -> None:
    r"""List the kinds of conditions: the history that each prescribes, and its purpose.

    Examples:
    ```
    robomme-interference conditions
    robomme-interference build my-buffers --only manifests \
      --conditions no-history,k0,k7,before-k7,held-k7
    ```
    """
    from robomme_interference_data.constants import MAX_K
    from robomme_interference_data.schema.conditions import KINDS
    from robomme_interference_data.viz.tables import Table

    table = Table(
        "conditions",
        "Conditions",
        {"condition": "text", "sessions": "text", "asks": "text", "needs": "text"},
        [(kind.pattern, kind.holds, kind.asks, " ".join(kind.needs)) for kind in KINDS.values()],
        f"n: 0 to {MAX_K}. units: distractor units of other families, the same for every kind. "
        "needs: datasets in addition to demonstrations and distractors.",
    )
    if as_json:
        print_json(table.records())
    else:
        echo(table.text())


@with_settings
def fetch(
    buffer_set: Annotated[str, typer.Argument(help="Repository, namespace/name or …@data-1.0.0.")],
    config: FetchConfig,
    to: Annotated[
        Path | None, typer.Option(help="Folder to copy the files to; default: only the cache.")
    ] = None,
    dry_run: Annotated[bool, typer.Option(help="Only print what would be fetched.")] = False,
    as_json: AsJson = False,
) -> None:
    r"""Fetch a buffer set from the Hub, or the part of it that some buffers need.

    Existing files are not fetched again; every file is checked against its SHA-256.

    Examples:
    ```
    robomme-interference fetch namespace/name@data-1.0.0
    robomme-interference fetch namespace/name --conditions k3 \
      --families MoveCube --cameras front
    robomme-interference fetch namespace/name --index thumbnail --to my-buffers
    ```
    """
    from robomme_interference_data.data.fetch import fetch as fetch_parts
    from robomme_interference_data.data.fetch_plan import plan_fetch
    from robomme_interference_data.data.loading import load_buffer_set

    check_output(None if to is None else to.resolve().parent)  # `to` may be an earlier copy
    with graceful_interrupt("What was fetched is kept"):
        opened = load_buffer_set(buffer_set)
        parts = plan_fetch(opened, config, to)
        repositories = [
            {
                "repository": part.files.describe(),
                "files": len(part.sizes),
                "bytes": sum(part.sizes.values()),
                "missing_files": len(part.missing),
                "missing_bytes": sum(part.sizes[path] for path in part.missing),
            }
            for part in parts
        ]
        for repository in repositories:
            print_status(
                "{repository}: {files:,} files, {bytes:,} bytes; to fetch: {missing_files:,} "
                "files, {missing_bytes:,} bytes".format(**repository)
            )
        if not dry_run:
            fetch_parts(parts, to)
    if as_json:
        print_json({"to": None if to is None else str(to), "repositories": repositories})
    elif not dry_run:
        print_status(f"Next: robomme-interference list {shlex.quote(str(to or opened.location))}")


def doctor(as_json: AsJson = False) -> None:
    """Check which parts of the package work on this machine, and print how to fix the others.

    Example:
    ```
    robomme-interference doctor
    ```
    """
    from . import doctor as module

    rows = module.checks()
    if as_json:
        print_json([asdict(row) for row in rows])
    else:
        echo(module.report(rows))
    if any(row.ok is False for row in rows):
        raise typer.Exit(1)
