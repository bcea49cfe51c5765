"""A script that follows subgoals: it finds the step that words and points name, and does it."""

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
_HIGH = 0.20  # m, above everything on the table


class SubgoalFollower:
    """Follows subgoals in one episode, a time step at a time.

    A subgoal matches the answers that have a step with its words, the current step first, and
    whose things are nearest to its points. Of the matching answers, those that no earlier subgoal
    has ruled out come first, then the order of `answers` decides. `to_pixels` projects points of
    the scene into the current front image.
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
        self._subgoal: Subgoal | None = None
        self._matched: str | None = None  # the words of the matching step
        self._doing: tuple[Any, int] | None = None
        self._script: Script = iter(())

    def act(self, subgoal: Subgoal | None) -> None:
        """Continue for a time step; a finished script holds its last pose."""
        if subgoal is not None and subgoal != self._subgoal:
            self._subgoal = subgoal
            self._turn_to(subgoal)
        next(self._script, None)

    def _turn_to(self, subgoal: Subgoal) -> None:
        number = self._number(subgoal)
        if number is None:
            return  # not understood: continue
        matching = self._matching(subgoal, number)
        self._left = [answer for answer in self._left if answer in matching] or [
            answer for answer in self._answers if answer in matching
        ]
        doing = self._left[0], number
        if doing != self._doing:
            step = self._scene.step(*doing)
            self._script = step.do(self._arm) if self._doing is None else self._change_to(step)
            self._doing = doing

    def _change_to(self, step: Step) -> Script:
        """Begin a step in the middle of another, without sweeping away what is beside the arm."""
        if not self._scene.stick:
            yield from self._arm.rise(_HIGH)
        yield from step.do(self._arm)

    def _number(self, subgoal: Subgoal) -> int | None:
        """Return the step whose words are closest to the subgoal's; None if none is close."""
        last = self._scene.steps - 1
        now = min(self._scene.progress(), last)
        wording, known = _plain(subgoal.simple), dict[str, int]()
        for number in sorted(range(last + 1), key=lambda candidate: abs(candidate - now)):
            for answer in self._answers:
                known.setdefault(self._words(answer, number), number)
            if wording in known:
                break
        words = next(iter(get_close_matches(wording, known, n=1, cutoff=_NEAR)), None)
        self._matched = words
        return None if words is None else known[words]

    def _matching(self, subgoal: Subgoal, number: int) -> set[Any]:
        """Return the answers whose step has the matched words and the nearest things."""
        groups: dict[tuple[Any, ...], list[Any]] = {}
        for answer in self._answers:
            if self._words(answer, number) == self._matched:
                at = tuple(
                    tuple(map(float, point)) for point in self._scene.step(answer, number).at
                )
                groups.setdefault(at, []).append(answer)
        distance = {at: sum(map(math.dist, self._to_pixels(at), subgoal.points)) for at in groups}
        nearest = min(distance.values())
        return {
            answer for at, group in groups.items() if distance[at] == nearest for answer in group
        }

    def _words(self, answer: Any, number: int) -> str:
        return _plain(without_points(self._scene.step(answer, number).text))


@cache
def _plain(text: str) -> str:
    """Return a text's words in lower case, separated by single spaces."""
    return " ".join(re.findall(r"[a-z0-9]+", text.lower()))
