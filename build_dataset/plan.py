"""The plan that follows from the settings of a build."""

import dataclasses
import math
import re
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

from robomme_interference_data.constants import (
    CONTRADICTIONS,
    DEMONSTRATIONS,
    DISTRACTORS,
    EXECUTIONS,
    LESSONS,
    PAPER_UNIT,
    SHIFTED,
    SPLITS,
    UNITS,
    Unit,
)
from robomme_interference_data.errors import BuildError, InvalidOptionError, SourceError, counted
from robomme_interference_data.ids import EpisodeId, format_numbers, parse_numbers
from robomme_interference_data.runtime.executor import make_executor
from robomme_interference_data.schema.conditions import datasets_of

from .alike import Look, in_buffers
from .config import NO_CAMERAS, AllConfig, BuildConfig, NewConfig, PlanConfig
from .plan_checks import check_plans, check_root
from .replan import Replan, replan

if TYPE_CHECKING:
    from robomme_interference_data.data.dataset import Dataset

    from .sources import Source, SourceEpisode


@dataclass(frozen=True)
class BuildPlan:
    """A build with open sources; from a `BuildConfig`, or made directly.

    Attributes:
        kind: Name of the dataset in a buffer set, such as `demonstrations`.
        sources: The sources.
        tasks: The episodes to store: index of the source, and episode.
        cameras: Cameras to store, possibly none of them; None for all.
        codec: Name of the video settings.
        version: Version of the dataset.
        time_limit_s: Limit in seconds for one episode; None for the sources' defaults.
        unit: Size of the distractors' units; of the raw ones, too, by `Unit.of`.
        fps: Frames per second of recordings that do not state them; None if all do.
        like: What the episodes must look like, those of the demonstrations; None for anything.
    """

    kind: str
    sources: "tuple[Source, ...]"
    tasks: "tuple[tuple[int, SourceEpisode], ...]"
    cameras: tuple[str, ...] | None = None
    codec: str = "av1-lossless"
    version: str = "1.0.0"
    time_limit_s: float | None = None
    unit: Unit = PAPER_UNIT
    fps: float | None = None
    like: Look | None = None


def plan_all(config: AllConfig, request: PlanConfig) -> tuple[dict[str, BuildPlan], Replan]:
    """Plan a buffer set's datasets and buffers; checks everything known before frames are read."""
    from .manifests import read_planned

    planned = read_planned(config.buffer_set)
    units = dataclasses.replace(config, families=(), episodes=config.unit_episodes, split="train")
    names = [*datasets_of(replan(planned, request).conditions)]
    if config.shifted:
        names.append(SHIFTED)
    if config.executions:
        names.append(EXECUTIONS)
    plans = {name: plan_build(name, units if name in UNITS else config) for name in names}
    queries = {episode.id for _, episode in plans[DEMONSTRATIONS].tasks}
    return plans, check_plans(queries, plans, config.buffer_set, planned, request)


def plan_new(config: NewConfig, request: PlanConfig) -> "tuple[Dataset, BuildPlan, Replan]":
    """Open published demonstrations, and plan units with their cameras; see `plan_all`."""
    from robomme_interference_data.data.dataset import Dataset
    from robomme_interference_data.storage.files import LocalFiles
    from robomme_interference_data.storage.hub import locate

    from .manifest_checks import check_needs
    from .manifests import in_folder, read_planned

    base = Dataset(locate(config.demonstrations))
    if base.kind != DEMONSTRATIONS:
        raise InvalidOptionError.expected(
            "demonstrations",
            config.demonstrations,
            f"a repository or folder of demonstrations, not of {base.kind}",
            "The card of a published buffer set names the repository of its demonstrations.",
        )
    own = config.buffer_set / DEMONSTRATIONS
    if own.exists() and Dataset(LocalFiles(own)).identity != base.identity:
        raise BuildError(
            f"{own} exists, and is not a copy of {base.files.describe()}",
            "Choose another `buffer_set`, or remove the folder first.",
        )
    planned = read_planned(config.buffer_set)
    check_needs(replan(planned, request).conditions, in_folder(config.buffer_set))
    units = like(plan_build(DISTRACTORS, _with_cameras_of(base, config)), base)
    queries = {record.episode_id for record in base.records()}
    plans = {DISTRACTORS: units}
    return base, units, check_plans(queries, plans, config.buffer_set, planned, request)


def plan_alone(kind: str, config: BuildConfig) -> BuildPlan:
    """Plan one dataset; one of query episodes has those and the cameras of the demonstrations."""
    from robomme_interference_data.data.dataset import Dataset
    from robomme_interference_data.storage.files import LocalFiles

    if kind not in UNITS and Unit(config.unit_frames, config.unit_stride) != PAPER_UNIT:
        raise InvalidOptionError(
            f"`unit_frames` and `unit_stride` have no effect on {kind}", "Leave them out."
        )
    folder = config.buffer_set / DEMONSTRATIONS
    if kind == DEMONSTRATIONS or not folder.is_dir():
        return plan_build(kind, config)
    base = Dataset(LocalFiles(folder))
    if kind in UNITS:
        return like(plan_build(kind, config), base)
    config = _with_cameras_of(base, config)
    queries = None
    if not (config.families or config.split or config.episodes):
        queries = {record.episode_id for record in base.records()}
    return like(plan_build(kind, config, queries), base)


