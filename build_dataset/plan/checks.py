"""Checks before a build: its folder, units that suffice, planned buffers that would change."""

from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path

from robomme_interference_data.build_dataset.config import BuffersConfig
from robomme_interference_data.build_dataset.dataset.existing import ExistingDataset, open_existing
from robomme_interference_data.build_dataset.dataset.plan import DatasetPlan
from robomme_interference_data.build_dataset.manifests import check_manifests_folder
from robomme_interference_data.constants import (
    DATASETS,
    DEMONSTRATIONS,
    DISTRACTORS,
    IDENTITY_PATH,
    MANIFESTS,
    MAX_K,
    SHARD_PATH,
)
from robomme_interference_data.data.loading import next_build
from robomme_interference_data.errors import BuildError, MissingFileError, named
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.draw import UnitPool, check_units
from robomme_interference_data.storage.files import Files, LocalFiles
from robomme_interference_data.storage.staging import staging_path

from .buffers import NextBuffers, next_buffers
from .planned import PlannedBuffers, read_planned


def check_root(root: Path) -> None:
    """Check that a folder is absent, empty or, as far as a build has come, a buffer set."""
    if root.exists() and not root.is_dir():
        raise BuildError(f"{root} is a file", f"Choose another {named('buffer_set')}.")
    if (root / SHARD_PATH).is_file():  # a shard of a build, or what shards are merged into
        return
    parts = [root / name for name in (*DATASETS, MANIFESTS)]
    if not root.exists() or any(path.exists() or staging_path(path).exists() for path in parts):
        return
    if strangers := sorted(path.name for path in root.iterdir() if not path.name.startswith(".")):
        raise BuildError(
            f"{root} holds {strangers[0]}, and nothing of a buffer set",
            f"Choose a new or empty folder as {named('buffer_set')}.",
        )


def check_built(root: Path, files: Mapping[str, Files]) -> None:
    """Check that the datasets exist that all manifests need.

    Raises:
        MissingFileError: One does not: its build has not begun, or has not finished.
    """
    for name in (DEMONSTRATIONS, DISTRACTORS):
        dataset = files[name]
        if not isinstance(dataset, LocalFiles) or (dataset.root / IDENTITY_PATH).is_file():
            continue
        if staging_path(root / name).is_dir():
            raise MissingFileError(
                f"the build of the {name} of {root} has not finished",
                "Run the command that began it again, to resume it.",
            )
        raise MissingFileError(
            f"{root} has no {name}, which buffers are planned from",
            "Build them first.",
            next_build(root),
        )


def plan_more_units(units: DatasetPlan, root: Path) -> NextBuffers | None:
    """Return how further units would change the buffers that are planned; None if none are."""
    planned = read_planned(root)
    if planned is None:
        return None
    existing = open_existing(root.resolve() / DISTRACTORS, units)
    return next_buffers(planned, BuffersConfig(), units_change=_adds_episodes(units, existing))


def check_plans(
    queries: set[EpisodeId],
    plans: dict[str, DatasetPlan],
    root: Path,
    planned: PlannedBuffers | None,
    request: BuffersConfig,
    absent: Collection[EpisodeId] = (),
    days: Mapping[EpisodeId, EpisodeId] | None = None,
) -> NextBuffers:
    """Check that datasets can be built or extended, and that units suffice; return the buffers.

    `absent` are the query episodes whose lesson is never shown, `days` those of queries of days.
    """
    existing = {kind: open_existing(root.resolve() / kind, plan) for kind, plan in plans.items()}
    demonstrations = existing.get(DEMONSTRATIONS)
    if demonstrations is not None:
        queries = queries | demonstrations.ids
    units, built = plans[DISTRACTORS], existing[DISTRACTORS]
    adds_units = _adds_episodes(units, built)
    following = next_buffers(planned, request, queries=queries, units_change=adds_units)
    # As many as the episodes may yield: how long they are is known only when they are read.
    most = min(units.unit.per_episode, MAX_K)
    available = {replace(unit.episode.id, start=n) for unit in units.episodes for n in range(most)}
    if built is not None:
        available |= built.ids
    _check_units(available, queries, following, absent, days or {})
    check_manifests_folder(root)
    return following


def _check_units(
    available: Collection[EpisodeId],
    queries: Collection[EpisodeId],
    following: NextBuffers,
    absent: Collection[EpisodeId],
    days: Mapping[EpisodeId, EpisodeId],
) -> None:
    conditions, limit = following.conditions, following.position_limit
    try:
        check_units(UnitPool(available), queries, conditions, absent, days, limit)
    except BuildError as error:
        splits = {query.split for query in queries}
        if not {"train", "test"} <= splits:
            raise
        # Whether they have a demonstration is known only when they are read.
        hint = f"If train episodes are for units alone, set {named('split', 'test')}."
        raise BuildError(error.message, f"{error.hint} {hint}") from None


def _adds_episodes(plan: DatasetPlan, existing: ExistingDataset | None) -> bool:
    """Return whether a dataset lacks episodes that are to be built."""
    if existing is None:
        return True
    known = {*existing.skipped, *map(str, existing.ids)}
    return any(str(planned.episode.id) not in known for planned in plan.episodes)
