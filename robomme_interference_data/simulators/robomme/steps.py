"""The steps of a task: all that carry out an answer, and the one that a subgoal names.

Runs in RoboMME's interpreter, as `worker.py` does. A step is the name of one of RoboMME's solvers
and the solver's arguments.
"""

import re
from abc import ABC, abstractmethod
from typing import Any

_PUT = "place|put|drop"
_ALONG = {"forward": 1.0, "backward": -1.0}
_ACROSS = {"left": 1.0, "right": -1.0}


class Steps(ABC):
    """The steps of one live episode.

    Args:
        base: RoboMME's environment, unwrapped.

    Attributes:
        stick: Whether the arm has a stick instead of a gripper.
    """

    stick = False

    def __init__(self, base: Any) -> None:
        self.base = base

    @abstractmethod
    def of_answer(self, answer: Any) -> Any:
        """Yield the steps that carry out an answer."""

    @abstractmethod
    def of_words(self, words: str, points: list[list[int]], seed: int) -> Any:
        """Return the step that words name, in lower case and without `<point>`, or None."""

    def of_subgoal(self, text: str, points: list[list[int]], seed: int) -> Any:
        """Return the step that a subgoal names, or None.

        Of several things that the words may mean, the one nearest to the point counts; without a
        point one is drawn from the seed.
        """
        words = " ".join(text.lower().replace("<point>", " ").split())
        return self.of_words(words, points, seed)

    def choose(self, things: list[Any], points: list[list[int]], seed: int) -> int:
        """Return the number of the thing that a point shows, or of a random one."""
        import numpy as np

        if not points:
            return int(np.random.RandomState([seed, len(things)]).randint(len(things)))
        places = np.array([pixel(self.base, thing) for thing in things])
        return int(np.argmin(((places - np.array(points[0])) ** 2).sum(axis=1)))

    def nearest(self, spots: Any) -> int:
        """Return the number of the spot nearest to the arm's tip."""
        tip = self.base.agent.tcp.pose.p[0][:2].numpy()
        return int(((spots - tip) ** 2).sum(axis=1).argmin())


class _Unmask(Steps):
    def of_answer(self, answer: list[int]) -> Any:
        for number, container in enumerate(answer):
            if number:
                yield self.put_down()
            yield self.pick_up(container)

    def of_words(self, words: str, points: Any, seed: int) -> Any:
        if "pick up" in words:
            return self.pick_up(self.choose(self.base.spawned_bins, points, seed))
        return self.put_down() if re.search(_PUT, words) else None

    def pick_up(self, container: int) -> Any:
        return "solve_pickup_bin", {"obj": self.base.spawned_bins[container]}

    def put_down(self) -> Any:
        return "solve_putdown_whenhold", {}


class _Repick(Steps):
    def of_answer(self, answer: int) -> Any:
        for _ in range(int(self.base.num_repeats)):
            yield self.pick_up(answer)
            yield self.put_down()
        yield self.press()

    def of_words(self, words: str, points: Any, seed: int) -> Any:
        if "button" in words:
            return self.press()
        if "pick up" in words:
            return self.pick_up(self.choose(self.base.spawned_cubes, points, seed))
        return self.put_down() if re.search(_PUT, words) else None

    def pick_up(self, cube: int) -> Any:
        return "solve_pickup", {"obj": self.base.spawned_cubes[cube]}

    def put_down(self) -> Any:
        return "solve_putdown_whenhold", {"release_z": 0.01}

    def press(self) -> Any:
        return "solve_button", {"obj": self.base.button_left}


class _Place(Steps):
    def of_answer(self, answer: int) -> Any:
        yield "solve_pickup", {"obj": self.base.target_cube}
        yield self.put(answer)

    def of_words(self, words: str, points: Any, seed: int) -> Any:
        if "pick up" in words:  # the goal names the cube
            cubes = self.base.all_cubes if points else [self.base.target_cube]
            return "solve_pickup", {"obj": cubes[self.choose(cubes, points, seed)]}
        if re.search(_PUT, words):
            return self.put(self.choose(self.base.targets, points, seed))
        return None

    def put(self, target: int) -> Any:
        return "solve_putonto_whenhold", {"target": self.base.targets[target]}


class _Move(Steps):
    def of_answer(self, answer: str) -> Any:
        in_words = {
            "peg_push": ("pick up the peg", "hook the cube"),
            "gripper_push": ("push the cube",),
            "grasp_putdown": ("pick up the cube", "put it onto the target"),
        }
        for words in in_words[answer]:
            yield self.of_words(words, [], 0)

    def of_words(self, words: str, points: Any, seed: int) -> Any:
        base = self.base
        both = {"obj": base.cube, "target": base.goal_site}
        if "hook" in words:
            sides = {"direction": base.direction2, "obj_flag": base.obj_flag}
            return "solve_push_to_target_with_peg", {**both, **sides}
        if "push" in words:
            return "solve_push_to_target", both
        if "pick up" in words and "peg" in words:
            return "grasp_and_lift_peg_side", {"obj": base.grasp_target}
        if "pick up" in words:
            return "solve_pickup", {"obj": base.cube}
        put = re.search(_PUT, words)
        return ("solve_putonto_whenhold", {"target": base.goal_site}) if put else None


