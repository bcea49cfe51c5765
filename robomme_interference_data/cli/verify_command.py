"""The command `verify`."""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from robomme_interference_data.build_dataset.config import SourceConfig
from robomme_interference_data.errors import (
    FormatError,
    HashMismatchError,
    InvalidOptionError,
    MissingFileError,
    counted,
    named,
)
from robomme_interference_data.schema.settings import changed_settings

from .console import echo, print_json, print_status
from .options import AsJson, with_settings
from .verify_plan import PlanOptions

if TYPE_CHECKING:
    from robomme_interference_data.build_dataset.verify.dataset import Violation
    from robomme_interference_data.build_dataset.verify.replay import Replay
    from robomme_interference_data.data.buffer_set import BufferSet
    from robomme_interference_data.evaluate.shortcuts import Shortcut


_OF_REPLAY = (
    "episodes",
    "simulator_python",
    "simulator_options",
    "workers",
    "executor",
    "resources",
)
"""Settings of sources that --replay uses too."""

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
            "leaks, and how far lesson length, goal and first live observation reveal the "
            "answer.",
        ),
    ] = False,
    replay: Annotated[
        str | None,
        typer.Option(
            metavar="SIMULATOR",
            help="Also play the episodes again on the simulator that recorded them, and compare "
            "evidence, goals, states and images; --episodes chooses some.",
            show_default=False,
        ),
    ] = None,
    against: Annotated[
        str | None,
        typer.Option(
            metavar="PLAN",
            help="Also compare sessions, lengths and digests with a reference plan: official, "
            "tutorial, a file that --write-plan wrote, or another buffer set.",
            show_default=False,
        ),
    ] = None,
    write_plan: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write the plan of a buffer set without violations as a reference plan.",
            show_default=False,
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Recompute every hash and rule of a buffer set and list the violations; fails if there is one.

    With --source, check recordings before a build instead: read all frames of all episodes, and
    list everything that is wrong, by episode and frame.

    With --audit, a leak fails as well. A policy can use lesson length, goal and first live
    observation without any memory: each episode is guessed from the others of its family. Queries
    of days are also guessed from the clock and the place of their lessons.

    A reference plan states the sessions of every buffer, the pool of units, lengths and digests.
    With --against, these must be equal, digests of images only where the renderer is the same.

    Examples:
    ```
    robomme-interference verify my-buffers
    robomme-interference verify my-buffers --audit --no-decode
    robomme-interference verify my-buffers --replay tabletop --episodes 0-4
    robomme-interference verify tutorial/buffers --against tutorial
    robomme-interference verify --source frames:mine
    ```
    """
    without_effect_on_sources = {
        "--audit": audit,
        "--replay": replay is not None,
        "--no-decode": not decode,
        "--against": against is not None,
        "--write-plan": write_plan is not None,
    }
    given = [option for option, is_given in without_effect_on_sources.items() if is_given]
    if _of_sources(sources, buffer_set, given, replay=replay):
        from .verify_source import verify_sources

        verify_sources(sources, Path(buffer_set or _FOR_SOURCES), as_json=as_json)
    else:
        assert buffer_set is not None
        played = None if replay is None else _PlayedAgain(replay, sources)
        plans = PlanOptions.read(against, write_plan)
        _verify_buffer_set(buffer_set, played, plans, decode=decode, audit=audit, as_json=as_json)


def _of_sources(
    sources: SourceConfig, buffer_set: str | None, given: list[str], *, replay: str | None
) -> bool:
    """Return whether sources are verified, not a buffer set; `given` are options for the latter.

    Raises:
        InvalidOptionError: Neither is given, or options without effect.
    """
    if sources.source:
        if given:
            raise InvalidOptionError(
                f"{given[0]} has no effect on {named('source')}",
                "Leave it out: all frames of a source are read.",
            )
        return True
    of_replay = _OF_REPLAY if replay is not None else ()
    if changed := changed_settings(sources, of_replay):
        raise InvalidOptionError(
            f"{named(changed[0])} has no effect without {named('source')}",
            f"Leave it out, or add {named('source')}.",
        )
    if buffer_set is None:
        raise InvalidOptionError(
            "there is nothing to verify",
            "Give a buffer set, or recordings before a build: --source KIND:FOLDER",
        )
    return False


@dataclass(frozen=True)
class _PlayedAgain:
    """The simulator that plays episodes again, and the settings that choose and run them."""

    simulator: str
    settings: SourceConfig

    def plan(self, opened: "BufferSet") -> "Replay | None":
        """Choose the episodes; None if a dataset cannot be opened, which is a violation."""
        from robomme_interference_data.build_dataset.verify.replay import plan_replay
        from robomme_interference_data.ids import parse_numbers

        chosen = self.settings.episodes
        numbers = None if chosen is None else {*parse_numbers(chosen)}
        with suppress(FormatError, HashMismatchError, MissingFileError):
            return plan_replay(
                opened.datasets,
                self.simulator,
                numbers,
                simulator_python=self.settings.simulator_python,
                simulator_options=self.settings.simulator_options,
            )
        return None

    def run(self, plan: "Replay", report: dict[str, Any]) -> "list[Violation]":
        """Play the episodes; add what was played to the report, and return the violations."""
        from robomme_interference_data.progress import WorkProgress
        from robomme_interference_data.runtime.executor import Serial, make_executor

        memory = max((played.source.worker_gb for played in plan.datasets.values()), default=0)
        settings = self.settings.fitting(memory)
        # One worker needs no process of its own: there is nothing to write.
        alone = settings.workers == 1 and not settings.on_cluster
        executor = Serial() if alone else make_executor(settings)
        with WorkProgress(unit="episodes") as progress:
            found = [*plan.run(executor, progress)]
        report["played_again"] = len(plan.episodes)
        report["states_not_compared"] = plan.without_states
        report["images_not_compared"] = plan.without_frames
        return found


def _verify_buffer_set(
    buffer_set: str,
    played: _PlayedAgain | None,
    plans: PlanOptions,
    *,
    decode: bool,
    audit: bool,
    as_json: bool,
) -> None:
    from robomme_interference_data.build_dataset.verify.buffer_set import (
        verify_buffer_set,
        verify_datasets,
    )
    from robomme_interference_data.progress import WorkProgress

    opened, incomplete = _open(buffer_set)
    report: dict[str, Any] = {}
    # First: what is wrong with the options shows before hours of decoding.
    plan = played.plan(opened) if played is not None and opened is not None else None
    with WorkProgress() as progress:
        if opened is None:
            checks = verify_datasets(Path(buffer_set), decode=decode, progress=progress)
        else:
            checks = verify_buffer_set(opened, decode=decode, progress=progress)
        violations = list(checks)
    if played is not None and plan is not None and not violations:
        violations += played.run(plan, report)
    report["violations"] = [vars(violation) for violation in violations]
    # A damaged buffer set may have no rows to count or to audit.
    if opened is not None and decode and not violations:
        report |= _unchecked(opened)
    if not as_json:
        for violation in violations:
            echo(f"{violation.where}: {violation.what}")
        what = "hashes and rules" if decode else "files, tables and rules (frames not decoded)"
        print_status(
            counted(len(violations), "violation")
            if violations
            else f"All {what} of {buffer_set}{' so far' if opened is None else ''} hold."
        )
        _print_extent(report)
        if played is not None and "played_again" not in report:
            print_status("Nothing was played again: correct the violations first.")
    leaks = differs = False
    if opened is not None and not violations:
        _warn(opened, report, as_json=as_json)
        leaks = audit and _audit(opened, report, as_json=as_json)
        differs = plans.used and plans.carry_out(opened, report, as_json=as_json)
    elif plans.used:
        print_status("No plan was compared or written: correct the violations first.")
    if as_json:
        print_json(report)
    if incomplete is not None:
        raise incomplete
    if violations or leaks or differs:
        raise typer.Exit(1)


def _unchecked(opened: "BufferSet") -> dict[str, Any]:
    """Return what could not be checked, for the report."""
    from robomme_interference_data.build_dataset.verify.buffer_set import undecoded_frames
    from robomme_interference_data.build_dataset.verify.planned_again import can_draw

    unchecked: dict[str, Any] = {}
    if skipped := undecoded_frames(opened):
        unchecked["frames_not_decoded"] = skipped
    if opened.header.questions is not None and not can_draw():
        unchecked["pictures_checked"] = False
    return unchecked


def _print_extent(report: dict[str, Any]) -> None:
    """Print what was played again, and what could not be checked."""
    if "played_again" in report:
        print_status(f"Played again: {counted(report['played_again'], 'episode')}.")
    if names := report.get("states_not_compared"):
        print_status(
            f"States not compared: {', '.join(names)} were recorded with another renderer than the "
            "one here."
        )
    if names := report.get("images_not_compared"):
        print_status(
            f"Images not compared: {', '.join(names)} were recorded with other versions or another "
            "renderer than those here, or stored with loss."
        )
    if skipped := report.get("frames_not_decoded"):
        frames = counted(skipped, "frame")
        print_status(f"Not decoded: {frames}, of which only some cameras were fetched.")
    if "pictures_checked" in report:
        extra = 'pip install "robomme-interference-data[retrieval]"'
        print_status(f"Not checked: the pictures of questions, which need Pillow: {extra}")


def _warn(opened: "BufferSet", report: dict[str, Any], *, as_json: bool) -> None:
    """Add to the report, or print, what breaks no rule and readers must know."""
    from robomme_interference_data.data.renderers import dataset_renderers
    from robomme_interference_data.schema.renderers import renderers_note

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
    from robomme_interference_data.evaluate.day_shortcuts import (
        day_cues,
        day_shortcut_table,
        day_shortcuts,
    )
    from robomme_interference_data.evaluate.shortcuts import shortcut_table
    from robomme_interference_data.schema.codec import to_dict
    from robomme_interference_data.viz.tables import tables_text

    audit = audit_buffer_set(opened)
    shortcuts = _shortcuts(opened)
    report["audit"] = audit.as_dict()
    report["shortcuts"] = [to_dict(shortcut) for shortcut in shortcuts]
    in_days = [*day_shortcuts(day_cues(opened))]
    if in_days:
        report["day_shortcuts"] = [to_dict(shortcut) for shortcut in in_days]
    if not as_json:
        tables = [*audit.tables()]
        if shortcuts:
            tables.append(shortcut_table(shortcuts, f"Shortcuts in {opened.name}"))
        if in_days:
            tables.append(day_shortcut_table(in_days, f"Shortcuts in the days of {opened.name}"))
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
