"""The nine task families: a file each."""

from functools import lru_cache

from numpy.random import RandomState

from robomme_interference_data.constants import DIFFICULTIES
from robomme_interference_data.errors import UnknownNameError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.simulators.tabletop.episodes import difficulty_of, seed_of, turn_of
from robomme_interference_data.simulators.tabletop.family import Family

from .insert_peg import InsertPeg
from .move_cube import MoveCube
from .pattern_lock import PatternLock
from .route_stick import RouteStick
from .video_place_button import (
    VideoPlaceButton,
)
from .video_place_order import VideoPlaceOrder
from .video_repick import VideoRepick
from .video_unmask import VideoUnmask
from .video_unmask_swap import VideoUnmaskSwap

_FAMILIES: dict[str, type[Family]] = {
    each.__name__: each
    for each in (
        VideoRepick,
        VideoPlaceOrder,
        VideoPlaceButton,
        VideoUnmask,
        VideoUnmaskSwap,
        MoveCube,
        InsertPeg,
        PatternLock,
        RouteStick,
    )
}


def draw_episode(family: str, seed: int, difficulty: str) -> Family:
    """Return the episode of a seed, its hidden answer apart; nothing is simulated."""
    return family_class(family)(difficulty, RandomState(seed))


def known_scene(family: str, seed: int, difficulty: str) -> Family | None:
    """Return the episode of a seed as `draw_episode` does; None if the suite has none such."""
    if family not in _FAMILIES or difficulty not in DIFFICULTIES:
        return None
    return _drawn(family, seed, difficulty)


@lru_cache(256)
def _drawn(family: str, seed: int, difficulty: str) -> Family:
    return draw_episode(family, seed, difficulty)


def family_class(name: str) -> type[Family]:
    """Return the class of a task family."""
    if name not in _FAMILIES:
        raise UnknownNameError.among("family", name, "tabletop", _FAMILIES)
    return _FAMILIES[name]


def other_answer(episode: EpisodeId) -> int:
    """Return the number of an answer that an episode's scene allows and that is not its own.

    Over episodes they take turns, as own answers do.
    """
    seed = seed_of(episode)
    count = len(draw_episode(episode.family, seed, difficulty_of(seed)).answers)
    other, own = turn_of(seed, count - 1, stream=2), turn_of(seed, count)
    return other + (other >= own)