class _Insert(Steps):
    held: Any = None
    """The end of the peg that was picked up last by which it is grasped, and the other one."""

    def of_answer(self, answer: list[Any]) -> Any:
        peg, end, side = answer
        yield self.pick_up(peg, end)
        yield self.insert(side)

    def of_words(self, words: str, points: Any, seed: int) -> Any:
        if "pick up" in words:
            end = "far" if "far" in words else "near"
            return self.pick_up(self.choose(self.base.pegs, points, seed), end)
        side = re.search("left|right", words)
        return self.insert(side[0]) if side and self.held else None

    def pick_up(self, peg: int, end: str) -> Any:
        """Pick up a peg by the end that is `near` the arm's base, or by the `far` one."""
        ends = [self.base.peg_heads[peg], self.base.peg_tails[peg]]
        arm = float(self.base.agent.robot.pose.p[0][0])
        ends.sort(key=lambda link: abs(float(link.pose.p[0][0]) - arm))  # the head if as near
        self.held = ends if end == "near" else ends[::-1]
        return "grasp_and_lift_peg_side", {"obj": self.held[0]}

    def insert(self, side: str) -> Any:
        grasped, inserted = self.held
        flags = {
            "direction": -1 if side == "left" else 1,
            "obj": -1 if any(grasped is head for head in self.base.peg_heads) else 1,
        }
        return "insert_peg", {**flags, "insert_obj": inserted, "cut_retreat": True}


class _Pattern(Steps):
    stick = True

    def of_answer(self, answer: list[int]) -> Any:
        return map(self.go_to, answer[1:])

    def of_words(self, words: str, points: Any, seed: int) -> Any:
        import numpy as np

        named = re.search(r"(forward|backward)?[- ]?(left|right)?$", words)
        x = _ALONG.get((named and named[1]) or "", 0.0)
        y = _ACROSS.get((named and named[2]) or "", 0.0)
        if not x and not y:
            return None
        spots = np.array([button.pose.p[0][:2].tolist() for button in self.base.buttons_grid])
        spacing = float(np.abs(spots[1] - spots[0]).max())
        goal = spots[self.nearest(spots)] + spacing * np.array([x, y])
        return self.go_to(int(((spots - goal) ** 2).sum(axis=1).argmin()))

    def go_to(self, button: int) -> Any:
        return "solve_swingonto", {"target": self.base.buttons_grid[button]}


class _Route(Steps):
    stick = True

    def of_answer(self, answer: list[Any]) -> Any:
        route, turns = answer
        return map(self.go_to, route[1:], turns)

    def of_words(self, words: str, points: Any, seed: int) -> Any:
        import numpy as np

        side, turn = re.search(r"\b(left|right)\b", words), re.search("(counter)?clockwise", words)
        if side is None or turn is None:
            return None
        targets = [self.base.buttons_grid[number] for number in self.base.route_button_indices]
        at = self.nearest(np.array([target.pose.p[0][:2].tolist() for target in targets]))
        to = min(max(at + int(_ACROSS[side[0]]), 0), len(targets) - 1)
        return self.go_to(to, turn[0])

    def go_to(self, target: int, turn: str) -> Any:
        button = self.base.buttons_grid[self.base.route_button_indices[target]]
        named = {"target": button, "radius": 0.2, "direction": turn}
        return "solve_swingonto_withDirection", named


STEPS: dict[str, type[Steps]] = {
    "VideoUnmask": _Unmask,
    "VideoUnmaskSwap": _Unmask,
    "VideoRepick": _Repick,
    "VideoPlaceButton": _Place,
    "VideoPlaceOrder": _Place,
    "MoveCube": _Move,
    "InsertPeg": _Insert,
    "PatternLock": _Pattern,
    "RouteStick": _Route,
}
"""Family to its steps."""


def pixel(base: Any, thing: Any) -> list[int]:
    """Return where a thing is in the front image, (y, x)."""
    import numpy as np

    camera = base._sensors["base_camera"].get_params()
    place = np.append(np.asarray(thing.pose.p, np.float64).reshape(-1)[:3], 1.0)
    seen = np.asarray(camera["extrinsic_cv"], np.float64).reshape(-1, 4)[:3] @ place
    x, y, depth = np.asarray(camera["intrinsic_cv"], np.float64).reshape(3, 3) @ seen
    return [round(float(y / depth)), round(float(x / depth))]
