"""Which goal texts can belong to which of RoboMME's sixteen families.

A rule names words that every wording of a family's goal has and, where two families share those,
words that it never has. Colours, numbers, order of clauses, case and punctuation are free, so that
older and newer wordings of the recordings pass. The rules are ours, made to tell the families
apart; `VideoUnmask` and `VideoUnmaskSwap` have the same goals in RoboMME and cannot be told apart.
"""

import re
from dataclasses import dataclass

__all__ = ["GOAL_FAMILIES", "families_for_goal", "goal_fits"]


@dataclass(frozen=True)
class _Rule:
    """Patterns that a goal must all have, and patterns of which it may have none."""

    has: tuple[str, ...]
    lacks: tuple[str, ...] = ()

    def fits(self, goal: str) -> bool:
        return all(re.search(pattern, goal) for pattern in self.has) and not any(
            re.search(pattern, goal) for pattern in self.lacks
        )


_VIDEO = r"\bvideo\b"
_HIDDEN = r"\bcontainers?\b.*\bhid(?:e|es|ing|den)\b"
_SAME_OBJECT = r"\bsame (?:\w+ )?(?:cube|block)\b"
_ON_TARGET = r"\bplace\b.*\bcube on the\b.*\btarget\b"
_ORDINAL = r"(?:first|second|third|\w+th|\d+(?:st|nd|rd|th)|last)"  # fourth, fifth, … twentieth

_UNMASK = _Rule((_VIDEO, _HIDDEN))

_RULES = {
    # counting
    "BinFill": _Rule((r"\bcubes?\b.*\b(?:in|into) the bin\b",)),
    "PickXtimes": _Rule(
        (r"\bpick up\b.*\bcube\b.*\bplace it on the target\b",), (_VIDEO, r"\bleft\b")
    ),
    "SwingXtimes": _Rule((r"\bcube\b.*\bright[- ]side target\b.*\bleft[- ]side target\b",)),
    "StopCube": _Rule((r"\bstop the cube\b.*\btarget\b",)),
    # permanence
    "VideoUnmask": _UNMASK,
    "VideoUnmaskSwap": _UNMASK,
    "ButtonUnmask": _Rule((r"\bpress the button\b", _HIDDEN), (_VIDEO, r"\bbuttons\b")),
    "ButtonUnmaskSwap": _Rule((r"\bpress\b.*\bbuttons\b", _HIDDEN), (_VIDEO,)),
    # reference
    "PickHighlight": _Rule((r"\bcubes?\b", r"\bhighlight")),
    "VideoRepick": _Rule((_VIDEO, r"\bpick(?:ed)? up\b", _SAME_OBJECT)),
    "VideoPlaceButton": _Rule((_VIDEO, _ON_TARGET, r"\b(?:before|after) the button was pressed\b")),
    "VideoPlaceOrder": _Rule(
        (_VIDEO, _ON_TARGET, rf"\b{_ORDINAL} target\b"), (r"\bbutton was pressed\b",)
    ),
    # imitation
    "MoveCube": _Rule((_VIDEO, r"\bmove the cube\b", r"\bsame (?:manner|way)\b")),
    "InsertPeg": _Rule((_VIDEO, r"\bpeg\b", r"\binsert\b")),
    "PatternLock": _Rule((_VIDEO, r"\b(?:re)?trace\b", r"\bsame (?:pattern|path)\b")),
    "RouteStick": _Rule((_VIDEO, r"\bnavigate around the sticks\b")),
}

GOAL_FAMILIES = tuple(_RULES)
"""The sixteen families that have a rule, by RoboMME's suites."""


def goal_fits(family: str, goal: str) -> bool:
    """Tell whether a goal text can belong to a family; True for families without a rule."""
    rule = _RULES.get(family)
    return rule is None or rule.fits(_plain(goal))


def families_for_goal(goal: str) -> tuple[str, ...]:
    """Return the families with a rule that a goal text can belong to; empty if to none."""
    text = _plain(goal)
    return tuple(family for family, rule in _RULES.items() if rule.fits(text))


def _plain(goal: str) -> str:
    return " ".join(goal.lower().split())
