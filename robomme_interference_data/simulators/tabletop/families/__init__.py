"""The nine task families; those that share a scene share a file."""

from functools import lru_cache
from importlib import import_module

from numpy.random import RandomState

from robomme_interference_data.constants import DIFFICULTIES
from robomme_interference_data.errors import UnknownNameError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.simulators.tabletop.episodes import difficulty_of, seed_of, turn_of
from robomme_interference_data.simulators.tabletop.family import Family

_MODULES = {
    "VideoRepick": "video_repick",
    "VideoPlaceOrder": "video_place",
    "VideoPlaceButton": "video_place",
    "VideoUnmask": "video_unmask",
    "VideoUnmaskSwap": "video_unmask",
    "MoveCube": "move_cube",
    "InsertPeg": "insert_peg",
    "PatternLock": "stick",
    "RouteStick": "stick",
}
"""Family, which is the name of its class, to its module, which is imported when it is drawn."""


def draw_episode(family: str, seed: int, difficulty: str) -> Family:
    """Return the scene of a seed; nothing is simulated."""
    if family not in _MODULES:
        raise UnknownNameError.among("family", family, "tabletop", _MODULES)
    module = import_module(f"{__package__}.{_MODULES[family]}")
    drawn: Family = getattr(module, family)(difficulty, RandomState(seed))
    return drawn


_cached_episode = lru_cache(256)(draw_episode)


def known_scene(family: str, seed: int, difficulty: str) -> Family | None:
    """Return a shared scene that must not be played; None for an unknown family or difficulty."""
    known = family in _MODULES and difficulty in DIFFICULTIES
    return _cached_episode(family, seed, difficulty) if known else None


def other_answer(episode: EpisodeId) -> int:
    """Return the number of an answer that an episode's scene allows and that is not its own.

    Over the episodes, the other answers occur equally often.
    """
    seed = seed_of(episode)
    count = len(draw_episode(episode.family, seed, difficulty_of(seed)).answers)
    other, own = turn_of(seed, count - 1, stream=2), turn_of(seed, count)
    return other + (other >= own)
