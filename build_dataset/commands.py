"""Commands that make buffer sets and check them: `build …`, `verify`, `audit`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from robomme_interference_data.cli.console import echo, graceful_interrupt, print_json, print_status
from robomme_interference_data.cli.help import App
from robomme_interference_data.cli.options import AsJson, BufferSetFolder, with_settings
from robomme_interference_data.constants import (
    CONTRADICTIONS,
    DEMONSTRATIONS,
    DISTRACTORS,
    MANIFESTS,
    RAW_DISTRACTORS,
    REPORT_PATH,
    SHIFTED,
)
from robomme_interference_data.errors import MissingFileError
from robomme_interference_data.runtime.executor import WorkersConfig, make_executor

from .config import (
    AllConfig,
    BuildConfig,
    BuildPlan,
    NewConfig,
    PlanConfig,
    plan_all,
    plan_build,
    plan_new,
    position_limit,
)

if TYPE_CHECKING:
    from robomme_interference_data.storage.files import Files

app = App(
    help="Build a buffer set's datasets, demonstrations and distractor units first, and manifests.",
    epilog="""Flow: record or download episodes, build the datasets and the manifests, verify.

```
robomme-interference build all my-buffers --source robomme-h5:recordings/
robomme-interference verify my-buffers
robomme-interference show my-buffers MoveCube/train/0 k3 --out strip.png
```

`build all` is these three, with S=my-buffers:

