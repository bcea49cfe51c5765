"""Build a dataset: stage episodes with an executor, write them with LeRobot, complete, rename.

The output folder is always either absent or complete: everything is made in a hidden folder beside
it and renamed at the end. An interrupted build resumes from its staged episodes. An existing
dataset is extended by the episodes that it lacks; the others are not encoded again.
"""

import os
import shutil
from collections import defaultdict
from collections.abc import Collection, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path

from robomme_interference_data.build_dataset.alike import (
    differ_in_cameras,
    differ_in_image_sizes,
    differences,
    in_buffers,
    in_dataset,
)
from robomme_interference_data.constants import ACTION, INFO_PATH, UNITS
from robomme_interference_data.errors import (
    SAME_FOR_ALL,
    BuildError,
    InterferenceError,
    InvalidOptionError,
    SourceError,
    first_line,
    named,
)
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.runtime.executor import Executor, Outcome
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.storage.staging import replace_folder, staging_dir
from robomme_interference_data.storage.text import canonical_json, read_json
from robomme_interference_data.storage.video.encode import get_codec

from .estimate import BuildEstimate
from .existing import ExistingDataset, open_existing
from .identity import complete_dataset, identity_of
from .lerobot_writer import StoredEpisode, load_lerobot, require_lerobot, write_lerobot
from .plan import DatasetPlan, PlannedEpisode
from .same_simulators import check_staged_simulators
from .stage import StageTask
from .staged import Staged, keep_staged, read_staged, staged_name


@dataclass(frozen=True)
class BuildResult:
    """Result of a build; `skipped` has the episodes that yielded nothing, with the reasons."""

    out: Path
    episodes: int
    frames: int
    added: int
    skipped: dict[str, str] = field(default_factory=dict)


def build_dataset(
    plan: DatasetPlan,
    out: Path,
    executor: Executor,
    progress: WorkProgress,
    staged: Sequence[Path] = (),
) -> BuildResult:
    """Build or extend one of a buffer set's datasets, a LeRobot v3 dataset in the folder `out`.

    Args:
        plan: What to build.
        out: Folder of the dataset.
        executor: Stages the episodes.
        progress: Where progress is shown.
        staged: Further folders with staged episodes, as `stage_dataset` fills them.
    """
    require_lerobot()
    get_codec(plan.codec)
    out = out.resolve()  # a folder cannot be renamed to a link, or "."
    try:
        str(out).encode()
    except UnicodeEncodeError:
        raise InvalidOptionError.expected(
            "buffer_set", str(out), "a path in UTF-8, as LeRobot's writer needs"
        ) from None
    with staging_dir(out) as work:
        existing = open_existing(out, plan)
        stored = list(existing.episodes) if existing else []
        skipped = dict(existing.skipped) if existing else {}
        known = {*skipped, *(str(episode.record.episode_id) for episode in stored)}
        todo = [planned for planned in plan.episodes if str(planned.episode.id) not in known]
        before = len(stored)
        if todo or not existing:
            check_staged_simulators(work, out, plan)
            folders = [work / "episodes", *staged]
            _stage(folders, plan, todo, stored, skipped, executor, progress)
            _write(work, out, plan, existing, stored, skipped, progress)
    frames = sum(episode.record.length for episode in stored)
    return BuildResult(out, len(stored), frames, len(stored) - before, skipped)


def stage_dataset(
    plan: DatasetPlan, folder: Path, executor: Executor, progress: WorkProgress
) -> list[StoredEpisode]:
    """Stage the episodes of a plan in a folder, for a build elsewhere; return those stored."""
    get_codec(plan.codec)
    stored: list[StoredEpisode] = []
    folder.mkdir(parents=True, exist_ok=True)
    _stage([folder], plan, plan.episodes, stored, {}, executor, progress)
    return stored


def _stage(
    folders: Sequence[Path],
    plan: DatasetPlan,
    todo: Sequence[PlannedEpisode],
    stored: list[StoredEpisode],
    skipped: dict[str, str],
    executor: Executor,
    progress: WorkProgress,
) -> None:
    """Stage episodes in the first folder if none has them; add each to `stored` or `skipped`."""
    built = stored[:1]  # of the dataset that is extended; all its episodes are alike
    limit = plan.time_limit_s or max(source.time_limit_s for source in plan.sources)

    def folder(planned: PlannedEpisode) -> Path:
        name = staged_name(plan, planned)
        return next((at / name for at in folders if (at / name).is_dir()), folders[0] / name)

    def take(
        planned: PlannedEpisode, staged: Staged, *, before: bool, node: str | None = None
    ) -> None:
        progress.advance(1, before=before, node=node)
        if staged.skipped is not None:
            skipped[str(staged.episode_id)] = staged.skipped
        else:
            episodes = staged.stored(folder(planned))
            try:
                for episode in episodes:
                    _check_like(episode, plan)
                    for earlier in built:
                        _check_alike(earlier, episode)
            except SourceError:
                if folder(planned).parent == folders[0]:
                    shutil.rmtree(folder(planned))  # no later attempt can use it
                raise
            for episode in episodes:
                stored.append(episode)
                _check_alike(stored[0], episode)

    missing, before = [], len(stored) + len(skipped)
    progress.start("Reading and encoding", len(todo))
    for planned in todo:
        done = read_staged(folder(planned))
        if done is None:
            missing.append(planned)
        else:
            take(planned, done, before=True)
    estimate = BuildEstimate(folders[0].parent, len(missing), executor.workers)
    failures: list[Outcome] = []
    # Closing ends the workers, also after an error.
    with closing(executor.run(StageTask(plan), missing, time_limit=limit)) as outcomes:
        for outcome in outcomes:
            if outcome.error is None:
                keep_staged(folder(outcome.task), outcome.value, outcome.files)
                take(outcome.task, outcome.value, before=False, node=outcome.node)
                estimate.take(folder(outcome.task))
                continue
            failures.append(outcome)
            if isinstance(outcome.error, SAME_FOR_ALL):
                break
    if failures:
        raise _failure(failures, len(todo), some_kept=len(stored) + len(skipped) > before)


