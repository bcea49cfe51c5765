"""The command `verify`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from robomme_interference_data.build_dataset.config import SourceConfig
from robomme_interference_data.errors import InvalidOptionError, MissingFileError, counted, named
from robomme_interference_data.schema.settings import changed_settings

from .console import echo, print_json, print_status
from .options import AsJson, with_settings

if TYPE_CHECKING:
    from robomme_interference_data.data.buffer_set import BufferSet
    from robomme_interference_data.evaluate.shortcuts import Shortcut


_FOR_SOURCES = "my-buffers"
"""The folder in the command that builds verified sources, if none is given."""


@with_settings
def verify(
    sources: SourceConfig,
    buffer_set: Annotated[
        str | None,
        typer.Argument(
            metavar="BUFFER_SET",
            help="Folder of the buffer set, or NAMESPACE/NAME. With --source, optionally the "
            "folder to build.",
            show_default=False,
        ),
    ] = None,
    decode: Annotated[
        bool, typer.Option(help="Also decode all frames and check their hashes (slow).")
    ] = True,
    audit: Annotated[
        bool,
        typer.Option(
            "--audit",
            help="Also report how often units are used, at which positions families occur, what "
            "leaks, and how far lesson length, goal and first live view reveal the answer.",
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Recompute every hash and rule of a buffer set and list the violations; fails if there is one.

    With --source, check recordings before a build instead: read all frames of all episodes, and
    list everything that is wrong, by episode and frame.

    With --audit, a leak fails as well. A policy can use lesson length, goal and live view without
    any memory: each episode is guessed from the others of its family.

    Examples:
    ```
    robomme-interference verify my-buffers
    robomme-interference verify my-buffers --audit --no-decode
    robomme-interference verify --source frames:mine
    ```
    """
    if _of_sources(sources, buffer_set, decode=decode, audit=audit):
        from .verify_source import verify_sources

        verify_sources(sources, Path(buffer_set or _FOR_SOURCES), as_json=as_json)
    else:
        assert buffer_set is not None
        _verify_buffer_set(buffer_set, decode=decode, audit=audit, as_json=as_json)


def _of_sources(
    sources: SourceConfig, buffer_set: str | None, *, decode: bool, audit: bool
) -> bool:
    """Return whether sources are verified, not a buffer set.

    Raises:
        InvalidOptionError: Neither is given, or options without effect.
    """
    if sources.source:
        if audit or not decode:
            raise InvalidOptionError(
                f"{'--audit' if audit else '--no-decode'} has no effect on {named('source')}",
                "Leave it out: all frames of a source are read.",
            )
        return True
    if given := changed_settings(sources):
        raise InvalidOptionError(
            f"{named(given[0])} has no effect without {named('source')}",
            f"Leave it out, or add {named('source')}.",
        )
    if buffer_set is None:
        raise InvalidOptionError(
            "there is nothing to verify",
            "Give a buffer set, or recordings before a build: --source KIND:FOLDER",
        )
    return False


def _verify_buffer_set(buffer_set: str, *, decode: bool, audit: bool, as_json: bool) -> None:
    from robomme_interference_data.build_dataset.verify.buffer_set import (
        undecoded_frames,
        verify_buffer_set,
        verify_datasets,
    )
    from robomme_interference_data.progress import WorkProgress

    opened, incomplete = _open(buffer_set)
    progress = WorkProgress()
    if opened is None:
        checks = verify_datasets(Path(buffer_set), decode=decode, progress=progress)
    else:
        checks = verify_buffer_set(opened, decode=decode, progress=progress)
    with progress:
        violations = list(checks)
    report: dict[str, Any] = {"violations": [vars(violation) for violation in violations]}
    skipped = 0
    # A damaged buffer set may have no rows to count or to audit.
    if opened is not None and decode and not violations:
        skipped = undecoded_frames(opened)
    if skipped:
        report["frames_not_decoded"] = skipped
    if not as_json:
        for violation in violations:
            echo(f"{violation.where}: {violation.what}")
        what = "hashes and rules" if decode else "files, tables and rules (frames not decoded)"
        print_status(
            counted(len(violations), "violation")
            if violations
            else f"All {what} of {buffer_set}{' so far' if opened is None else ''} hold."
        )
        if skipped:
            frames = counted(skipped, "frame")
            print_status(f"Not decoded: {frames}, of which only some cameras were fetched.")
    leaks = False
    if opened is not None and not violations:
        _warn(opened, report, as_json=as_json)
        leaks = audit and _audit(opened, report, as_json=as_json)
    if as_json:
        print_json(report)
    if incomplete is not None:
        raise incomplete
    if violations or leaks:
        raise typer.Exit(1)


def _warn(opened: "BufferSet", report: dict[str, Any], *, as_json: bool) -> None:
    """Add to the report, or print, what breaks no rule and readers must know."""
    from robomme_interference_data.data.renderers import dataset_renderers, renderers_note

    note = renderers_note(dataset_renderers(opened.datasets).items())
    if note is None:
        return
    report["warnings"] = [note]
    if not as_json:
        print_status(f"Warning: {note}")


def _open(buffer_set: str) -> "tuple[BufferSet | None, MissingFileError | None]":
    """Open a buffer set; of datasets without manifests, return the error that says what lacks."""
    from robomme_interference_data.data.loading import built_datasets, load_buffer_set

    try:
        return load_buffer_set(buffer_set), None
    except MissingFileError as error:
        if not built_datasets(Path(buffer_set)):
            raise
        return None, error


def _audit(opened: "BufferSet", report: dict[str, Any], *, as_json: bool) -> bool:
    """Add the audit and the shortcuts to the report, or print them; return whether it leaks."""
    from robomme_interference_data.build_dataset.verify.audit import audit_buffer_set
    from robomme_interference_data.evaluate.shortcuts import shortcut_table
    from robomme_interference_data.schema.codec import to_dict
    from robomme_interference_data.viz.tables import tables_text

    audit = audit_buffer_set(opened)
    shortcuts = _shortcuts(opened)
    report["audit"] = audit.as_dict()
    report["shortcuts"] = [to_dict(shortcut) for shortcut in shortcuts]
    if not as_json:
        tables = [*audit.tables()]
        if shortcuts:
            tables.append(shortcut_table(shortcuts, f"Shortcuts in {opened.name}"))
        echo(tables_text(tables) + "\n")
        for leak in audit.leaks:
            echo(f"LEAK, {leak.kind}: {leak.where}")
        print_status(counted(len(audit.leaks), "leak") if audit.leaks else "No leaks.")
    return bool(audit.leaks)


def _shortcuts(opened: "BufferSet") -> "list[Shortcut]":
    """Return what reveals the answers; none without known evidence, as of recordings of a robot."""
    from robomme_interference_data.evaluate.shortcuts import cues_of, shortcuts

    records = (opened.query(episode).record for episode in opened.episode_ids)
    if all(record.evidence is None for record in records):
        return []
    return [*shortcuts(cues_of(opened))]
