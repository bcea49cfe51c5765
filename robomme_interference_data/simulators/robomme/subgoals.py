"""Find the step of a task that a subgoal names, by its words and points.

Runs in RoboMME's interpreter, as `worker.py` does. A step is the name of one of RoboMME's solvers
and the solver's arguments.
"""

import re
from typing import Any

_ALONG = {"forward": 1.0, "backward": -1.0}
_ACROSS = {"left": 1.0, "right": -1.0}


class Steps:
    """The steps of one live episode.

    Args:
        base: RoboMME's environment, unwrapped.
        family: Its family.
    """

    def __init__(self, base: Any, family: str) -> None:
        self._base, self._find = base, _FIND[family]
        self._held: tuple[Any, Any] | None = None  # ends of the peg that was picked up last

    def find(self, text: str, points: list[list[int]], seed: int) -> Any:
        """Return the step that a subgoal names, or None.

        Of several things that the words may mean, the one nearest to the point counts; without a
        point one is drawn from the seed.
        """
        words = " ".join(text.lower().replace("<point>", " ").split())
        return self._find(self, self._base, words, points, seed)

    def thing(self, things: list[Any], points: list[list[int]], seed: int) -> int:
        """Return the number of the thing that a point shows, or of a random one."""
        import numpy as np

        if not points:
            return int(np.random.RandomState([seed, len(things)]).randint(len(things)))
        places = np.array([pixel(self._base, thing) for thing in things])
        return int(np.argmin(((places - np.array(points[0])) ** 2).sum(axis=1)))

    def _unmask(self, base: Any, words: str, points: Any, seed: int) -> Any:
        if "pick up" in words:
            chosen = self.thing(base.spawned_bins, points, seed)
            return "solve_pickup_bin", {"obj": base.spawned_bins[chosen]}
        return ("solve_putdown_whenhold", {}) if re.search("put|drop", words) else None

    def _repick(self, base: Any, words: str, points: Any, seed: int) -> Any:
        if "button" in words:
            return "solve_button", {"obj": base.button_left}
        if "pick up" in words:
            chosen = self.thing(base.spawned_cubes, points, seed)
            return "solve_pickup", {"obj": base.spawned_cubes[chosen]}
        put = re.search("put|drop", words)
        return ("solve_putdown_whenhold", {"release_z": 0.01}) if put else None

    def _place(self, base: Any, words: str, points: Any, seed: int) -> Any:
        if "pick up" in words:  # the goal names the cube
            cubes = base.all_cubes if points else [base.target_cube]
            return "solve_pickup", {"obj": cubes[self.thing(cubes, points, seed)]}
        if re.search("place|put|drop", words):
            chosen = self.thing(base.targets, points, seed)
            return "solve_putonto_whenhold", {"target": base.targets[chosen]}
        return None

    def _move_cube(self, base: Any, words: str, points: Any, seed: int) -> Any:
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
        put = re.search("place|put|drop", words)
        return ("solve_putonto_whenhold", {"target": base.goal_site}) if put else None

    def _insert(self, base: Any, words: str, points: Any, seed: int) -> Any:
        if "pick up" in words:
            end = "far" if "far" in words else "near"
            self._held = ends_of(base, self.thing(base.pegs, points, seed), end)
            return pick_up_peg(self._held)
        side = re.search("left|right", words)
        if side is None or self._held is None:
            return None
        return insert_peg(base, self._held, side[0])

    def _pattern(self, base: Any, words: str, points: Any, seed: int) -> Any:
        import numpy as np

        named = re.search(r"(forward|backward)?[- ]?(left|right)?$", words)
        x = _ALONG.get((named and named[1]) or "", 0.0)
        y = _ACROSS.get((named and named[2]) or "", 0.0)
        if not x and not y:
            return None
        spots = np.array([one.pose.p[0][:2].tolist() for one in base.buttons_grid])
        at = spots[_nearest(spots, base)]
        spacing = float(np.abs(spots[1] - spots[0]).max())
        goal = at + spacing * np.array([x, y])
        chosen = int(((spots - goal) ** 2).sum(axis=1).argmin())
        return "solve_swingonto", {"target": base.buttons_grid[chosen]}

    def _route(self, base: Any, words: str, points: Any, seed: int) -> Any:
        import numpy as np

        side, turn = re.search(r"\b(left|right)\b", words), re.search("(counter)?clockwise", words)
        if side is None or turn is None:
            return None
        targets = [base.buttons_grid[number] for number in base.route_button_indices]
        at = _nearest(np.array([one.pose.p[0][:2].tolist() for one in targets]), base)
        to = min(max(at + int(_ACROSS[side[0]]), 0), len(targets) - 1)
        named = {"target": targets[to], "radius": 0.2, "direction": turn[0]}
        return "solve_swingonto_withDirection", named


_FIND = {
    "VideoUnmask": Steps._unmask,
    "VideoUnmaskSwap": Steps._unmask,
    "VideoRepick": Steps._repick,
    "VideoPlaceButton": Steps._place,
    "VideoPlaceOrder": Steps._place,
    "MoveCube": Steps._move_cube,
    "InsertPeg": Steps._insert,
    "PatternLock": Steps._pattern,
    "RouteStick": Steps._route,
}


def ends_of(base: Any, number: int, end: str) -> tuple[Any, Any]:
    """Return the end of a peg by which it is grasped, the arm's `near` or `far`, and the other."""
    ends = [base.peg_heads[number], base.peg_tails[number]]
    arm = float(base.agent.robot.pose.p[0][0])
    ends.sort(key=lambda link: abs(float(link.pose.p[0][0]) - arm))  # the head if both are as near
    grasped, inserted = ends if end == "near" else reversed(ends)
    return grasped, inserted


def pick_up_peg(held: tuple[Any, Any]) -> Any:
    """Return the step that grasps a peg by its end."""
    return "grasp_and_lift_peg_side", {"obj": held[0]}


def insert_peg(base: Any, held: tuple[Any, Any], side: str) -> Any:
    """Return the step that inserts a held peg from the left or right side of the box."""
    grasped, inserted = held
    flags = {
        "direction": -1 if side == "left" else 1,
        "obj": -1 if any(grasped is head for head in base.peg_heads) else 1,
    }
    return "insert_peg", {**flags, "insert_obj": inserted, "cut_retreat": True}


def pixel(base: Any, thing: Any) -> list[int]:
    """Return where a thing is in the front image, (y, x)."""
    import numpy as np

    camera = base._sensors["base_camera"].get_params()
    place = np.append(np.asarray(thing.pose.p, np.float64).reshape(-1)[:3], 1.0)
    seen = np.asarray(camera["extrinsic_cv"], np.float64).reshape(-1, 4)[:3] @ place
    x, y, depth = np.asarray(camera["intrinsic_cv"], np.float64).reshape(3, 3) @ seen
    return [round(float(y / depth)), round(float(x / depth))]


def _nearest(spots: Any, base: Any) -> int:
    """Return the number of the spot nearest to the arm's tip."""
    tip = base.agent.tcp.pose.p[0][:2].numpy()
    return int(((spots - tip) ** 2).sum(axis=1).argmin())
