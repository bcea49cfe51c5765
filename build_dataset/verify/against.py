"""Compare the plan of a buffer set with a reference plan. Pure rules."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from robomme_interference_data.constants import UNITS
from robomme_interference_data.errors import counted
from robomme_interference_data.ids import EpisodeId, format_numbers
from robomme_interference_data.schema.reference_plan import (
    ReferenceEpisode,
    ReferencePlan,
    ReferenceQuery,
)

from .dataset import Violation


@dataclass(frozen=True)
class PlanComparison:
    """How a buffer set compares with a reference plan.

    Attributes:
        differences: What must be equal, and is not.
        notes: What may differ, and does: images and states of another renderer, features of the
            plan that the buffer set lacks, and what it has beyond the plan.
        digests: Number of episodes whose digests were compared.
    """

    differences: tuple[Violation, ...]
    notes: tuple[str, ...]
    digests: int


def compare(found: ReferencePlan, plan: ReferencePlan) -> PlanComparison:
    """Compare the plan of a buffer set with a reference plan; no order of either has an effect.

    The buffers of the plan must be there with the same sessions, and the pool must be the same.
    Digests must be equal where the renderer is the same. Further queries, conditions and cameras
    are no difference; nor are fewer cameras, which are noted.
    """
    digests = [*_compared(found, plan)]
    differences = [
        *_settings(found, plan),
        *_episodes(found, plan),
        *_buffers(found, plan),
        *_digests(digests, found, plan),
    ]
    notes = [*_further(found, plan), *_lacking(found, plan), *_other_renderer(digests, found, plan)]
    return PlanComparison(tuple(differences), tuple(notes), len(digests))


def _settings(found: ReferencePlan, plan: ReferencePlan) -> Iterator[Violation]:
    for name in ("rule_version", "seed", "simulators", "unit"):
        here, there = getattr(found, name), getattr(plan, name)
        if here != there:
            yield Violation(name, f"is {here}; the plan has {there}")
    if lacking := [name for name in plan.conditions if name not in found.conditions]:
        yield Violation("conditions", f"{', '.join(lacking)} are in the plan only")


def _episodes(found: ReferencePlan, plan: ReferencePlan) -> Iterator[Violation]:
    """Yield episodes that only one of the plans has, and those of other lengths."""
    here, there = _by_dataset(found), _by_dataset(plan)
    for name in there:
        lacking = there[name].keys() - here[name].keys()
        if lacking:
            yield Violation(name, f"{_listed(lacking)} are in the plan only")
        if name in UNITS and (further := here[name].keys() - there[name].keys()):
            what = f"{_listed(further)} are not in the plan, and change which units are drawn"
            yield Violation(name, what)
        for episode in sorted(here[name].keys() & there[name].keys()):
            frames, planned = here[name][episode].frames, there[name][episode].frames
            if frames != planned:
                yield Violation(f"{name} {episode}", f"has {frames} frames; the plan has {planned}")


def _buffers(found: ReferencePlan, plan: ReferencePlan) -> Iterator[Violation]:
    """Yield queries with other sessions than in the plan, each difference once."""
    queries = {query.episode: query for query in found.queries}
    if lacking := {query.episode for query in plan.queries} - queries.keys():
        yield Violation("queries", f"{_listed(lacking)} are in the plan only")
    for planned in sorted(plan.queries, key=lambda query: query.episode):
        query = queries.get(planned.episode)
        if query is None:
            continue
        conditions = defaultdict[str, list[str]](list)
        for condition in planned.buffers:
            if condition in found.conditions:  # others are reported once for all queries
                what = _difference(query, planned, condition)
                if what is not None:
                    conditions[what].append(condition)
        for what, names in conditions.items():
            yield Violation(f"{planned.episode} under {', '.join(names)}", what)


def _difference(query: ReferenceQuery, planned: ReferenceQuery, condition: str) -> str | None:
    """Return the first difference of a query's buffers under a condition, or None."""
    if condition not in query.buffers:
        return "is in the plan only"
    here, there = query.buffer(condition), planned.buffer(condition)
    for number, (session, other) in enumerate(zip(here, there, strict=False)):
        if session != other:
            return f"session {number} is {session}; the plan has {other}"
    if len(here) != len(there):
        return f"{counted(len(here), 'session')}; the plan has {len(there)}"
    return None


