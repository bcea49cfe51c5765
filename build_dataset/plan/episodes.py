"""Which episodes of the sources a dataset stores. Pure rules."""

from collections import defaultdict
from collections.abc import Container, Iterable, Sequence
from itertools import islice, pairwise

from robomme_interference_data.build_dataset.dataset.plan import PlannedEpisode
from robomme_interference_data.build_dataset.sources import Source, SourceEpisode
from robomme_interference_data.constants import SPLITS
from robomme_interference_data.errors import InvalidOptionError, SourceError, counted
from robomme_interference_data.ids import EpisodeId, format_numbers

_DESCRIBED = 12
"""Families that an error lists."""


def choose_episodes(
    sources: Sequence[Source],
    *,
    families: Iterable[str] = (),
    split: str | None = None,
    numbers: Iterable[int] | None = None,
    queries: Container[EpisodeId] | None = None,
) -> tuple[PlannedEpisode, ...]:
    """List the episodes of sources that pass all filters, in canonical order.

    Args:
        sources: The sources.
        families: Families; empty for all.
        split: `train`, `val`, `test` or `heldout`; None for all.
        numbers: Indices of episodes in their split, of a day's queries that of the day; None for
            all but those that a source lists as further ones.
        queries: These episodes alone, whatever the other filters are; None to filter.

    Raises:
        InvalidOptionError: A family or split is unknown.
        SourceError: No episode passes, one is recorded twice, cannot be used, or is a unit of an
            episode.
    """
    listed = [
        PlannedEpisode(number, episode)
        for number, source in enumerate(sources)
        for episode in source.episodes()
    ]
    known = {planned.episode.id.family for planned in listed}
    chosen_families = set(families) or known
    for family in sorted(chosen_families - known):
        raise InvalidOptionError.one_of("families", family, sorted(known))
    if split is not None and split not in SPLITS:
        raise InvalidOptionError.one_of("split", split, SPLITS)
    indices = None if numbers is None else set(numbers)

    def passes(episode: SourceEpisode) -> bool:
        if queries is not None:
            return episode.id in queries
        return episode.id.family in chosen_families and in_selection(episode, split, indices)

    chosen = sorted(
        (planned for planned in listed if passes(planned.episode)),
        key=lambda planned: planned.episode.id.sort_key,
    )
    for planned in chosen:
        if planned.episode.id.start:
            raise SourceError(
                f"{planned.episode.id} of source {planned.source + 1} is a distractor unit",
                "Build from recordings of whole episodes.",
            )
    for first, second in pairwise(chosen):
        if first.episode.id == second.episode.id:
            raise SourceError(
                f"{first.episode.id} is recorded twice (in source {first.source + 1} and source "
                f"{second.source + 1})",
                "Give only one of these sources, or name the episode differently in one of them.",
            )
    for planned in chosen:
        planned.episode.check()
    if not chosen:
        filters = sorted(families)
        if split is not None:
            filters.insert(0, split)
        if indices is not None:
            filters.append(f"episodes {format_numbers(sorted(indices))}")
        wanted = ", ".join(filters) or "a query episode"
        raise SourceError(
            f"no episode of {counted(len(listed), 'recorded episode')} is: {wanted}",
            f"There are: {_described(planned.episode.id for planned in listed)}. Choose others.",
        )
    return tuple(chosen)


def in_selection(episode: SourceEpisode, split: str | None, indices: Container[int] | None) -> bool:
    """Return whether an episode is in a split, with one of these indices in it.

    Without a split all are. Without indices, those that a source lists as further ones are not.
    """
    if split not in (None, episode.id.split):
        return False
    if indices is None:
        return not episode.further
    return (episode.day or episode.id).index in indices


def _described(episodes: Iterable[EpisodeId]) -> str:
    """Return the splits and families of episodes, each with its indices."""
    indices = defaultdict[tuple[str, str], list[int]](list)
    for episode in sorted(episodes, key=lambda episode: episode.sort_key):
        indices[episode.split, episode.family].append(episode.index)
    parts = [
        f"{split} {family} {format_numbers(sorted(numbers))}"
        for (split, family), numbers in islice(indices.items(), _DESCRIBED)
    ]
    if len(indices) > _DESCRIBED:
        parts.append(f"{len(indices) - _DESCRIBED} more families")
    return ", ".join(parts) or "none"
