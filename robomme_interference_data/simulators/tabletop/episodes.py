"""The suite's episodes, with their seeds and difficulties."""

from numpy.random import RandomState

from robomme_interference_data.constants import DIFFICULTIES, FAMILIES
from robomme_interference_data.errors import UnknownNameError
from robomme_interference_data.ids import EpisodeId

EPISODES = {"train": 100, "val": 50, "test": 50}
"""Episodes per family in each split; RoboMME has as many."""

TRAIN = 900
"""Train episodes per family with those that are built only if their numbers are given."""

_FAMILY_SPAN = 3000
_SPLIT_SPAN = 900  # a multiple of 3, see difficulty_of; at least TRAIN
_SPLIT_START = {"train": 0, "val": _SPLIT_SPAN, "test": 2 * _SPLIT_SPAN}


def seed_of(episode: EpisodeId) -> int:
    """Return the seed of an episode; no two episodes share one."""
    if episode.family not in FAMILIES:
        raise UnknownNameError.among("family", episode.family, "tabletop", FAMILIES)
    if episode.split not in EPISODES:
        raise UnknownNameError.among("split", episode.split, "tabletop", EPISODES)
    count = TRAIN if episode.split == "train" else EPISODES[episode.split]
    if episode.index >= count:
        raise UnknownNameError(
            f"{episode} does not exist: split {episode.split!r} has episodes 0 to {count - 1}"
        )
    family = _FAMILY_SPAN * (1 + FAMILIES.index(episode.family))
    return family + _SPLIT_START[episode.split] + episode.index


def turn_of(seed: int, count: int, stream: int = 0) -> int:
    """Return which of `count` answers, counted from 0, the episode of a seed has.

    The episodes of a family, split and difficulty come in blocks of `count`; each block has every
    answer once, in random order. So answers occur equally often, to within one. Each `stream` has
    its own orders: 0 for answers, 1 for guesses, 2 for other answers.
    """
    family, number = divmod(seed, _FAMILY_SPAN)
    split, number = divmod(number, _SPLIT_SPAN)
    number, difficulty = divmod(number, len(DIFFICULTIES))
    block, index = divmod(number, count)
    order = RandomState([family, split, difficulty, block, stream]).permutation(count)
    return int(order[index])


def difficulty_of(seed: int) -> str:
    """Return the difficulty of a seed's scene: easy, medium and hard alternate."""
    return DIFFICULTIES[seed % len(DIFFICULTIES)]


def episode_ids() -> list[EpisodeId]:
    """List the suite's episodes in canonical order."""
    return [
        EpisodeId(family, split, index)
        for family in FAMILIES
        for split, count in EPISODES.items()
        for index in range(count)
    ]


def further_ids() -> list[EpisodeId]:
    """List the train episodes beyond those of `episode_ids`, in canonical order."""
    numbers = range(EPISODES["train"], TRAIN)
    return [EpisodeId(family, "train", index) for family in FAMILIES for index in numbers]
