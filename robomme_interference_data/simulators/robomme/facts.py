"""What RoboMME hides in an episode, read from the attributes of its environment.

Runs in RoboMME's interpreter, as `worker.py` does. `scenes.py` has the rules that use the facts.
"""

from typing import Any

_GONE = 1.0
"""Distance in m beyond which a container was moved out of sight, so that its cube is visible."""


class LessonLog:
    """Logs what RoboMME does at each step of a demonstration; made before the reset."""

    def __init__(self, env: Any, family: str) -> None:
        base = env.unwrapped
        self._rows: dict[int, list[int]] = {}
        self._error: AttributeError | None = None
        execute, containers = base.step, family in ("VideoUnmask", "VideoUnmaskSwap")

        def step(action: Any) -> Any:
            result = execute(action)
            try:
                revealed = containers and abs(float(base.spawned_bins[0].pose.p[0][0])) > _GONE
                number = int(base.elapsed_steps[0])
                self._rows[number] = [number, int(base.current_task_index), int(revealed)]
            except AttributeError as error:  # another version of RoboMME
                self._error = error
            return result

        base.step = step

    def moments(self, env: Any) -> list[Any]:
        """Return a row per recorded frame of the demonstration and for the first live observation.

        `(3,) int64` each: steps since the reset, number of the task, 1 if containers hide nothing.
        """
        import numpy as np

        if self._error is not None:
            raise self._error
        return [np.array(self._rows[step], np.int64) for step in kept_steps(env)]


def kept_steps(env: Any) -> list[int]:
    """Return the steps since the reset of each recorded frame and of the first live observation."""
    return [int(number) for number in _demonstration(env)[4]["elapsed_steps"]]


def read_facts(env: Any, family: str, pixel: Any) -> dict[str, Any]:
    """Return the facts about an episode whose demonstration has been played, as JSON values.

    They are its tasks, the points of its things in the front image, the answer, and what else the
    possible answers depend on. `pixel` returns where a thing is in the image (`steps.py`).
    """
    base = env.unwrapped
    name, read = _READ[family]
    things = list(getattr(base, name)) if name else []
    if family == "RouteStick":
        things = [things[number] for number in base.route_button_indices]
    tasks = [[str(task["name"]), bool(task["demonstration"])] for task in base.task_list]
    points = [pixel(base, thing) for thing in things]
    return {"tasks": tasks, "points": points, **read(base, things)}


def _unmask(base: Any, bins: list[Any]) -> dict[str, Any]:
    hiding = getattr(base, "selected_bins", bins)
    picked = sum("pick up" in str(task["name"]) for task in base.task_list)
    colors = [str(color) for color in base.color_names[:picked]]
    answer = [_index(bins, actor) for actor in hiding[:picked]]
    return {"answer": answer, "colors": colors, "swaps": _scheduled(base, bins)}


def _repick(base: Any, cubes: list[Any]) -> dict[str, Any]:
    return {"answer": _index(cubes, base.target_cube_1), "swaps": _scheduled(base, cubes)}


def _place_button(base: Any, targets: list[Any]) -> dict[str, Any]:
    answer = _index(targets, base.target_target)
    visits = [_index(targets, base.target_0), _index(targets, base.target_1)]
    asked = {"before": 0, "after": 1}[base.target_target_language]
    return {"answer": answer, "visits": visits, "asked": asked, "swaps": _swapped(base, targets)}


def _place_order(base: Any, targets: list[Any]) -> dict[str, Any]:
    answer = _index(targets, base.target_target)
    visits = [_index(targets, target) for target in base.which_targets_to_pick]
    asked = int(base.which_in_subset) - 1
    return {"answer": answer, "visits": visits, "asked": asked, "swaps": _swapped(base, targets)}


def _move(base: Any, things: list[Any]) -> dict[str, Any]:
    return {"answer": str(base.way)}


def _insert(base: Any, pegs: list[Any]) -> dict[str, Any]:
    end, side = str(base.grasp_target_distance), str(base.insert_way)
    return {"answer": [_index(pegs, base.peg), end, side]}


def _pattern(base: Any, buttons: list[Any]) -> dict[str, Any]:
    return {"answer": [_index(buttons, button) for button in base.selected_buttons]}


def _route(base: Any, targets: list[Any]) -> dict[str, Any]:
    route = [_index(targets, button) for button in base.selected_buttons]
    return {"answer": [route, [str(turn) for turn in base.swing_directions]]}


_READ = {
    "VideoUnmask": ("spawned_bins", _unmask),
    "VideoUnmaskSwap": ("spawned_bins", _unmask),
    "VideoRepick": ("spawned_cubes", _repick),
    "VideoPlaceButton": ("targets", _place_button),
    "VideoPlaceOrder": ("targets", _place_order),
    "MoveCube": ("", _move),
    "InsertPeg": ("pegs", _insert),
    "PatternLock": ("buttons_grid", _pattern),
    "RouteStick": ("buttons_grid", _route),
}
"""Family to the attribute that lists the things of its answers, and what returns its facts."""


def _scheduled(base: Any, things: list[Any]) -> list[Any]:
    """Return the swaps of a schedule: two things, first step and last step each."""
    return [
        [_index(things, one), _index(things, other), int(start), int(stop)]
        for one, other, start, stop in getattr(base, "swap_schedule", None) or []
    ]


def _swapped(base: Any, targets: list[Any]) -> list[Any]:
    """Return the swap of two targets, if there is one."""
    if base.swap_target_a is None:
        return []
    pair = [_index(targets, target) for target in (base.swap_target_a, base.swap_target_b)]
    return [[*pair, int(base.start_step), int(base.end_step)]]


def _index(things: list[Any], thing: Any) -> int:
    """Return the number of a thing, by identity."""
    return next(number for number, candidate in enumerate(things) if candidate is thing)


def _demonstration(env: Any) -> Any:
    """Return what RoboMME's wrapper recorded: observations, …, infos, a list per key."""
    while "demonstration_data" not in vars(env):
        env = env.env
    return env.demonstration_data
