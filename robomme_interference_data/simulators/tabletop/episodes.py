"""Which episodes the suite has, and the seed and difficulty of each: pure, without a simulator."""

from robomme_interference_data.constants import FAMILIES, SPLITS
from robomme_interference_data.errors import UnknownNameError, nearest
from robomme_interference_data.ids import EpisodeId

__all__ = ["DIFFICULTIES", "EPISODES", "difficulty_of", "episode_ids", "seed_of"]

DIFFICULTIES = ("easy", "medium", "hard")

EPISODES = {"train": 100, "val": 50, "test": 50}
"""Episodes per family in each split."""

_FAMILY_SPAN = 3000
_SPLIT_START = {"train": 0, "val": 900, "test": 1800}  # multiples of 3, see difficulty_of


def seed_of(episode: EpisodeId) -> int:
    """Return the seed of an episode; no two episodes share one.

    Raises:
        UnknownNameError: The suite has no such family or episode.
    """
    if episode.family not in FAMILIES:
        raise UnknownNameError(
            f"the tabletop simulator has no family {episode.family!r}",
            nearest(episode.family, FAMILIES),
        )
    if episode.index >= EPISODES[episode.split]:
        raise UnknownNameError(
            f"{episode} does not exist: split {episode.split!r} has the episodes 0 to "
            f"{EPISODES[episode.split] - 1}"
        )
    family = _FAMILY_SPAN * (1 + FAMILIES.index(episode.family))
    return family + _SPLIT_START[episode.split] + episode.index


def difficulty_of(seed: int) -> str:
    """Return the difficulty of a seed's scene: easy, medium, hard, in turn."""
    return DIFFICULTIES[seed % 3]


def episode_ids(
    family: str | None = None, split: str | None = None, difficulty: str | None = None
) -> list[EpisodeId]:
    """List the suite's episodes in canonical order, all or those of one kind.

    Raises:
        UnknownNameError: There is no such family.
        InvalidIdError: There is no such split.
    """
    families = FAMILIES if family is None else (family,)
    splits = SPLITS if split is None else (split,)
    found = []
    for each in families:
        for part in splits:
            seed_of(EpisodeId(each, part, 0))
            found += [EpisodeId(each, part, index) for index in range(EPISODES[part])]
    return [e for e in found if difficulty is None or difficulty_of(seed_of(e)) == difficulty]
