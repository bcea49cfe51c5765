"""What a build builds, given its settings: which parts of a buffer set, each from which episodes.

Everything that can be known before a frame is read is checked here.
"""

import shlex
from collections.abc import Container
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

from robomme_interference_data.build_dataset.config import (
    FURTHER_PARTS,
    NO_CAMERAS,
    PARTS,
    QUESTIONS,
    BuffersConfig,
    BuildConfig,
    parse_unit,
)
from robomme_interference_data.build_dataset.dataset.plan import DatasetPlan
from robomme_interference_data.build_dataset.manifest_checks import check_needs
from robomme_interference_data.constants import (
    DATASETS,
    DAYS,
    DEMONSTRATIONS,
    DISTRACTORS,
    MANIFEST_PATH,
    MANIFESTS,
    PAPER_UNIT,
    UNITS,
)
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.errors import BuildError, InvalidOptionError, named
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.runtime.executor import WorkersConfig
from robomme_interference_data.schema.conditions import datasets_of
from robomme_interference_data.schema.settings import changed_settings
from robomme_interference_data.storage.files import Files, LocalFiles
from robomme_interference_data.storage.hub import locate

from .buffers import NextBuffers, next_buffers
from .checks import check_built, check_plans, plan_more_units
from .datasets import plan_dataset
from .planned import datasets_in, datasets_of_planned, read_planned

_SOURCELESS = (MANIFESTS, QUESTIONS)
"""Parts that follow from the datasets."""


@dataclass(frozen=True)
class BuildPlan:
    """What a build builds.

    Attributes:
        datasets: The datasets to build or extend by name, in their order.
        buffers: How the planned buffers change, or would change when they are planned again; None
            if nothing of them changes.
        manifests: Whether the manifests are written.
        questions: Whether the questions are made.
        base: Demonstrations that exist, on the Hub or in a folder; None if they are built, too.
    """

    datasets: dict[str, DatasetPlan] = field(default_factory=dict)
    buffers: NextBuffers | None = None
    manifests: bool = False
    questions: bool = False
    base: Dataset | None = None

    def files(self, root: Path) -> dict[str, Files]:
        """Return the datasets of the buffer set after the build, by name."""
        files = datasets_in(root)
        if self.base is not None:
            files[DEMONSTRATIONS] = self.base.files
        return files


def plan_build(config: BuildConfig, request: BuffersConfig) -> BuildPlan:
    """Plan a build.

    Raises:
        InvalidOptionError: A setting has a value that is not allowed, or no effect.
        BuildError: The folder holds something else, or the units do not suffice.
        SourceError: The sources lack what is needed.
    """
    for part in config.parts:
        if part not in FURTHER_PARTS:
            raise InvalidOptionError.one_of("parts", part, FURTHER_PARTS)
    if config.only is None:
        if _is_for_buffers_alone(config, request):
            return _plan_manifests(config.buffer_set, request)
        _require_source(config, "a buffer set")
        return _plan_whole(config, request)
    if config.only not in PARTS:
        raise InvalidOptionError.one_of("only", config.only, PARTS)
    if config.only in _SOURCELESS:
        _check_unset(config, config.only, ("buffer_set", "only"))
    else:
        _require_source(config, f"the {config.only}")
        for name in ("parts", "demonstrations"):
            if getattr(config, name):
                raise _no_effect(name, config.only)
    if config.only == MANIFESTS:
        return _plan_manifests(config.buffer_set, request)
    _check_unset(request, config.only, ())
    if config.only == QUESTIONS:
        return BuildPlan(questions=True)
    plan = plan_alone(config.only, config)
    more_units = plan_more_units(plan, config.buffer_set) if config.only == DISTRACTORS else None
    return BuildPlan({config.only: plan}, more_units)


def _is_for_buffers_alone(config: BuildConfig, request: BuffersConfig) -> bool:
    """Return whether a request changes only which buffers of an existing set are planned."""
    planned = (config.buffer_set / MANIFEST_PATH).is_file()
    used = ["buffer_set", *(setting.name for setting in fields(WorkersConfig))]
    changes = bool(changed_settings(request)) and not changed_settings(config, used)
    return planned and changes


def _require_source(config: BuildConfig, what: str) -> None:
    if config.source:
        return
    hint = "Such as tabletop, which needs no recordings, or lerobot:NAMESPACE/NAME."
    command = None
    if config.only is None and (config.buffer_set / MANIFEST_PATH).is_file():
        hint += " To plan the buffers of the existing datasets again:"
        command = shlex.join(["build", str(config.buffer_set), "--only", MANIFESTS])
    raise InvalidOptionError(
        f"{named('source')} is missing: {what} is built from recorded episodes",
        hint,
        command,
        "source",
    )


def _check_unset(config: BuildConfig | BuffersConfig, part: str, used: Container[str]) -> None:
    """Check that settings which do not matter for a part are left out."""
    for name in changed_settings(config, used):
        raise _no_effect(name, part)


def _no_effect(setting: str, part: str) -> InvalidOptionError:
    message = f"{named(setting)} has no effect on the {part} alone"
    return InvalidOptionError(message, f"Leave it out, or leave out {named('only')}.")