def _check_alike(first: StoredEpisode, second: StoredEpisode) -> None:
    """Check that two episodes can be in one dataset."""
    names = [str(episode.record.episode_id) for episode in (first, second)]
    looks = in_dataset(first.look, second.look)
    if found := differences((names[0], looks[0]), (names[1], looks[1])):
        raise SourceError(
            f"{names[0]} and {names[1]} cannot be in one dataset: {'; '.join(found)}",
            f"Choose {named('cameras')} that all have, or build the sources into separate buffer "
            "sets."
            if differ_in_cameras(*looks)
            else "Leave one of them out, or build them into separate buffer sets.",
        )


def _check_like(episode: StoredEpisode, plan: DatasetPlan) -> None:
    """Check that an episode can follow the demonstrations in a buffer."""
    if plan.must_match is None:
        return
    name = str(episode.record.episode_id)
    look = in_buffers(plan.kind, episode.features, episode.fps)
    shared = {
        feature: look.features[feature]
        for feature in plan.must_match.features
        if feature in look.features
    }
    if found := differences(("the demonstrations", plan.must_match), (name, look)):
        hint = "Choose recordings that are alike, or build a separate buffer set of them."
        if not differences(("", plan.must_match), ("", replace(look, features=shared))):
            hint = f"Choose the {named('cameras')} of the demonstrations."
        elif differ_in_image_sizes(plan.must_match, look):
            hint = f"Store frames in the size of the demonstrations with {named('resize')}."
        raise SourceError(
            f"{name} cannot be in a buffer with the demonstrations: {'; '.join(found)}", hint
        )


def _failure(failures: Sequence[Outcome], total: int, *, some_kept: bool) -> InterferenceError:
    """Return the error for failed episodes: each reason once, with its episodes and its hint."""
    error = failures[0].error
    if len(failures) == 1 and isinstance(error, InterferenceError):
        return error
    episodes = defaultdict[tuple[str, str], list[str]](list)
    for outcome in failures:
        _, episode = outcome.task
        reason = first_line(outcome.error).removeprefix(f"{episode.id}: ")  # type: ignore[arg-type]
        if outcome.attempts > 1:
            reason += f" (started {outcome.attempts} times)"
        episodes[reason, getattr(outcome.error, "hint", None) or ""].append(str(episode.id))
    lines = [
        f"  {_some_of(names)}: {reason}" for (reason, _), names in islice(episodes.items(), 10)
    ]
    if len(episodes) > 10:
        lines.append(f"  … and {len(episodes) - 10} more reasons")
    hints = [*dict.fromkeys(hint for _, hint in episodes if hint)][:3]
    if some_kept:
        hints.append("The others are kept.")
    hints.append("Correct these, and run the same command again, or leave them out.")
    failed = "\n".join([f"{len(failures)} of {total} episodes failed:", *lines])
    return BuildError(failed, "\n".join(hints))


def _some_of(names: Sequence[str]) -> str:
    """Return the first three names, and how many more there are."""
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(names[:3]) + more


def _write(
    work: Path,
    out: Path,
    plan: DatasetPlan,
    existing: ExistingDataset | None,
    stored: Sequence[StoredEpisode],
    skipped: dict[str, str],
    progress: WorkProgress,
) -> None:
    """Write the whole dataset in canonical order, and rename it to `out`."""
    if not stored:
        reasons = "; ".join(f"{name}: {why}" for name, why in list(skipped.items())[:5])
        raise SourceError(
            f"no episode yields {plan.kind}: {len(skipped)} unusable ({reasons})",
            f"{named('unit')} allows units of shorter episodes."
            if plan.kind in UNITS
            else "Choose other episodes or sources.",
        )
    ordered = sorted(stored, key=lambda episode: episode.record.episode_id)
    # Actions are stored only if all episodes have them: buffers do not hold them.
    acted = all(ACTION in episode.features for episode in ordered)
    features = {n: s for n, s in ordered[0].features.items() if acted or n != ACTION}
    with progress.status("Loading lerobot"):
        load_lerobot()
    made = work / "dataset"
    shutil.rmtree(made, ignore_errors=True)
    progress.start("Writing the LeRobot dataset", len(ordered))
    for _ in write_lerobot(made, plan.kind, ordered, features, get_codec(plan.codec)):
        progress.advance(1)
    records = [_numbered(episode.record, index, features) for index, episode in enumerate(ordered)]
    provenances = plan.provenances
    provenances += existing.dataset.identity.sources if existing else ()
    sources = [source for _, source in sorted({canonical_json(p): p for p in provenances}.items())]
    info = read_json(made / INFO_PATH)
    identity = identity_of(
        records, info, plan.kind, plan.version, plan.codec, sources, unit=plan.unit
    )
    with progress.status("Hashing"):
        complete_dataset(made, records, identity, skipped)
        if hasattr(os, "sync"):  # not on Windows
            os.sync()
    replace_folder(made, out)


def _numbered(record: EpisodeRecord, index: int, features: Collection[str]) -> EpisodeRecord:
    """Return the record of an episode with this index in a dataset with these features."""
    kept = {name: digest for name, digest in record.feature_sha256.items() if name in features}
    return replace(record, episode_index=index, feature_sha256=kept)
