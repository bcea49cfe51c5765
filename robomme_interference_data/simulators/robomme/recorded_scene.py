"""Read the scene of one of RoboMME's episodes, as `facts.py` records it in JSON."""

import json
from functools import lru_cache
from typing import Any

from robomme_interference_data.errors import FormatError

from .scenes import (
    OfficialInsertPeg,
    OfficialMoveCube,
    OfficialPatternLock,
    OfficialRouteStick,
    OfficialScene,
    OfficialVideoPlaceButton,
    OfficialVideoPlaceOrder,
    OfficialVideoRepick,
    OfficialVideoUnmask,
    OfficialVideoUnmaskSwap,
)

# Upper bounds, so that an untrusted scene has no endless number of possible answers.
_MOST = {"points": 25, "colors": 3, "visits": 4, "swaps": 3}
_MAX_MOVES = 8  # of a path, or its buttons

_SCENES: dict[str, type[OfficialScene]] = {
    "VideoRepick": OfficialVideoRepick,
    "VideoPlaceOrder": OfficialVideoPlaceOrder,
    "VideoPlaceButton": OfficialVideoPlaceButton,
    "VideoUnmask": OfficialVideoUnmask,
    "VideoUnmaskSwap": OfficialVideoUnmaskSwap,
    "MoveCube": OfficialMoveCube,
    "InsertPeg": OfficialInsertPeg,
    "PatternLock": OfficialPatternLock,
    "RouteStick": OfficialRouteStick,
}
"""By family."""


@lru_cache(8)
def read_scene(family: str, recorded: str, difficulty: str) -> OfficialScene:
    """Return the scene that was recorded as JSON.

    Raises:
        FormatError: The text is not what `facts.py` records of this family.
    """
    try:
        facts = json.loads(recorded)
        for name, most in _MOST.items():
            if name in facts and len(facts[name]) > most:
                raise ValueError(f"{name} has over {most} entries")
        if _longest(facts["answer"]) > _MAX_MOVES:
            raise ValueError(f"the answer has over {_MAX_MOVES} entries")
        scene = _SCENES[family](facts, difficulty)
        answer = scene.own_answer(0)
        if answer not in scene.answers:
            raise ValueError(f"the answer {answer} is not possible")
        scene.parts(answer)
    except (ValueError, LookupError, TypeError, ArithmeticError, RecursionError) as error:
        raise FormatError(f"the recorded scene of {family} is damaged: {error}") from error
    return scene


def _longest(value: Any) -> int:
    """Return the length of the longest list in a value of JSON, itself included."""
    return max([len(value), *map(_longest, value)]) if isinstance(value, list) else 0
