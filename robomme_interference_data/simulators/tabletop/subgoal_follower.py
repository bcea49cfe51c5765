"""A script that obeys subgoals: it finds what their words and points name, and does that."""

import math
import re
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from functools import cache
from typing import Any

from robomme_interference_data.schema.subgoal import Pixel, Subgoal, without_points

from .family import Family, Step
from .motion import Arm, Point, Script

_NEAR = 0.6  # of difflib's ratio: wordings that may mean the same
_HIGH = 0.20  # m, above all that stands on the table


class SubgoalFollower:
    """Does what it is told in one episode, a time step at a time.

    A subgoal names those answers of which a step has its words, the step of now before others,
    and whose things are nearest to its points. Answers that no subgoal so far has ruled out go
    before others, and of several the first one is taken.

    Args:
        scene: The episode.
        arm: The arm.
        answers: All answers of the scene, in the order in which they are taken.
        to_pixels: Where points of the scene are in the front image now.
    """

    def __init__(
        self,
        scene: Family,
        arm: Arm,
        answers: Sequence[Any],
        to_pixels: Callable[[Sequence[Point]], Sequence[Pixel]],
    ):
        self._scene, self._arm, self._to_pixels = scene, arm, to_pixels
        self._answers = self._left = list(answers)
        self._told: Subgoal | None = None
        self._named: str | None = None  # the words of the step that is meant
        self._doing: tuple[Any, int] | None = None
        self._script: Script = iter(())

    def act(self, subgoal: Subgoal | None) -> None:
        """Go on for a time step; a script that is through holds its last pose."""
        if subgoal is not None and subgoal != self._told:
            self._told = subgoal
            self._turn_to(subgoal)
        next(self._script, None)

    def _turn_to(self, subgoal: Subgoal) -> None:
        number = self._number(subgoal)
        if number is None:
            return  # not understood: it goes on
        meant = self._meant(subgoal, number)
        self._left = [one for one in self._left if one in meant] or [
            one for one in self._answers if one in meant
        ]
        doing = self._left[0], number
        if doing != self._doing:
            step = self._scene.step(*doing)
            self._script = step.do(self._arm) if self._doing is None else self._change_to(step)
            self._doing = doing

    def _change_to(self, step: Step) -> Script:
        """Begin a step in the midst of another: what is beside the arm must not be swept away."""
        if not self._scene.stick:
            yield from self._arm.rise(_HIGH)
        yield from step.do(self._arm)

    def _number(self, subgoal: Subgoal) -> int | None:
        """Return the step that has the subgoal's words, or nearly; None if none has."""
        last = self._scene.steps() - 1
        now = min(self._scene.progress(), last)
        told, known = _plain(subgoal.simple), dict[str, int]()
        for number in sorted(range(last + 1), key=lambda one: abs(one - now)):
            for answer in self._answers:
                known.setdefault(self._words(answer, number), number)
            if told in known:
                break
        words = next(iter(get_close_matches(told, known, n=1, cutoff=_NEAR)), None)
        self._named = words
        return None if words is None else known[words]

    def _meant(self, subgoal: Subgoal, number: int) -> set[Any]:
        """Return the answers of which this step has those words, and the nearest things."""
        groups: dict[tuple[Any, ...], list[Any]] = {}
        for answer in self._answers:
            if self._words(answer, number) == self._named:
                at = tuple(tuple(map(float, one)) for one in self._scene.step(answer, number).at)
                groups.setdefault(at, []).append(answer)
        away = {at: sum(map(math.dist, self._to_pixels(at), subgoal.points)) for at in groups}
        nearest = min(away.values())
        return {one for at, found in groups.items() if away[at] == nearest for one in found}

    def _words(self, answer: Any, number: int) -> str:
        return _plain(without_points(self._scene.step(answer, number).text))


@cache
def _plain(text: str) -> str:
    """Return a text's letters and digits, in small letters, words parted by one blank."""
    return " ".join(re.findall(r"[a-z0-9]+", text.lower()))
