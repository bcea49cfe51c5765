"""The command `build`."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from robomme_interference_data.cli.console import (
    confirm,
    graceful_interrupt,
    print_json,
    print_status,
)
from robomme_interference_data.cli.options import AsJson, Yes, with_settings
from robomme_interference_data.constants import DEMONSTRATIONS, MANIFESTS, REPORT_PATH, STATE
from robomme_interference_data.errors import InvalidOptionError, MissingFileError, counted, named
from robomme_interference_data.runtime.executor import make_executor

from .config import QUESTIONS, BuffersConfig, BuildConfig

if TYPE_CHECKING:
    from robomme_interference_data.schema.shard import Shard
    from robomme_interference_data.storage.files import Files

    from .dataset.plan import DatasetPlan
    from .plan.buffers import NextBuffers
    from .plan.parts import BuildPlan

_MAX_SKIPPED = 10
"""Skipped episodes to print."""


@with_settings
def build(
    config: BuildConfig, request: BuffersConfig, yes: Yes = False, as_json: AsJson = False
) -> None:
    r"""Build or extend a buffer set: its datasets, and the buffers that are planned from them.

    Builds demonstrations and distractor units, further datasets that the conditions need, and the
    manifests. The filters choose the query episodes; units come from the train episodes of all
    families, or from those of `--unit-episodes`. After an interruption, re-run the same command to
    resume.

    With `--demonstrations` or `--only distractors`, the filters choose the episodes of the units.
    With `--only` and another dataset, the default is the query episodes of the buffer set. What is
    planned stays planned; to lose planned buffers needs a confirmation.

    Parts: `distractors` have 32 frames per episode, raw indices 0, 8, …, 248; `distractors-raw`
    the first 249 to 256 raw frames, for `raw-k<n>`; `contradictions` the same scenes with
    another answer, for `stale-k<n>` and `misled-k<n>`; `shifted` the first live observations
    under shifts of light, camera, clutter and colors, for `retrieval-score`; `executions` the
    live frames, states and actions that follow each lesson; `questions` multiple-choice questions
    about the past, for `ask`.

    Examples:
    ```
    robomme-interference build my-buffers --source robomme-h5:recordings/
    robomme-interference build my-buffers --source tabletop --split test \
      --conditions no-history,k0,k7,stale-k0 --with executions,questions
    robomme-interference build my-buffers --only distractors \
      --source frames:mine/
    robomme-interference build my-buffers --only manifests \
      --conditions held-k7 --drop k1 --yes
    robomme-interference build my-units --source lerobot:NAMESPACE/NAME \
      --demonstrations namespace/name@data-1.0.0
    ```
    """
    from robomme_interference_data.schema.shard import Shard

    from .plan.parts import plan_build
    from .shards import check_is_no_shard

    shard = Shard.parse(config.shard)
    with graceful_interrupt("Finished episodes are kept"):
        if not shard.is_whole:
            _build_shard(config, request, shard, as_json=as_json)
            return
        check_is_no_shard(config.buffer_set)
        plan = plan_build(config, request)
        if plan.buffers is not None:
            _confirm(plan.buffers, yes=yes)
        built = _carry_out(plan, config, {})
        _report(plan, config.buffer_set, built, as_json=as_json)


def merge_builds(shards: Sequence[Path], out: Path, *, as_json: bool) -> None:
    """Build a buffer set from the episodes that shards have recorded; see the command `merge`."""
    from .dataset.same_simulators import check_same_simulators
    from .plan.parts import plan_build
    from .shards import check_all_staged, claim, read_shards, release, staged_folder

    with graceful_interrupt("The shards are unchanged"):
        record = read_shards(shards)
        claim(out, record)
        config, request = record.configs(out)
        plan = plan_build(config, request)
        staged = {kind: [staged_folder(shard, kind) for shard in shards] for kind in plan.datasets}
        for kind, dataset in plan.datasets.items():
            advice = "such as on a machine that recorded a shard."
            check_same_simulators("the shards", record.sources, dataset.provenances, advice)
            check_all_staged(dataset, staged[kind])
        built = _carry_out(plan, config, staged)
        release(out)
        _report(plan, out, built, as_json=as_json)


def _build_shard(
    config: BuildConfig, request: BuffersConfig, shard: "Shard", *, as_json: bool
) -> None:
    """Record the episodes of a shard."""
    from robomme_interference_data.progress import WorkProgress

    from .dataset.build import stage_dataset
    from .plan.parts import plan_build
    from .shards import recording, staged_folder

    root, results = config.buffer_set, dict[str, Any]()
    plan = plan_build(config, request)
    plans = {kind: dataset.share(shard) for kind, dataset in plan.datasets.items()}
    if not plans:
        raise InvalidOptionError(
            f"{named('shard', str(shard))} has no effect: no episodes are recorded",
            "Leave it out.",
            option="shard",
        )
    with recording(config, request, plan):
        _print_episodes(plans)
        first = None
        for kind, dataset in plans.items():
            # As in a whole build, units must look like the demonstrations.
            planned = dataset if first is None else dataset.matching(first)
            with WorkProgress(unit="episodes") as progress:
                executor = make_executor(config.fitting(dataset.worker_gb))
                stored = stage_dataset(planned, staged_folder(root, kind), executor, progress)
            if kind == DEMONSTRATIONS and stored:
                first = stored[0]
            results[kind] = {"episodes": len(stored)}
            print_status(f"{root}: {counted(len(stored), 'episode')} of the {kind}")
    if as_json:
        print_json({"shard": str(shard), **results})
    print_status(
        "Next, when all shards are built: robomme-interference merge "
        f"{shlex.quote(str(root))} … --out BUFFER_SET"
    )


def _carry_out(
    plan: "BuildPlan", config: BuildConfig, staged: Mapping[str, Sequence[Path]]
) -> dict[str, Any]:
    """Build what is planned; return the results by part.

    `staged` has further folders of staged episodes, by dataset.
    """
    root, results = config.buffer_set, dict[str, Any]()
    if plan.datasets:
        _print_episodes(plan.datasets)
        results |= _build_datasets(plan.datasets, config, staged)
    if plan.manifests and plan.buffers is not None:
        if plan.base is not None:
            _copy_demonstrations(plan.base.files, root)
        results[MANIFESTS] = _plan_buffers(root, plan.files(root), plan.buffers)
    if plan.questions:
        results[QUESTIONS] = _make_questions(root)
    return results


def _report(plan: "BuildPlan", root: Path, results: dict[str, Any], *, as_json: bool) -> None:
    """Print the results and the next command; exit with 1 if the buffers leak."""
    from robomme_interference_data.data.loading import next_build

    leaks = _leaks(root) if plan.datasets and plan.manifests else []
    note = _renderers_note(root) if plan.datasets else None
    if as_json:
        print_json(results)
    if note is not None:
        print_status(f"Warning: {note}")
    for leak in leaks:
        print_status(f"LEAK: {leak}")
    if leaks:
        raise typer.Exit(1)
    if plan.manifests:
        print_status(f"Next: robomme-interference verify {shlex.quote(str(root))} --audit")
    elif plan.datasets:  # the buffers, if there are any, are of the old datasets
        print_status(f"Next: robomme-interference {next_build(root)}")


def _print_episodes(plans: "Mapping[str, DatasetPlan]") -> None:
    counts = (f"{kind} {len(part.episodes):,}" for kind, part in plans.items())
    print_status(f"Recorded episodes: {', '.join(counts)}")


def _confirm(change: "NextBuffers", *, yes: bool) -> None:
    """Print how the planned buffers change, and ask before any is lost."""
    for line in change.lines():
        print_status(line)
    if change.loses:
        confirm("Replace these planned buffers?", "replacing planned buffers", yes=yes)


def _build_datasets(
    plans: "Mapping[str, DatasetPlan]", config: BuildConfig, staged: Mapping[str, Sequence[Path]]
) -> dict[str, Any]:
    from robomme_interference_data.data.dataset import Dataset
    from robomme_interference_data.storage.files import LocalFiles

    root, results = config.buffer_set, {}
    for kind, planned in plans.items():
        dataset = planned
        if kind != DEMONSTRATIONS and DEMONSTRATIONS in plans:
            # They are built first, so that other sizes and rates are found early.
            dataset = planned.matching(Dataset(LocalFiles(root / DEMONSTRATIONS)))
        results[kind] = _build_dataset(dataset, root / kind, config, staged.get(kind, ()))
    return results


def _renderers_note(root: Path) -> str | None:
    """Return what readers must know if the datasets in a folder have different renderers."""
    from robomme_interference_data.data.dataset import Dataset
    from robomme_interference_data.data.loading import built_datasets
    from robomme_interference_data.data.renderers import dataset_renderers
    from robomme_interference_data.schema.renderers import renderers_note
    from robomme_interference_data.storage.files import LocalFiles

    datasets = {name: Dataset(LocalFiles(root / name)) for name in built_datasets(root)}
    return renderers_note(dataset_renderers(datasets).items())


def _build_dataset(
    plan: "DatasetPlan", out: Path, config: BuildConfig, staged: Sequence[Path]
) -> dict[str, Any]:
    from robomme_interference_data.data.dataset import Dataset
    from robomme_interference_data.progress import WorkProgress
    from robomme_interference_data.storage.files import LocalFiles

    from .dataset.build import build_dataset

    with WorkProgress(unit="episodes") as progress:
        executor = make_executor(config.fitting(plan.worker_gb))
        result = build_dataset(plan, out, executor, progress, staged)
    added = f"{result.added} added" if result.added else "nothing to add"
    episodes, frames = counted(result.episodes, "episode"), counted(result.frames, "frame")
    print_status(f"{out}: {added}; {episodes}, {frames}")
    if Dataset(LocalFiles(out)).features[STATE] == (0,):
        print_status("  without robot states: none are recorded, or they were left out")
    for name, reason in sorted(result.skipped.items())[:_MAX_SKIPPED]:
        print_status(f"  skipped {name}: {reason}")
    if len(result.skipped) > _MAX_SKIPPED:
        print_status(f"  … {len(result.skipped)} skipped in all: {out}/{REPORT_PATH}")
    return vars(result) | {"out": str(result.out)}


def _copy_demonstrations(files: "Files", root: Path) -> None:
    """Copy demonstrations from a folder; those on the Hub stay there."""
    from robomme_interference_data.storage.files import LocalFiles
    from robomme_interference_data.storage.staging import copy_folder

    own = root / DEMONSTRATIONS
    if isinstance(files, LocalFiles) and not own.exists():
        copy_folder(files.root, own)


def _plan_buffers(
    root: Path, files: "Mapping[str, Files]", change: "NextBuffers"
) -> dict[str, Any]:
    from robomme_interference_data.data.loading import load_buffer_set
    from robomme_interference_data.progress import WorkProgress

    from .manifests import plan_manifests, write_manifests

    plan = plan_manifests(files, change.conditions, change.seed, change.position_limit)
    with WorkProgress(unit="buffers") as progress:
        progress.start("Planning buffers", len(plan.demonstrations) * len(plan.conditions))
        for done in write_manifests(plan, root):
            progress.advance(done)
    counts, out = load_buffer_set(root).header.counts, root / MANIFESTS
    queries = counted(counts["queries"], "query", "queries")
    print_status(f"{out}: {counted(counts['buffers'], 'buffer')} of {queries}")
    return {
        "out": str(out),
        **counts,
        "added": change.added,
        "dropped": change.dropped,
        "redrawn": change.redrawn,
    }


def _make_questions(root: Path) -> dict[str, Any]:
    from robomme_interference_data.data.loading import load_buffer_set
    from robomme_interference_data.progress import WorkProgress

    from .plan.planned import check_is_own
    from .questions import make_questions, write_questions

    if not root.is_dir():
        raise MissingFileError(
            f"there is no folder {root}",
            "Fetch a buffer set from the Hub first: robomme-interference fetch NAME --to FOLDER",
        )
    with WorkProgress(unit="questions") as progress:
        opened = load_buffer_set(root)
        check_is_own(opened)
        progress.start("Making questions", len(opened.episode_ids))
        made = []
        for question in make_questions(opened):
            made.append(question)
            progress.advance(1)
        out = write_questions(made, root)
    print_status(f"{out}: {counted(len(made), 'question')}")
    return {"out": str(out), "questions": len(made)}


def _leaks(root: Path) -> list[str]:
    """Return what in the buffers reveals more than a distractor may."""
    from robomme_interference_data.data.loading import load_buffer_set

    from .verify.audit import audit_buffer_set

    return [f"{leak.kind}: {leak.where}" for leak in audit_buffer_set(load_buffer_set(root)).leaks]
