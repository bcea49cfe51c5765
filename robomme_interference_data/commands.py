"""Commands that look at splits and at this machine: `list`, `show` and `doctor`."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from robomme_interference_data.console import MESSAGES, AsJson, print_json

__all__ = ["doctor", "list_buffers", "show"]

# Goals and paths are shown as they are, whatever brackets and colons they hold.
_OUT = Console(markup=False, emoji=False)


def list_buffers(
    split: Annotated[Path, typer.Argument(help="Folder of the split.")],
    family: Annotated[str | None, typer.Option(help="Only this family.")] = None,
    k: Annotated[int | None, typer.Option("--k", help="Only this k.")] = None,
    difficulty: Annotated[str | None, typer.Option(help="Only easy, medium or hard.")] = None,
    as_json: AsJson = False,
) -> None:
    """List the buffers of a split."""
    from robomme_interference_data.loader import load_split

    manifests = load_split(split).manifests(family=family, k=k, difficulty=difficulty)
    if as_json:
        for manifest in manifests:
            typer.echo(json.dumps(manifest.as_dict(), ensure_ascii=False))
        return
    table = Table(caption="lesson, history: frames; share: of lesson in an even 32-frame sample")
    for heading in ("episode", "k", "difficulty", "lesson", "history", "share"):
        table.add_column(heading, no_wrap=True)
    for manifest in manifests:
        table.add_row(
            str(manifest.episode_id),
            str(manifest.k),
            manifest.difficulty or "",
            str(manifest.lesson_frames),
            str(manifest.history_frames),
            f"{manifest.lesson_share:.2f}",
        )
    _OUT.print(table)


def show(
    episode: Annotated[str, typer.Argument(help="Episode id, such as VideoRepick/test/7.")],
    k: Annotated[int, typer.Option("--k", help="Number of distractor sessions.")],
    split: Annotated[
        Path,
        typer.Option(envvar="ROBOMME_INTERFERENCE_SPLIT", help="Folder of the split."),
    ] = Path(),
    out: Annotated[Path | None, typer.Option(help="Picture to write, .png or .svg.")] = None,
    camera: Annotated[str, typer.Option(help="Camera to draw.")] = "front",
    as_json: AsJson = False,
) -> None:
    """Show one buffer: its sessions as a table, or as a film strip with --out."""
    from robomme_interference_data.loader import load_buffer

    buffer = load_buffer(episode, k, split)
    if out is not None:
        from robomme_interference_data.strip import draw_strip

        draw_strip(buffer, out, camera=camera)
        MESSAGES.print(f"{out} written")
    if as_json:
        typer.echo(json.dumps(buffer.manifest.as_dict(), indent=2, ensure_ascii=False))
        return
    manifest = buffer.manifest
    table = Table(
        "session",
        "role",
        "family",
        "episode",
        "frames",
        title=f"{manifest.episode_id} at k={manifest.k}: {manifest.goal}",
        caption=f"{len(buffer)} history frames; an even 32-frame sample at the first step holds "
        f"{manifest.lesson_share:.0%} lesson",
    )
    for number, session in enumerate(buffer.sessions):
        table.add_row(
            str(number),
            session.role,
            session.family,
            str(session.source),
            f"{session.start} to {session.stop - 1}",
        )
    _OUT.print(table)


def doctor(as_json: AsJson = False) -> None:
    """Tell what works on this machine, and the command that mends what does not."""
    from robomme_interference_data import doctor as module

    rows = module.checks()
    if as_json:
        print_json([asdict(row) for row in rows])
    else:
        typer.echo(module.report(rows).text())
    if module.any_failed(rows):
        raise typer.Exit(1)
