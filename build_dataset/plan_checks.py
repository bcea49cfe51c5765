"""Checks before a build: its folder, units that suffice, planned buffers that would change."""

from pathlib import Path
from typing import TYPE_CHECKING

from robomme_interference_data.constants import DATASETS, DEMONSTRATIONS, DISTRACTORS, MANIFESTS
from robomme_interference_data.errors import BuildError
from robomme_interference_data.ids import EpisodeId

from .config import PlanConfig
from .replan import Planned, Replan, replan

if TYPE_CHECKING:
    from .existing import ExistingDataset
    from .plan import BuildPlan


def check_root(root: Path) -> None:
    """Check that a folder is absent, empty or, as far as a build has come, a buffer set."""
    from robomme_interference_data.storage.staging import staging_path

    if root.exists() and not root.is_dir():
        raise BuildError(f"{root} is a file", "Choose another `buffer_set`.")
    known = [root / name for name in (*DATASETS, MANIFESTS)]
    if not root.exists() or any(path.exists() or staging_path(path).exists() for path in known):
        return
    if other := sorted(path.name for path in root.iterdir() if not path.name.startswith(".")):
        raise BuildError(
            f"{root} holds {other[0]}, and nothing of a buffer set",
            "Choose a new or empty folder as `buffer_set`.",
        )


def plan_more_units(units: "BuildPlan", root: Path) -> Replan | None:
    """Return how further units would change the buffers that are planned; None if none are."""
    from .existing import open_existing
    from .manifests import read_planned

    planned = read_planned(root)
    if planned is None:
        return None
    existing = open_existing(root.resolve() / DISTRACTORS, units)
    return replan(planned, PlanConfig(), units_change=_adds_episodes(units, existing))


def check_plans(
    queries: set[EpisodeId],
    plans: "dict[str, BuildPlan]",
    root: Path,
    planned: Planned | None,
    request: PlanConfig,
) -> Replan:
    """Check that datasets can be built or extended, and that units suffice; return the plan."""
    from robomme_interference_data.schema.draw import UnitPool, check_units

    from .existing import open_existing
    from .manifests import check_manifests_folder

    existing = {kind: open_existing(root.resolve() / kind, one) for kind, one in plans.items()}
    if (base := existing.get(DEMONSTRATIONS)) is not None:
        queries = queries | base.ids
    units, built = plans[DISTRACTORS], existing[DISTRACTORS]
    following = replan(planned, request, queries=queries, units_change=_adds_episodes(units, built))
    available = {episode.id for _, episode in units.tasks}
    pool = UnitPool(available if built is None else available | built.ids)
    check_units(pool, queries, following.conditions)
    check_manifests_folder(root)
    return following


def _adds_episodes(plan: "BuildPlan", existing: "ExistingDataset | None") -> bool:
    """Return whether a dataset lacks episodes that are to be built."""
    if existing is None:
        return True
    known = {*existing.skipped, *map(str, existing.ids)}
    return any(str(episode.id) not in known for _, episode in plan.tasks)
