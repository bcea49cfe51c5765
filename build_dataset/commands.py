"""Commands that build and check buffer sets: `build …`, `new-buffer-set`, `verify`, `audit`."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from robomme_interference_data.cli.console import (
    confirm,
    echo,
    graceful_interrupt,
    print_json,
    print_status,
)
from robomme_interference_data.cli.help import App
from robomme_interference_data.cli.options import AsJson, BufferSetFolder, Yes, with_settings
from robomme_interference_data.constants import (
    CONTRADICTIONS,
    DEMONSTRATIONS,
    DISTRACTORS,
    EXECUTIONS,
    MANIFEST_PATH,
    MANIFESTS,
    RAW_DISTRACTORS,
    REPORT_PATH,
    SHIFTED,
)
from robomme_interference_data.errors import MissingFileError, counted
from robomme_interference_data.runtime.executor import WorkersConfig, make_executor

from .config import AllConfig, BuildConfig, NewConfig, PlanConfig
from .plan import BuildPlan, like, plan_all, plan_alone, plan_new
from .plan_checks import plan_more_units
from .replan import Replan, replan

if TYPE_CHECKING:
    from robomme_interference_data.storage.files import Files

app = App(
    help="Build a buffer set: its datasets and its manifests.",
    epilog="""Build everything at once, then verify it:

```
robomme-interference build all my-buffers --source robomme-h5:recordings/
robomme-interference verify my-buffers
```

`build all` runs these three:

