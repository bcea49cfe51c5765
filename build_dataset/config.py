"""What is asked of a build: its settings, and the plan that follows from them."""

import dataclasses
import os
from collections.abc import Iterable, Sequence
from dataclasses import KW_ONLY, dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from robomme_interference_data.constants import (
    CONTRADICTIONS,
    DEMONSTRATIONS,
    DISTRACTORS,
    POSITION_LIMIT,
    SHIFTED,
    SPLITS,
    UNIT_FRAMES,
    UNITS,
)
from robomme_interference_data.errors import InvalidOptionError, SourceError
from robomme_interference_data.ids import EpisodeId, parse_numbers
from robomme_interference_data.runtime.executor import WorkersConfig, make_executor
from robomme_interference_data.schema.conditions import DEFAULT_CONDITIONS, datasets_of, in_order
from robomme_interference_data.schema.manifest import SessionEntry
from robomme_interference_data.schema.settings import setting

if TYPE_CHECKING:
    from robomme_interference_data.data.dataset import Dataset
    from robomme_interference_data.schema.draw import UnitPool

    from .sources import Source, SourceEpisode

_CPUS = os.cpu_count() or 1


@dataclass(frozen=True)
class BuildConfig(WorkersConfig):
    """What to build of which recordings, and how."""

    source: tuple[str, ...] = setting(
        whole=True,
        metavar="SOURCE",
        help="robomme-h5:FOLDER, lerobot:FOLDER, lerobot:NAMESPACE/NAME[@REVISION], frames:FOLDER, "
        "tabletop, robomme (demonstrations only) or sample[:FAMILY,…]; repeated for several.",
    )
    buffer_set: Path = setting(
        name="-", metavar="BUFFER_SET", help="Folder of the buffer set to create or extend."
    )
    families: tuple[str, ...] = setting((), help="Families to take; all by default.")
    split: str | None = setting(None, help="Only train, val or test.", shown="units: train")
    episodes: str | None = setting(None, help="Numbers to take, such as 0-49 or 0,3,10-12.")
    cameras: tuple[str, ...] = setting((), help="Cameras to store, such as front; default: all.")
    codec: str = setting(
        "av1-lossless", help="av1-lossless (bit-exact) or lerobot-default (smaller, lossy)."
    )
    version: str = setting("1.0.0", help="Version that the dataset carries.")
    time_limit: float | None = setting(
        None,
        help="Seconds that one episode may take before it is tried once more.",
        shown="300 on tabletop and sample, else 1800",
    )
    columns: tuple[str, ...] = setting(
        (), metavar="NAME=COLUMN,…", help="lerobot sources: where columns are named otherwise."
    )
    families_file: Path | None = setting(
        None, help="lerobot sources: file that names each episode's family."
    )
    robomme_python: str | None = setting(
        None, help="Source robomme: interpreter that has RoboMME.", env="ROBOMME_PYTHON"
    )
    _: KW_ONLY
    workers: int = setting(_CPUS, help="Worker processes.", shown="all processors")


@dataclass(frozen=True)
class AllConfig(BuildConfig):
    """What to build a whole buffer set of."""

    unit_episodes: str | None = setting(
        None, help="Numbers of the train episodes that give units, such as 0-3; default: all."
    )
    shifted: bool = setting(
        False, help="Also what query episodes look like under each shift (tabletop)."
    )


@dataclass(frozen=True, kw_only=True)
class NewConfig(BuildConfig):
    """What to build a buffer set of for demonstrations that are published."""

    demonstrations: str = setting(
        metavar="NAME", help="Repository of the demonstrations, namespace/name[@REVISION]."
    )


@dataclass(frozen=True)
class PlanConfig:
    """Which buffers to plan."""

    conditions: tuple[str, ...] = setting(
        DEFAULT_CONDITIONS,
        help="Conditions to plan buffers for, such as no-history,k0,k7,before-k7; all kinds: "
        "robomme-interference conditions.",
    )
    seed: int = setting(0, help="Seed of the draw.")
    position_limit: str = setting(
        str(POSITION_LIMIT), help="Positions that systems hold for history and rollout, or none."
    )