def like(plan: BuildPlan, base: "Dataset") -> BuildPlan:
    """Return a plan of a dataset whose episodes must look like those of the demonstrations."""
    return dataclasses.replace(plan, like=in_buffers(base.features, base.fps))


def _with_cameras_of(base: "Dataset", config: BuildConfig) -> BuildConfig:
    cameras = config.cameras or base.cameras or NO_CAMERAS
    return dataclasses.replace(config, cameras=cameras)


def plan_build(
    kind: str, config: BuildConfig, queries: Container[EpisodeId] | None = None
) -> BuildPlan:
    """Open the sources and plan one dataset, of `queries` or of what `config` chooses."""
    from robomme_interference_data.storage.encode import get_codec

    from .frame_selection import unmarked_error
    from .sources import open_source, takes

    check_root(config.buffer_set)
    get_codec(config.codec)
    if not re.fullmatch(r"\d+\.\d+\.\d+", config.version, re.ASCII):
        raise InvalidOptionError.expected("version", config.version, "a version such as 1.0.0")
    if config.time_limit_s is not None and not config.time_limit_s > 0:
        raise InvalidOptionError.expected("time_limit_s", config.time_limit_s, "a positive number")
    if config.fps is not None and not 0 < config.fps < math.inf:
        raise InvalidOptionError.expected("fps", config.fps, "a positive number")
    for name in ("unit_frames", "unit_stride"):
        if getattr(config, name) < 1:
            raise InvalidOptionError.expected(name, getattr(config, name), "a positive number")
    make_executor(config)  # checks its settings
    numbers = None if config.episodes is None else parse_numbers(config.episodes)
    columns = _columns(config.columns)
    unit = Unit(config.unit_frames, config.unit_stride)
    for name in ("columns", "families_file"):
        if getattr(config, name) and not any(takes(text, name) for text in config.source):
            raise InvalidOptionError(
                f"`{name}` has no effect on {', '.join(config.source)}",
                "Only the source lerobot takes it: leave it out.",
            )
    sources = tuple(
        open_source(
            text,
            shifted=kind == SHIFTED,
            columns=columns,
            families_file=config.families_file,
            robomme_python=config.robomme_python,
            every=unit.of(kind).stride if kind in UNITS else 1,
        )
        for text in config.source
    )
    split = config.split or ("train" if kind in UNITS else None)
    tasks = list_episodes(
        sources, families=config.families, split=split, numbers=numbers, queries=queries
    )
    unmarked = next((one for _, one in tasks if not one.marked), None)
    if kind in (*LESSONS, EXECUTIONS) and unmarked is not None:
        raise unmarked_error().about(unmarked.id)
    if kind == CONTRADICTIONS:
        tasks = tuple((number, sources[number].contradict(one)) for number, one in tasks)
    return BuildPlan(
        kind=kind,
        sources=sources,
        tasks=tasks,
        cameras=() if config.cameras == NO_CAMERAS else tuple(sorted(config.cameras)) or None,
        codec=config.codec,
        version=config.version,
        time_limit_s=config.time_limit_s,
        unit=unit,
        fps=config.fps,
    )


def _columns(texts: Sequence[str]) -> dict[str, str]:
    columns: dict[str, str] = {}
    for text in texts:
        name, _, column = text.partition("=")
        if not name or not column:
            raise InvalidOptionError.expected(
                "columns", text, "NAME=COLUMN, such as front=top_image"
            )
        if name in columns:
            raise InvalidOptionError(
                f"columns names two columns for {name!r}: {columns[name]!r} and {column!r}",
                "Give one.",
                option="columns",
            )
        columns[name] = column
    return columns


def list_episodes(
    sources: "Sequence[Source]",
    *,
    families: Iterable[str] = (),
    split: str | None = None,
    numbers: Iterable[int] | None = None,
    queries: Container[EpisodeId] | None = None,
) -> "tuple[tuple[int, SourceEpisode], ...]":
    """List the episodes of sources that pass all filters, in canonical order."""
    listed = [(number, one) for number, source in enumerate(sources) for one in source.episodes()]
    known = {one.id.family for _, one in listed}
    chosen_families = set(families) or known
    for family in sorted(chosen_families - known):
        raise InvalidOptionError.one_of("families", family, sorted(known))
    if split is not None and split not in SPLITS:
        raise InvalidOptionError.one_of("split", split, SPLITS)
    chosen_indices = None if numbers is None else set(numbers)

    def passes(one: "SourceEpisode") -> bool:
        if queries is not None:
            return one.id in queries
        if one.id.family not in chosen_families or split not in (None, one.id.split):
            return False
        return not one.further if chosen_indices is None else one.id.index in chosen_indices

    chosen = sorted(
        ((number, one) for number, one in listed if passes(one)),
        key=lambda item: item[1].id.sort_key,
    )
    for (first, one), (second, other) in pairwise(chosen):
        if one.id == other.id:
            raise SourceError(
                f"{one.id} is recorded twice (in source {first + 1} and source {second + 1})",
                "Give only one of these sources, or name the episode differently in one of them.",
            )
    if not chosen:
        asked = [split, *sorted(families)]
        if chosen_indices is not None:
            asked.append(f"episodes {format_numbers(sorted(chosen_indices))}")
        wanted = ", ".join(filter(None, asked)) or "a query episode"
        raise SourceError(
            f"no episode of {counted(len(listed), 'recorded episode')} is: {wanted}",
            "Choose others.",
        )
    return tuple(chosen)