def _plan_whole(config: BuildConfig, request: BuffersConfig) -> BuildPlan:
    root = config.buffer_set
    planned = read_planned(root)
    base = None
    if config.demonstrations is not None:
        base = _published(config.demonstrations, root)
    elif planned is not None and not (root / DEMONSTRATIONS).is_dir():
        published = planned.published_demonstrations
        base = None if published is None else Dataset(published)
    needed = datasets_of(next_buffers(planned, request).conditions)
    further = [name for name in config.parts if name in DATASETS and name not in needed]
    if base is None:
        names = [*needed, *further]
        queries = absent = set[EpisodeId]()
    else:
        # The sources are those of the units: what needs the scenes of the demonstrations is built
        # by its name.
        names = [name for name in needed if name in UNITS] + further
        queries = {record.episode_id for record in base.records()}
        absent = {record.episode_id for record in base.records() if record.ability == "absent"}
        available = {*datasets_in(root), *names}
        check_needs(next_buffers(planned, request).conditions, available, root)
    units = _settings_of_units(config, alone=base is not None)
    plans = {}
    for name in names:
        if name in UNITS:
            plans[name] = plan_dataset(name, _with_cameras_of(base, units))
        elif base is None:
            plans[name] = plan_dataset(name, config)
        else:
            plans[name] = plan_dataset(name, _with_cameras_of(base, config), queries)
        if base is not None:
            plans[name] = plans[name].matching(base)
    days = {}
    if base is None:
        chosen = [query.episode for query in plans[DEMONSTRATIONS].episodes]
        queries = {episode.id for episode in chosen}
        absent = {episode.id for episode in chosen if episode.ability == "absent"}
        days = {episode.id: episode.day for episode in chosen if episode.day is not None}
    change = check_plans(queries, plans, root, planned, request, absent, days)
    return BuildPlan(plans, change, True, QUESTIONS in config.parts, base)


def _plan_manifests(root: Path, request: BuffersConfig) -> BuildPlan:
    planned = read_planned(root)
    files = datasets_of_planned(root, planned)
    check_built(root, files)
    base = Dataset(files[DEMONSTRATIONS])
    queries = {record.episode_id for record in base.records()}
    recorded = None if planned is None else planned.header.datasets.get(DISTRACTORS)
    revision = Dataset(files[DISTRACTORS]).revision
    changed = recorded is not None and recorded.revision != revision
    change = next_buffers(planned, request, queries=queries, units_change=changed)
    check_needs(change.conditions, files, root)
    return BuildPlan(buffers=change, manifests=True, base=base)


def plan_alone(kind: str, config: BuildConfig) -> DatasetPlan:
    """Plan one dataset beside the demonstrations of the folder, if there are any.

    It has their cameras, unless others are chosen, and that of query episodes also their episodes.
    """
    if kind not in UNITS:
        unit = parse_unit(config.unit, config.units_per_episode)
        if unit != PAPER_UNIT:
            option = "unit" if unit.per_episode == 1 else "units_per_episode"
            raise InvalidOptionError(
                f"{named(option)} has no effect on {kind}", "Leave it out.", option=option
            )
    if kind in UNITS:
        config = _settings_of_units(config, alone=True)
    elif config.unit_episodes is not None:
        raise _no_effect("unit_episodes", kind)
    folder = config.buffer_set / DEMONSTRATIONS
    if kind == DEMONSTRATIONS or not folder.is_dir():
        return plan_dataset(kind, config)
    base = Dataset(LocalFiles(folder))
    config = _with_cameras_of(base, config)
    queries = None
    if kind not in (*UNITS, DAYS) and not (config.families or config.split or config.episodes):
        queries = {record.episode_id for record in base.records()}
    return plan_dataset(kind, config, queries).matching(base)


def _settings_of_units(config: BuildConfig, *, alone: bool) -> BuildConfig:
    """Return the settings with filters of units; those of units alone are not of queries."""
    if not alone:
        return replace(config, families=(), split="train", episodes=config.unit_episodes)
    if config.episodes is not None and config.unit_episodes is not None:
        raise InvalidOptionError(
            f"{named('episodes')} and {named('unit_episodes')} both choose the episodes of units",
            "Set one of them.",
            option="unit_episodes",
        )
    return replace(config, episodes=config.episodes or config.unit_episodes)


def _with_cameras_of(base: Dataset | None, config: BuildConfig) -> BuildConfig:
    if base is None or config.cameras:
        return config
    return replace(config, cameras=base.cameras or NO_CAMERAS)


def _published(name: str, root: Path) -> Dataset:
    """Open demonstrations from the Hub or a folder, of which the buffer set gets a copy."""
    base = Dataset(locate(name))
    if base.kind != DEMONSTRATIONS:
        raise InvalidOptionError.expected(
            "demonstrations",
            name,
            f"a repository or folder of demonstrations, not of {base.kind}",
            "The card of a published buffer set names the repository of its demonstrations.",
        )
    own = root / DEMONSTRATIONS
    if own.exists() and Dataset(LocalFiles(own)).identity != base.identity:
        raise BuildError(
            f"{own} exists, and is not a copy of {base.files.describe()}",
            f"Choose another {named('buffer_set')}, or remove the folder first.",
        )
    return base