@dataclass(frozen=True)
class BuildPlan:
    """A `BuildConfig` whose sources are open; or made without one.

    Attributes:
        kind: Name of the dataset in a buffer set, such as `demonstrations`.
        sources: Where to read.
        tasks: The episodes to store: number of the source, and episode.
        cameras: Cameras to store; None for all.
        codec: Name of the video settings.
        version: Version of the dataset.
        time_limit: Seconds that one episode may take; None for the sources' own.
    """

    kind: str
    sources: "tuple[Source, ...]"
    tasks: "tuple[tuple[int, SourceEpisode], ...]"
    cameras: tuple[str, ...] | None = None
    codec: str = "av1-lossless"
    version: str = "1.0.0"
    time_limit: float | None = None


def plan_all(config: AllConfig, plan: PlanConfig) -> dict[str, BuildPlan]:
    """Plan the datasets of a buffer set, and check all that can be known before anything is read."""
    every = dataclasses.replace(config, families=(), episodes=config.unit_episodes, split="train")
    names = [*datasets_of(in_order(plan.conditions)), *[SHIFTED] * config.shifted]
    plans = {name: plan_build(name, every if name in UNITS else config) for name in names}
    queries = (episode.id for _, episode in plans[DEMONSTRATIONS].tasks)
    _check_plans(queries, plans, config.buffer_set, plan)
    return plans


def plan_new(config: NewConfig, plan: PlanConfig) -> "tuple[Dataset, BuildPlan]":
    """Open published demonstrations, and plan units for them; see `plan_all`.

    The units have the cameras of the demonstrations, unless some are asked for.
    """
    from robomme_interference_data.data.dataset import Dataset
    from robomme_interference_data.storage.hub import HubFiles, locate

    from .manifests import check_needs, in_folder

    base = Dataset(locate(config.demonstrations))
    if not isinstance(base.files, HubFiles) or base.kind != DEMONSTRATIONS:
        raise InvalidOptionError.expected(
            "demonstrations",
            config.demonstrations,
            "demonstrations that are published",
            "A published buffer set's card names the repository of its demonstrations. For "
            "demonstrations in a folder, build distractors and manifests beside it.",
        )
    check_needs(in_order(plan.conditions), in_folder(config.buffer_set))
    cameras = config.cameras or base.cameras
    units = plan_build(DISTRACTORS, dataclasses.replace(config, cameras=cameras))
    queries = (record.episode_id for record in base.records())
    _check_plans(queries, {DISTRACTORS: units}, config.buffer_set, plan)
    return base, units


def _check_plans(
    queries: Iterable[EpisodeId], plans: dict[str, BuildPlan], out: Path, plan: PlanConfig
) -> None:
    from robomme_interference_data.schema.draw import UnitPool

    from .existing import open_existing
    from .manifests import check_place

    conditions = in_order(plan.conditions)
    position_limit(plan)
    pool = UnitPool(episode.id for _, episode in plans[DISTRACTORS].tasks)
    for query in {one.family: one for one in queries}.values():
        for condition in conditions:
            condition.sessions(_Unread(query, pool))
    for kind, one in plans.items():
        open_existing(out.resolve() / kind, one)
    check_place(out)


@dataclass(frozen=True)
class _Unread:
    """The sessions of a query before anything is read: whether units are enough."""

    query: EpisodeId
    pool: "UnitPool"

    def lesson(self, part: str = "lesson") -> SessionEntry:
        return _unread("lesson", self.query)

    def units(self, k: int, dataset: str = DISTRACTORS) -> Sequence[SessionEntry]:
        return [_unread("distractor", unit) for unit in self.pool.draw(self.query, k)]

    def own_units(self, k: int) -> Sequence[SessionEntry]:
        return [_unread("distractor", unit) for unit in self.pool.draw_own(self.query, k)]

    def contradiction(self) -> SessionEntry:
        return _unread("contradiction", self.query)