```
robomme-interference build demonstrations my-buffers --source robomme-h5:recordings/
robomme-interference build distractors my-buffers --source robomme-h5:recordings/
robomme-interference build manifests my-buffers
```
""",
)

_Folder = Annotated[Path, typer.Argument(metavar="BUFFER_SET", help="Folder of the buffer set.")]

_KEPT = "Finished episodes are kept"
_MAX_SKIPPED = 10
"""Skipped episodes to print."""

_DATASETS = {
    DEMONSTRATIONS: r"""Build the query episodes' demonstrations and their first live observations.

    After an interruption, re-run the same command to resume. An existing dataset is extended.

    Examples:
    ```
    robomme-interference build demonstrations my-buffers --source robomme-h5:h5/ --split test
    robomme-interference build demonstrations my-buffers --source tabletop --episodes 0-4
    ```
    """,
    DISTRACTORS: r"""Build distractor units: 32 frames per episode, raw indices 0, 8, …, 248.

    Episodes of fewer than 249 raw frames yield no unit; meta/build_report.json lists them.

    Examples:
    ```
    robomme-interference build distractors my-buffers --source lerobot:NAMESPACE/NAME
    robomme-interference build distractors my-buffers --source tabletop --source frames:mine/
    ```
    """,
    RAW_DISTRACTORS: """Build distractor units at full rate, 256 raw frames each, for raw-k<n>.

    Use the episodes of the distractors: every unit of a buffer needs its raw unit.

    Example:
    ```
    robomme-interference build distractors-raw my-buffers --source tabletop
    ```
    """,
    CONTRADICTIONS: """Build contradicting lessons: the same scene with another answer (tabletop).

    For stale-k<n> and misled-k<n>. Default: the query episodes of the buffer set.

    Example:
    ```
    robomme-interference build contradictions my-buffers --source tabletop
    ```
    """,
    SHIFTED: """Build the query episodes' views under each shift, for retrieval-score (tabletop).

    Nine frames per episode: the first live view under light, camera and clutter shifts of strengths
    1, 2 and 3. Default: the query episodes of the buffer set. Build the manifests and the index
    afterwards.

    Example:
    ```
    robomme-interference build shifted my-buffers --source tabletop
    ```
    """,
    EXECUTIONS: """Build what follows each lesson: live frames and states, with the next actions.

    To train and test policies. Default: the query episodes of the buffer set. Build the manifests
    afterwards.

    Example:
    ```
    robomme-interference build executions my-buffers --source tabletop
    ```
    """,
}
"""Kind of dataset to the help of its command."""


def _add_command(kind: str, text: str) -> None:
    @with_settings
    def build(config: BuildConfig, yes: Yes = False, as_json: AsJson = False) -> None:
        with graceful_interrupt(_KEPT):
            plan = plan_alone(kind, config)
            if kind == DISTRACTORS and (change := plan_more_units(plan, config.buffer_set)):
                _confirm(change, yes=yes)
            _build(plan, config.buffer_set / kind, config, as_json=as_json)
        if (config.buffer_set / MANIFEST_PATH).is_file():
            print_status(f"Next: robomme-interference build manifests {config.buffer_set}")

    app.command(name=kind, help=text)(build)


for _kind, _text in _DATASETS.items():
    _add_command(_kind, _text)


@app.command()
@with_settings
def manifests(
    buffer_set: _Folder, config: PlanConfig, yes: Yes = False, as_json: AsJson = False
) -> None:
    """Plan the history buffers of all query episodes; what is planned stays planned.

    Examples:
    ```
    robomme-interference build manifests my-buffers
    robomme-interference build manifests my-buffers --conditions before-k7,held-k7
    robomme-interference build manifests my-buffers --drop held-k7 --yes
    ```
    """
    from robomme_interference_data.data.dataset import Dataset

    from .manifests import datasets_now, read_planned

    with graceful_interrupt("The datasets are kept"):
        planned = read_planned(buffer_set)
        files = datasets_now(buffer_set, planned)
        queries = {record.episode_id for record in Dataset(files[DEMONSTRATIONS]).records()}
        recorded = None if planned is None else planned.header.datasets.get(DISTRACTORS)
        revision = Dataset(files[DISTRACTORS]).revision
        changed = recorded is not None and recorded.revision != revision
        change = replan(planned, config, queries=queries, units_change=changed)
        _confirm(change, yes=yes)
        _plan(buffer_set, files, change, as_json=as_json)


@app.command()
def questions(buffer_set: _Folder, as_json: AsJson = False) -> None:
    """Make a question about the past for each query, with a marked picture, for `ask` (tabletop).

    Writes questions.parquet.

    Example:
    ```
    robomme-interference build questions my-buffers
    ```
    """
    from robomme_interference_data.data.loading import load_buffer_set
    from robomme_interference_data.runtime.progress import WorkProgress

    from .manifests import check_is_own
    from .questions import make_questions, write_questions

    if not buffer_set.is_dir():
        raise MissingFileError(
            f"there is no folder {buffer_set}",
            "Fetch a buffer set from the Hub first: robomme-interference fetch NAME --to FOLDER",
        )
    with (
        graceful_interrupt("The buffer set is unchanged"),
        WorkProgress(unit="questions") as progress,
    ):
        opened = load_buffer_set(buffer_set)
        check_is_own(opened)
        progress.start("Making questions", len(opened.episode_ids))
        made = []
        for one in make_questions(opened):
            made.append(one)
            progress.advance(1)
        out = write_questions(made, buffer_set)
    if as_json:
        print_json({"out": str(out), "questions": len(made)})
    else:
        print_status(f"{out}: {counted(len(made), 'question')}")


@app.command(name="all")
@with_settings
def build_all(
    config: AllConfig, request: PlanConfig, yes: Yes = False, as_json: AsJson = False
) -> None:
    r"""Build demonstrations, distractors and manifests, and the datasets that conditions need.

    The filters choose the query episodes. Units come from the train episodes of all families, or
    from those of --unit-episodes.

    Examples:
    ```
    robomme-interference build all my-buffers --source robomme-h5:recordings/
    robomme-interference build all my-buffers --source tabletop --split test \
        --conditions no-history,k0,k7,before-k7,held-k7,stale-k0
    ```
    """
    from robomme_interference_data.data.dataset import Dataset
    from robomme_interference_data.storage.files import LocalFiles

    from .manifests import in_folder

    with graceful_interrupt(_KEPT):
        steps, change = plan_all(config, request)
        _confirm(change, yes=yes)
        taken = ", ".join(f"{kind} {len(step.tasks):,}" for kind, step in steps.items())
        print_status(f"Recorded episodes: {taken}")
        for kind, step in steps.items():
            plan = step
            if kind != DEMONSTRATIONS:  # these are built first, so others are compared early
                plan = like(step, Dataset(LocalFiles(config.buffer_set / DEMONSTRATIONS)))
            _build(plan, config.buffer_set / kind, config, as_json=False)
        _plan(config.buffer_set, in_folder(config.buffer_set), change, as_json=as_json)
    print_status(f"Next: robomme-interference verify {config.buffer_set}")


@with_settings
def new_buffer_set(
    config: NewConfig, plan: PlanConfig, yes: Yes = False, as_json: AsJson = False
) -> None:
    r"""Build units and manifests for published demonstrations: a buffer set of your own.

    Units come from the train episodes of the sources, of any robot or simulator with the cameras
    and image sizes of the demonstrations. Ends with an audit, and fails on a leak.

    Examples:
    ```
    robomme-interference new-buffer-set my-buffers --demonstrations namespace/name@data-1.0.0 \
        --source lerobot:NAMESPACE/NAME
    robomme-interference publish my-buffers --repo-id my-name/my-buffers
    robomme-interference new-buffer-set trial --demonstrations my-buffers/demonstrations \
        --source frames:mine/
    ```
    """
    from robomme_interference_data.storage.files import LocalFiles
    from robomme_interference_data.storage.staging import copy_folder

    from .manifests import in_folder

    with graceful_interrupt(_KEPT):
        base, units, change = plan_new(config, plan)
        _confirm(change, yes=yes)
        print_status(f"Demonstrations: {base.files.describe()}; units from {len(units.tasks):,}")
        _build(units, config.buffer_set / DISTRACTORS, config, as_json=False)
        if isinstance(base.files, LocalFiles):
            own = config.buffer_set / DEMONSTRATIONS
            if not own.exists():
                copy_folder(base.files.root, own)
        files = in_folder(config.buffer_set) | {DEMONSTRATIONS: base.files}
        _plan(config.buffer_set, files, change, as_json=as_json)
        audit(str(config.buffer_set))
    print_status(f"Next: robomme-interference publish {config.buffer_set} --repo-id NAMESPACE/NAME")


def _build(plan: BuildPlan, out: Path, workers: WorkersConfig, *, as_json: bool) -> None:
    from robomme_interference_data.runtime.progress import WorkProgress

    from .build import build_dataset

    with WorkProgress(unit="episodes") as progress:
        result = build_dataset(plan, out, make_executor(workers), progress)
    added = f"{result.added} added" if result.added else "nothing to add"
    episodes, frames = counted(result.episodes, "episode"), counted(result.frames, "frame")
    print_status(f"{out}: {added}; {episodes}, {frames}")
    for name, reason in sorted(result.skipped.items())[:_MAX_SKIPPED]:
        print_status(f"  skipped {name}: {reason}")
    if len(result.skipped) > _MAX_SKIPPED:
        print_status(f"  … {len(result.skipped)} skipped in all: {out}/{REPORT_PATH}")
    if as_json:
        print_json({**vars(result), "out": str(result.out)})


def _confirm(change: Replan, *, yes: bool) -> None:
    """Print how the planned buffers change, and ask before any is lost."""
    for line in change.lines():
        print_status(line)
    if change.loses:
        confirm("Replace these planned buffers?", "replacing planned buffers", yes=yes)


def _plan(buffer_set: Path, files: "Mapping[str, Files]", change: Replan, *, as_json: bool) -> None:
    from robomme_interference_data.data.loading import load_buffer_set
    from robomme_interference_data.runtime.progress import WorkProgress

    from .manifests import plan_manifests, write_manifests

    plan = plan_manifests(files, change.conditions, change.seed, change.position_limit)
    with WorkProgress(unit="buffers") as progress:
        total = len(plan.demonstrations) * len(plan.conditions)
        progress.start("Planning buffers", total)
        for done in write_manifests(plan, buffer_set):
            progress.advance(done)
    counts, out = load_buffer_set(buffer_set).header.counts, buffer_set / MANIFESTS
    if as_json:
        changes = {"added": change.added, "dropped": change.dropped, "redrawn": change.redrawn}
        print_json({"out": str(out), **counts, **changes})
    else:
        queries = counted(counts["queries"], "query", "queries")
        print_status(f"{out}: {counted(counts['buffers'], 'buffer')} of {queries}")


def verify(
    buffer_set: BufferSetFolder,
    decode: Annotated[
        bool, typer.Option(help="Also decode all frames and check their hashes (slow).")
    ] = True,
    as_json: AsJson = False,
) -> None:
    """Recompute every hash and rule of a buffer set and list the violations; fails if there is one.

    Example:
    ```
    robomme-interference verify my-buffers
    ```
    """
    from robomme_interference_data.data.loading import load_buffer_set
    from robomme_interference_data.runtime.progress import WorkProgress

    from .verify.buffer_set import verify_buffer_set

    progress = WorkProgress()
    checks = verify_buffer_set(load_buffer_set(buffer_set), decode=decode, progress=progress)
    with progress:
        violations = list(checks)
    if as_json:
        print_json([vars(violation) for violation in violations])
    else:
        for violation in violations:
            echo(f"{violation.where}: {violation.what}")
        what = "hashes and rules" if decode else "files, tables and rules (frames not decoded)"
        found = counted(len(violations), "violation") if violations else ""
        print_status(found or f"All {what} of {buffer_set} hold.")
    if violations:
        raise typer.Exit(1)


def audit(buffer_set: BufferSetFolder, as_json: AsJson = False) -> None:
    """Print how often units are used and at which positions families occur; fails on a leak.

    Example:
    ```
    robomme-interference audit my-buffers
    ```
    """
    from robomme_interference_data.data.loading import load_buffer_set
    from robomme_interference_data.viz.tables import tables_text

    from .verify.audit import audit_buffer_set

    report = audit_buffer_set(load_buffer_set(buffer_set))
    if as_json:
        print_json(report.as_dict())
    else:
        echo(tables_text(report.tables()) + "\n")
        for leak in report.leaks:
            echo(f"LEAK, {leak.kind}: {leak.where}")
        print_status(counted(len(report.leaks), "leak") if report.leaks else "No leaks.")
    if report.leaks:
        raise typer.Exit(1)
