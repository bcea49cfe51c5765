"""RoboMME's sixteen families, which seeds, recordings and goals distinguish.

A goal's rule names words that every wording has and, where two families share those, words that
it never has. Colors, numbers, order of clauses, case and punctuation are free, so that older and
newer wordings of the recordings pass. The rules are ours;
`VideoUnmask` and `VideoUnmaskSwap` have the same goals in RoboMME, which cannot distinguish them.
"""

import re
from typing import NamedTuple

from robomme_interference_data.constants import ACTION, FPS, STATE, VALUE_NAMES

from .base import Robot


class _Recorded(NamedTuple):
    """A family: number in RoboMME's seeds, block of 100 in its LeRobot datasets, and goal patterns.

    A goal must have all of `has` and none of `lacks`.
    """

    code: int
    block: int
    has: tuple[str, ...]
    lacks: tuple[str, ...] = ()


_VIDEO = r"\bvideo\b"
_HIDDEN = r"\bcontainers?\b.*\bhid(?:e|es|ing|den)\b"
_SAME_OBJECT = r"\bsame (?:\w+ )?(?:cube|block)\b"
_ON_TARGET = r"\bplace\b.*\bcube on the\b.*\btarget\b"
_ORDINAL = r"(?:first|second|third|\w+th|\d+(?:st|nd|rd|th)|last)"  # fourth, fifth, … twentieth

ROBOMME = {
    # counting
    "BinFill": _Recorded(4, 12, (r"\bcubes?\b.*\b(?:in|into) the bin\b",)),
    "PickXtimes": _Recorded(
        1, 5, (r"\bpick up\b.*\bcube\b.*\bplace it on the target\b",), (_VIDEO, r"\bleft\b")
    ),
    "SwingXtimes": _Recorded(
        3, 7, (r"\bcube\b.*\bright[- ]side target\b.*\bleft[- ]side target\b",)
    ),
    "StopCube": _Recorded(2, 6, (r"\bstop the cube\b.*\btarget\b",)),
    # permanence
    "VideoUnmask": _Recorded(6, 15, (_VIDEO, _HIDDEN)),
    "VideoUnmaskSwap": _Recorded(5, 4, (_VIDEO, _HIDDEN)),
    "ButtonUnmask": _Recorded(8, 2, (r"\bpress the button\b", _HIDDEN), (_VIDEO, r"\bbuttons\b")),
    "ButtonUnmaskSwap": _Recorded(7, 1, (r"\bpress\b.*\bbuttons\b", _HIDDEN), (_VIDEO,)),
    # reference
    "PickHighlight": _Recorded(12, 8, (r"\bcubes?\b", r"\bhighlight")),
    "VideoRepick": _Recorded(9, 14, (_VIDEO, r"\bpick(?:ed)? up\b", _SAME_OBJECT)),
    "VideoPlaceButton": _Recorded(
        10, 3, (_VIDEO, _ON_TARGET, r"\b(?:before|after) the button was pressed\b")
    ),
    "VideoPlaceOrder": _Recorded(
        11, 13, (_VIDEO, _ON_TARGET, rf"\b{_ORDINAL} target\b"), (r"\bbutton was pressed\b",)
    ),
    # imitation
    "MoveCube": _Recorded(14, 9, (_VIDEO, r"\bmove the cube\b", r"\bsame (?:manner|way)\b")),
    "InsertPeg": _Recorded(13, 10, (_VIDEO, r"\bpeg\b", r"\binsert\b")),
    "PatternLock": _Recorded(15, 0, (_VIDEO, r"\b(?:re)?trace\b", r"\bsame (?:pattern|path)\b")),
    "RouteStick": _Recorded(16, 11, (_VIDEO, r"\bnavigate around the sticks\b")),
}
"""By name."""

ROBOT = Robot(FPS, names={STATE: VALUE_NAMES, ACTION: VALUE_NAMES})
"""RoboMME's robot."""

BLOCKS = tuple(sorted(ROBOMME, key=lambda name: ROBOMME[name].block))
"""The families in the order of their blocks."""


def families_for_goal(goal: str) -> tuple[str, ...]:
    """Return RoboMME's families that a goal text can belong to; empty if to none."""
    text = " ".join(goal.lower().split())
    return tuple(
        family
        for family, (_, _, has, lacks) in ROBOMME.items()
        if all(re.search(pattern, text) for pattern in has)
        and not any(re.search(pattern, text) for pattern in lacks)
    )
