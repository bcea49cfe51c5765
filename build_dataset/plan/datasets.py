"""The plan of one dataset, given the settings of its build."""

import math
import re
import shlex
from collections.abc import Container, Sequence

from robomme_interference_data.build_dataset.config import (
    NO_CAMERAS,
    BuildConfig,
    chosen_cameras,
    parse_unit,
)
from robomme_interference_data.build_dataset.dataset.frame_selection import unmarked_error
from robomme_interference_data.build_dataset.dataset.plan import DatasetPlan, PlannedEpisode
from robomme_interference_data.build_dataset.dataset.resize import Resize
from robomme_interference_data.build_dataset.sources import Source, open_source, takes
from robomme_interference_data.constants import (
    CONTRADICTIONS,
    DAYS,
    EXECUTIONS,
    LESSONS,
    SHIFTED,
    UNITS,
    Unit,
)
from robomme_interference_data.errors import InvalidOptionError, named
from robomme_interference_data.ids import EpisodeId, parse_numbers
from robomme_interference_data.runtime.executor import make_executor
from robomme_interference_data.storage.video.encode import get_codec

from .checks import check_root
from .episodes import choose_episodes


def plan_dataset(
    kind: str, config: BuildConfig, queries: Container[EpisodeId] | None = None
) -> DatasetPlan:
    """Open the sources and plan one dataset, of `queries` or of the episodes that are chosen."""
    check_root(config.buffer_set)
    check_values(config)
    unit = parse_unit(config.unit, config.units_per_episode)
    split = config.split
    if kind in UNITS:
        _check_split_of_units(config)
        split = "train"
    if kind == DAYS:
        _check_days(config.source)
    sources = open_sources(kind, config, unit)
    episodes = choose_episodes(
        sources,
        families=() if kind == DAYS else config.families,  # of the queries
        split=split,
        numbers=None if config.episodes is None else parse_numbers(config.episodes),
        queries=queries,
    )
    if kind in (*LESSONS, EXECUTIONS):
        for planned in episodes:
            if not planned.episode.marked:
                raise unmarked_error().about(planned.episode.id)
    if kind == CONTRADICTIONS:
        episodes = tuple(
            PlannedEpisode(number, sources[number].contradict(episode))
            for number, episode in episodes
        )
    return DatasetPlan(
        kind=kind,
        sources=sources,
        episodes=episodes,
        cameras=chosen_cameras(config.cameras),
        codec=config.codec,
        version=config.version,
        time_limit_s=config.time_limit_s,
        unit=unit,
        fps=config.fps,
        resize=None if config.resize is None else Resize.parse(config.resize),
    )


def _check_days(sources: Sequence[str]) -> None:
    """Check that sources record days, and not single episodes."""
    for text in sources:
        if not takes(text, "kind"):
            raise InvalidOptionError(
                f"the source {text} has no days",
                f"Use tabletop-day, or choose other {named('conditions')}.",
                option="source",
            )


def _check_split_of_units(config: BuildConfig) -> None:
    """Check that units are of train episodes: no query's scene may be in another buffer."""
    if config.split in (None, "train"):
        return
    command = ["build", str(config.buffer_set)]
    if config.only is not None:
        command += ["--only", config.only]
    if config.demonstrations is not None:
        command += ["--demonstrations", config.demonstrations]
    for source in config.source:
        command += ["--source", source]
    raise InvalidOptionError(
        f"{named('split', config.split)}: distractor units must come from train episodes, so that "
        "no query's scene leaks into another buffer",
        f"Leave out {named('split')}.",
        shlex.join(command),
        "split",
    )


def check_values(config: BuildConfig) -> None:
    """Check the settings of a build that are wrong by themselves."""
    get_codec(config.codec)
    if not re.fullmatch(r"\d+\.\d+\.\d+", config.version, re.ASCII):
        raise InvalidOptionError.expected("version", config.version, "a version such as 1.0.0")
    if config.time_limit_s is not None and not config.time_limit_s > 0:
        raise InvalidOptionError.expected("time_limit_s", config.time_limit_s, "a positive number")
    if config.resize is not None:
        Resize.parse(config.resize)
        if config.cameras == NO_CAMERAS:
            raise InvalidOptionError(
                f"{named('resize')} has no effect without cameras",
                f"Leave it out, or choose {named('cameras')}.",
                option="resize",
            )
    if config.fps is not None and not 0 < config.fps < math.inf:
        raise InvalidOptionError.expected("fps", config.fps, "a positive number")
    make_executor(config.fitting(0))  # checks its settings
    for names, takers in (
        (("columns", "families_from", "several_tasks"), "the source lerobot takes"),
        (("simulator_python", "simulator_options"), "simulators take"),
    ):
        for name in names:
            if getattr(config, name) and not any(takes(text, name) for text in config.source):
                raise InvalidOptionError(
                    f"{named(name)} has no effect on {', '.join(config.source)}",
                    f"Only {takers} it: leave it out.",
                    option=name,
                )


def open_sources(kind: str, config: BuildConfig, unit: Unit) -> tuple[Source, ...]:
    """Open the sources of a build, for one of its datasets."""
    columns = _columns(config.columns)
    # A simulator draws only the frames that a unit stores, if the first one is frame 0.
    one_unit = kind in UNITS and unit.per_episode == 1
    return tuple(
        open_source(
            text,
            kind=kind,
            shifted=kind == SHIFTED,
            columns=columns,
            families_from=config.families_from,
            several_tasks=config.several_tasks,
            simulator_python=config.simulator_python,
            simulator_options=config.simulator_options,
            every=unit.in_dataset(kind).stride if one_unit else 1,
        )
        for text in config.source
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
                f"{named('columns')} names two columns for {name!r}: {columns[name]!r} and "
                f"{column!r}",
                "Give one.",
                option="columns",
            )
        columns[name] = column
    return columns