@dataclass(frozen=True)
class _Digests:
    """An episode whose digests were compared, and the features in which they differ."""

    dataset: str
    episode: EpisodeId
    differing: tuple[str, ...]


def _compared(found: ReferencePlan, plan: ReferencePlan) -> Iterator[_Digests]:
    here, there = _by_dataset(found), _by_dataset(plan)
    for name in there:
        for episode in sorted(here[name].keys() & there[name].keys()):
            digests, planned = here[name][episode].digests, there[name][episode].digests
            if features := sorted(digests.keys() & planned.keys()):
                differing = tuple(f for f in features if digests[f] != planned[f])
                yield _Digests(name, episode, differing)


def _digests(
    compared: Iterable[_Digests], found: ReferencePlan, plan: ReferencePlan
) -> Iterator[Violation]:
    """Yield episodes that differ although their renderer does not explain it."""
    for digests in compared:
        if digests.differing and _same_renderer(digests.dataset, found, plan):
            features = ", ".join(digests.differing)
            what = f"{features} differs from the plan, though the renderer is the same"
            yield Violation(f"{digests.dataset} {digests.episode}", what)


def _other_renderer(
    compared: Iterable[_Digests], found: ReferencePlan, plan: ReferencePlan
) -> Iterator[str]:
    """Yield how many episodes of a dataset differ because another renderer drew them."""
    by_dataset = defaultdict[str, list[_Digests]](list)
    for digests in compared:
        by_dataset[digests.dataset].append(digests)
    for name, episodes in by_dataset.items():
        differing = [episode for episode in episodes if episode.differing]
        if differing and not _same_renderer(name, found, plan):
            here, there = (drawn.renderers.get(name) or "unknown" for drawn in (found, plan))
            features = sorted({feature for episode in differing for feature in episode.differing})
            yield (
                f"{', '.join(features)} of {len(differing)} of "
                f"{counted(len(episodes), 'compared episode')} of the {name} differ, as the "
                f"renderers do: {here}; in the plan {there}"
            )


def _same_renderer(dataset: str, found: ReferencePlan, plan: ReferencePlan) -> bool:
    return found.renderers.get(dataset) == plan.renderers.get(dataset)


def _further(found: ReferencePlan, plan: ReferencePlan) -> Iterator[str]:
    """Yield what a buffer set has beyond the plan."""
    planned = {query.episode for query in plan.queries}
    if queries := {query.episode for query in found.queries} - planned:
        yield f"Beyond the plan: the queries {_listed(queries)}"
    if conditions := [name for name in found.conditions if name not in plan.conditions]:
        yield f"Beyond the plan: the conditions {', '.join(conditions)}"


def _lacking(found: ReferencePlan, plan: ReferencePlan) -> Iterator[str]:
    """Yield features with digests in the plan that the buffer set has none of: no such camera."""
    here, there = _by_dataset(found), _by_dataset(plan)
    for name in there:
        features = Counter[str]()
        for episode in here[name].keys() & there[name].keys():
            digests, planned = here[name][episode].digests, there[name][episode].digests
            features.update(planned.keys() - digests.keys())
        for feature, count in sorted(features.items()):
            yield (
                f"Not compared: {feature} of {counted(count, 'episode')} of the {name}, which the "
                "buffer set lacks"
            )


def _by_dataset(plan: ReferencePlan) -> defaultdict[str, dict[EpisodeId, ReferenceEpisode]]:
    episodes = defaultdict[str, dict[EpisodeId, ReferenceEpisode]](dict)
    for episode in plan.episodes:
        episodes[episode.dataset][episode.episode] = episode
    return episodes


def _listed(episodes: Iterable[EpisodeId]) -> str:
    """Return episodes by family, such as `MoveCube/train/0-3,7, PatternLock/train/2`."""
    indices = defaultdict[str, set[int]](set)
    for episode in sorted(episodes):
        indices[f"{episode.family}/{episode.split}"].add(episode.index)
    return ", ".join(f"{name}/{format_numbers(sorted(found))}" for name, found in indices.items())