```
robomme-interference build demonstrations $S --source robomme-h5:recordings/
robomme-interference build distractors $S --source robomme-h5:recordings/
robomme-interference build manifests $S --conditions no-history,k0,k1,k3,k7
```
""",
)

_KEPT = "Finished episodes are kept"
_TOLD = 10
"""Episodes that are named when they are left out."""


_DATASETS = {
    DEMONSTRATIONS: r"""Build the query episodes' demonstrations, with the first live observation.

    Stopped with Ctrl-C, or killed, a build goes on where it was when the command is run again. A
    dataset that is there grows by what it lacks.

    Examples:
    ```
    robomme-interference build demonstrations S --source robomme-h5:recordings/ --split test
    robomme-interference build demonstrations S --source tabletop --split test --episodes 0-4 \
        --cameras front
    ```
    """,
    DISTRACTORS: r"""Build distractor units: 32 frames of each episode, raw indices 0, 8, …, 248.

    Episodes of fewer than 249 raw frames yield no unit; they are listed in meta/build_report.json.

    Examples:
    ```
    robomme-interference build distractors S --source lerobot:NAMESPACE/NAME
    robomme-interference build distractors S --source robomme-h5:recordings/ --source frames:mine/ \
        --cameras front
    ```
    """,
    RAW_DISTRACTORS: """Build distractor units at full rate, for raw-k<n>: 256 raw frames each.

    Take the episodes of the distractors: a buffer's units must all be there.

    Example:
    ```
    robomme-interference build distractors-raw S --source tabletop
    ```
    """,
    CONTRADICTIONS: r"""Build contradicting lessons: the same scene, another answer.

    For stale-k<n> and misled-k<n>. Take the query episodes. Only tabletop can play them: elsewhere,
    scene and answer come together.

    Example:
    ```
    robomme-interference build contradictions S --source tabletop --split test --episodes 0-4
    ```
    """,
    SHIFTED: r"""Build what query episodes look like under each shift, for retrieval-score.

    Nine frames of each episode: the first live view under light, camera and clutter, each at
    strengths 1, 2 and 3. Take the query episodes; build manifests and index the buffer set afterwards.

    Example:
    ```
    robomme-interference build shifted S --source tabletop --split test --episodes 0-4
    ```
    """,
}
"""Kind of dataset to the help of the command that builds it."""


def _add_command(kind: str, text: str) -> None:
    @with_settings
    def build(config: BuildConfig, as_json: AsJson = False) -> None:
        with graceful_interrupt(_KEPT):
            _build(plan_build(kind, config), config.buffer_set / kind, config, as_json=as_json)

    app.command(name=kind, help=text)(build)


for _kind, _text in _DATASETS.items():
    _add_command(_kind, _text)


@app.command()
@with_settings
def manifests(
    buffer_set: Annotated[Path, typer.Argument(help="Folder with the datasets.")],
    config: PlanConfig,
    as_json: AsJson = False,
) -> None:
    """Plan the history buffers of all query episodes: the same inputs give the same bytes.

    Example:
    ```
    robomme-interference build manifests my-buffers --conditions no-history,k0,k1,k3,k7 --seed 0
    ```
    """
    with graceful_interrupt("The datasets are kept"):
        _plan(buffer_set, config, as_json=as_json)


@app.command()
def questions(
    buffer_set: Annotated[Path, typer.Argument(help="Folder of the buffer set.")],
    as_json: AsJson = False,
) -> None:
    """Make the questions about the past that `ask` asks: one a query, with a marked picture.

    Only for demonstrations of tabletop, of which the possible answers are known. Rows and pictures
    are in questions.parquet; the same buffer set gives the same bytes.

    Example:
    ```
    robomme-interference build questions my-buffers
    ```
    """
    from robomme_interference_data.data.loading import load_buffer_set
    from robomme_interference_data.runtime.progress import WorkProgress

    from .questions import make_questions, write_questions

    if not buffer_set.is_dir():
        raise MissingFileError(
            f"there is no folder {buffer_set}",
            "A buffer set on the Hub is fetched first: robomme-interference fetch NAME --to FOLDER",
        )
    with (
        graceful_interrupt("The buffer set is as it was"),
        WorkProgress(unit="questions") as progress,
    ):
        opened = load_buffer_set(buffer_set)
        progress.start("Making questions", len(opened.episode_ids))
        made = []
        for one in make_questions(opened):
            made.append(one)
            progress.advance(1)
        out = write_questions(made, buffer_set)
    if as_json:
        print_json({"out": str(out), "questions": len(made)})
    else:
        print_status(f"{out}: {len(made):,} questions")


@app.command(name="all")
@with_settings
def build_all(config: AllConfig, plan: PlanConfig, as_json: AsJson = False) -> None:
    r"""Build demonstrations, distractors and manifests from the same sources.

    Conditions that need further datasets get them.

    Filters choose the query episodes; the units are of all families' train episodes, or of those
    that --unit-episodes names.

    Examples:
    ```
    robomme-interference build all my-buffers --source robomme-h5:recordings/
    robomme-interference build all my-buffers --source tabletop --split test \
        --conditions no-history,k0,k7,before-k7,held-k7,stale-k0
    ```
    """
    with graceful_interrupt(_KEPT):
        steps = plan_all(config, plan)
        taken = " and ".join(f"{kind} of {len(step.tasks):,}" for kind, step in steps.items())
        print_status(f"Recorded episodes to take: {taken}")
        for kind, step in steps.items():
            _build(step, config.buffer_set / kind, config, as_json=False)
        _plan(config.buffer_set, plan, as_json=as_json)
    print_status(f"Next: robomme-interference verify {config.buffer_set}")


@with_settings
def new_buffer_set(config: NewConfig, plan: PlanConfig, as_json: AsJson = False) -> None:
    r"""Build a buffer set of your own for demonstrations that are published: units and manifests.

    The units are of the sources' train episodes, whatever robot or simulator they are of; their
    cameras and sizes must be those of the demonstrations. Ends with an audit; fails on a leak.

    Examples:
    ```
    robomme-interference new-buffer-set my-buffers --demonstrations namespace/name@data-1.0.0 \
        --source lerobot:NAMESPACE/NAME
    robomme-interference publish my-buffers --repo-id my-name/my-buffers
    ```
    """
    with graceful_interrupt(_KEPT):
        base, units = plan_new(config, plan)
        print_status(
            f"Demonstrations: {base.files.describe()}; episodes to take: {len(units.tasks):,}"
        )
        _build(units, config.buffer_set / DISTRACTORS, config, as_json=False)
        _plan(config.buffer_set, plan, as_json=as_json, base=base.files)
        audit(config.buffer_set)
    print_status(f"Next: robomme-interference publish {config.buffer_set} --repo-id NAMESPACE/NAME")


def _build(plan: BuildPlan, out: Path, workers: WorkersConfig, *, as_json: bool) -> None:
    from robomme_interference_data.runtime.progress import WorkProgress

    from .build import build_dataset

    with WorkProgress(unit="episodes") as progress:
        result = build_dataset(plan, out, make_executor(workers), progress)
    done = f"{result.added} added" if result.added else "was built before"
    print_status(f"{out}: {done}; {result.episodes} episodes, {result.frames:,} frames")
    for name, why in sorted(result.skipped.items())[:_TOLD]:
        print_status(f"  left out {name}: {why}")
    if len(result.skipped) > _TOLD:
        print_status(f"  … {len(result.skipped)} left out in all: {out}/{REPORT_PATH}")
    if as_json:
        print_json({**vars(result), "out": str(result.out)})


def _plan(
    buffer_set: Path, config: PlanConfig, *, as_json: bool, base: "Files | None" = None
) -> None:
    from robomme_interference_data.data.loading import load_buffer_set
    from robomme_interference_data.runtime.progress import WorkProgress

    from .manifests import in_folder, plan_manifests, write_manifests

    limit = position_limit(config)
    places = in_folder(buffer_set) | ({} if base is None else {DEMONSTRATIONS: base})
    plan = plan_manifests(places, config.conditions, config.seed, limit)
    with WorkProgress(unit="buffers") as progress:
        total = len(plan.demonstrations) * len(plan.conditions)
        progress.start("Planning buffers", total)
        for done in write_manifests(plan, buffer_set):
            progress.advance(done)
    counts = load_buffer_set(buffer_set).header.counts
    if as_json:
        print_json({"out": str(buffer_set / MANIFESTS), **counts})
    else:
        print_status(
            f"{buffer_set / MANIFESTS}: {counts['buffers']:,} buffers of {counts['queries']:,} queries"
        )


def verify(
    buffer_set: BufferSetFolder,
    decode: Annotated[
        bool, typer.Option(help="Decode all frames; without, files, tables and rules are checked.")
    ] = True,
    as_json: AsJson = False,
) -> None:
    """Recompute every hash and rule of a buffer set and name each violation; fails if there is one.

    Example:
    ```
    robomme-interference verify my-buffers
    ```
    """
    from robomme_interference_data.data.loading import load_buffer_set
    from robomme_interference_data.runtime.progress import WorkProgress

    from .verify import verify_buffer_set

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
        print_status(
            f"{len(violations)} violation{'s' * (len(violations) > 1)}"
            if violations
            else f"All {what} of {buffer_set} hold."
        )
    if violations:
        raise typer.Exit(1)


def audit(
    buffer_set: BufferSetFolder,
    as_json: AsJson = False,
) -> None:
    """Print how often units are used and where families stand; fails on any leak.

    Example:
    ```
    robomme-interference audit my-buffers
    ```
    """
    from robomme_interference_data.data.loading import load_buffer_set
    from robomme_interference_data.viz.tables import tables_text

    from .audit import audit_buffer_set

    report = audit_buffer_set(load_buffer_set(buffer_set))
    if as_json:
        print_json(report.as_dict())
    else:
        echo(tables_text(report.tables()) + "\n")
        for leak in report.leaks:
            echo(f"LEAK, {leak.kind}: {leak.where}")
        print_status(
            f"{len(report.leaks)} leak{'s' * (len(report.leaks) > 1)}"
            if report.leaks
            else "No leaks."
        )
    if report.leaks:
        raise typer.Exit(1)