def _unread(role: str, source: EpisodeId) -> SessionEntry:
    return SessionEntry(role, source.family, source, "", "", 0, 0, UNIT_FRAMES, 1, "")


def plan_build(kind: str, config: BuildConfig) -> BuildPlan:
    """Open the sources and plan one dataset."""
    from robomme_interference_data.storage.encode import get_codec

    from .sources import open_source

    get_codec(config.codec)
    if config.time_limit is not None and not config.time_limit > 0:
        raise InvalidOptionError.expected("time_limit", config.time_limit, "seconds, above 0")
    make_executor(config)  # refuses what it may not be
    numbers = None if config.episodes is None else parse_numbers(config.episodes)
    pairs = [text.partition("=") for text in config.columns]
    if not all(name and equals and column for name, equals, column in pairs):
        raise InvalidOptionError.expected(
            "columns", config.columns, "NAME=COLUMN, such as front=image"
        )
    sources = tuple(
        open_source(
            text,
            columns={name: column for name, _, column in pairs},
            families_file=config.families_file,
            robomme_python=config.robomme_python,
            shifted=kind == SHIFTED,
        )
        for text in config.source
    )
    for text, source in zip(config.source, sources, strict=True):
        if kind in UNITS and not source.whole:
            raise InvalidOptionError(
                f"{text} plays demonstrations only, and distractor units need whole episodes",
                "Build the two datasets apart, the distractors from RoboMME's own training "
                "recordings.",
                "build distractors BUFFER_SET --source robomme-h5:FOLDER",
            )
    split = config.split or ("train" if kind in UNITS else None)
    tasks = list_episodes(sources, families=config.families, split=split, numbers=numbers)
    if kind == CONTRADICTIONS:
        tasks = tuple((number, sources[number].contradict(one)) for number, one in tasks)
    return BuildPlan(
        kind=kind,
        sources=sources,
        tasks=tasks,
        cameras=tuple(sorted(config.cameras)) or None,
        codec=config.codec,
        version=config.version,
        time_limit=config.time_limit,
    )


def list_episodes(
    sources: "Sequence[Source]",
    *,
    families: Iterable[str] = (),
    split: str | None = None,
    numbers: Iterable[int] | None = None,
) -> "tuple[tuple[int, SourceEpisode], ...]":
    """List the episodes of sources that pass all filters, in canonical order.

    Args:
        sources: The sources.
        families: Their families; none for all.
        split: `train`, `val` or `test`; None for all.
        numbers: Their indices; None for all.
    """
    listed = [(number, one) for number, source in enumerate(sources) for one in source.episodes()]
    known = {one.id.family for _, one in listed}
    wanted = set(families) or known
    for family in sorted(wanted - known):
        raise InvalidOptionError.one_of("families", family, sorted(known))
    if split is not None and split not in SPLITS:
        raise InvalidOptionError.one_of("split", split, SPLITS)
    indices = None if numbers is None else set(numbers)
    chosen = sorted(
        (
            (number, one)
            for number, one in listed
            if one.id.family in wanted
            and split in (None, one.id.split)
            and (indices is None or one.id.index in indices)
        ),
        key=lambda item: item[1].id.sort_key,
    )
    for (first, one), (second, other) in pairwise(chosen):
        if one.id == other.id:
            raise SourceError(
                f"{one.id} is recorded twice (in source {first + 1} and source {second + 1})",
                "Leave one out with `families`, `split` or `episodes`, or take fewer sources.",
            )
    if not chosen:
        raise SourceError(
            f"no episode is left of the {len(listed)} that are listed",
            "Check `families`, `split` and `episodes` against the sources.",
        )
    return tuple(chosen)


def position_limit(config: PlanConfig) -> int | None:
    """Return the position limit of a plan; None for none."""
    text = config.position_limit
    if text == "none":
        return None
    if not text.isdecimal() or int(text) == 0:
        raise InvalidOptionError.expected("position_limit", text, "a positive number or none")
    return int(text)
