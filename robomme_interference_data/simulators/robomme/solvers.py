"""Act out an answer with the motion planners that play RoboMME's own demonstrations.

Runs in RoboMME's interpreter, as `worker.py` does. The solvers step an environment themselves; here
they run in a thread that hands out one action at a time, so that an episode is stepped from outside
as with any other policy.
"""

import importlib
import queue
import threading
from typing import Any

subgoals: Any = None
"""The module `subgoals.py`; `worker.py` sets it, because these files cannot import each other."""

_STICK = ("PatternLock", "RouteStick")
_TRIES = 3
"""Attempts of each planner: a straight screw motion first, then a random search."""


class NoPlanError(RuntimeError):
    """The planners find no motion to a pose."""


class _Abandoned(BaseException):
    """The episode is over; raised in the solvers' thread to end it."""


class _Handing:
    """The environment for the solvers, in which a step hands out its action and waits."""

    def __init__(self, env: Any) -> None:
        self._env = env
        self.run: _Run | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)

    def step(self, action: Any) -> Any:
        assert self.run is not None
        self.run.actions.put(action)
        result = self.run.results.get()
        if result is None:
            raise _Abandoned
        return result


class Script:
    """The actions of RoboMME's solvers in one live episode.

    Args:
        env: The environment, after the reset.
        family: Its family.
    """

    def __init__(self, env: Any, family: str) -> None:
        self._env, self._family = _Handing(env), family
        self._solver: _Solver | None = None  # one, because its planner knows if the gripper holds
        self._steps = subgoals.Steps(env.unwrapped, family)
        self._run: _Run | None = None

    def act(self, answer: Any) -> list[float]:
        """Return the next action for an answer, 8 numbers.

        It is the last one again until it was executed, and when all is done.

        Raises:
            NoPlanError: The planners find no motion.
        """
        if self._run is None:
            self._run = self._start(_SOLVE[self._family], answer)
        return self._run.act()

    def follow(self, text: str, points: list[list[int]], seed: int) -> list[float]:
        """Return the next action towards a subgoal, 8 numbers; see `act`.

        As RoboMME's own wrapper does, it finishes a step before it begins the next one, which may
        have the same words. A subgoal that is not understood changes nothing; at first, the arm
        holds its pose.
        """
        if self._run is None or self._run.done:
            step = self._steps.find(text, points, seed)
            if step is not None:
                self._run = self._start(_do_step, step)
        if self._run is not None:
            return self._run.act()
        joints = self._env.unwrapped.agent.robot.qpos[0]
        return [*map(float, joints[:7]), 1.0]

    def _start(self, solve: Any, what: Any) -> "_Run":
        if self._solver is None:
            self._solver = _Solver(self._env, self._family)
        self._env.run = _Run(lambda: solve(self._solver, self._env.unwrapped, what))
        return self._env.run.start()

    def stepped(self, result: Any) -> None:
        """Keep what the environment returned for the last action, for the solvers."""
        if self._run is not None:
            self._run.result = result

    def close(self) -> None:
        """End the solvers' thread."""
        if self._run is not None:
            self._run.close()


class _Run:
    """Solvers in a thread.

    Attributes:
        result: What the environment returned for their last action, if that was executed.
        done: Whether they have finished, or failed.
    """

    def __init__(self, solve: Any) -> None:
        self.result: Any = None
        self.actions: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.results: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._last: list[float] | None = None
        self.done = False
        self._thread = threading.Thread(target=self._solve, args=(solve,), daemon=True)

    def start(self) -> "_Run":
        """Start the thread."""
        self._thread.start()
        return self

    def act(self) -> list[float]:
        """Return the next action; see `Script.act`."""
        if self._last is not None:
            if self.done or self.result is None:
                return self._last
            self.results.put(self.result)
            self.result = None
        made = self.actions.get()
        if isinstance(made, Exception):
            self.done = True
            raise made
        self.done = made is None
        if made is not None:
            self._last = [*map(float, made), -1.0][:8]
        if self._last is None:
            raise NoPlanError("the solvers moved nowhere")
        return self._last

    def close(self) -> None:
        """End the thread."""
        while self._thread.is_alive():
            self.results.put(None)
            self._thread.join(0.2)

    def _solve(self, solve: Any) -> None:
        made = None
        try:
            solve()
        except _Abandoned:
            return
        except Exception as error:
            made = error
        self.actions.put(made)


class _Solver:
    """RoboMME's solvers, by name, bound to an environment and its motion planner."""

    def __init__(self, env: Any, family: str) -> None:
        self._env, self._planner = env, _planner(env, stick=family in _STICK)
        self._module = importlib.import_module("robomme.robomme_env.utils.subgoal_planner_func")

    def __call__(self, name: str, *args: Any, **named: Any) -> None:
        getattr(self._module, name)(self._env, self._planner, *args, **named)


def _planner(env: Any, *, stick: bool) -> Any:
    """Return RoboMME's planner, which tries again where a screw motion fails."""
    module = importlib.import_module("robomme.robomme_env.utils.planner_fail_safe")
    arm = "Stick" if stick else "Arm"
    planner = getattr(module, f"FailAwarePanda{arm}MotionPlanningSolver")(
        env,
        debug=False,
        vis=False,
        base_pose=env.unwrapped.agent.robot.pose,
        visualize_target_grasp_pose=False,
        print_env_info=False,
        **({"joint_vel_limits": 0.3} if stick else {}),
    )
    straight, search = planner.move_to_pose_with_screw, planner.move_to_pose_with_RRTStar

    def move(*args: Any, **named: Any) -> Any:
        for plan in [straight] * _TRIES + [search] * _TRIES:
            try:
                result = plan(*args, **named)
            except module.ScrewPlanFailure:
                continue
            if not (isinstance(result, int) and result == -1):
                return result
        raise NoPlanError(f"no motion found in {2 * _TRIES} attempts")

    planner.move_to_pose_with_screw = move
    return planner


def _do_step(solve: _Solver, base: Any, step: Any) -> None:
    """Do one step of a task: the name of its solver, and the solver's arguments."""
    name, arguments = step
    solve(name, **arguments)


def _unmask(solve: _Solver, base: Any, answer: list[int]) -> None:
    for number, container in enumerate(answer):
        if number:
            solve("solve_putdown_whenhold")
        solve("solve_pickup_bin", obj=base.spawned_bins[container])


def _repick(solve: _Solver, base: Any, answer: int) -> None:
    for _ in range(int(base.num_repeats)):
        solve("solve_pickup", obj=base.spawned_cubes[answer])
        solve("solve_putdown_whenhold", release_z=0.01)
    solve("solve_button", obj=base.button_left)


def _place(solve: _Solver, base: Any, answer: int) -> None:
    solve("solve_pickup", obj=base.target_cube)
    solve("solve_putonto_whenhold", target=base.targets[answer])


def _move(solve: _Solver, base: Any, answer: str) -> None:
    if answer == "peg_push":
        solve("grasp_and_lift_peg_side", base.grasp_target)
        side, end = base.direction2, base.obj_flag
        solve("solve_push_to_target_with_peg", base.cube, base.goal_site, side, end)
    elif answer == "gripper_push":
        solve("solve_push_to_target", base.cube, base.goal_site)
    else:
        solve("solve_pickup", obj=base.cube)
        solve("solve_putonto_whenhold", target=base.goal_site)


def _insert(solve: _Solver, base: Any, answer: list[Any]) -> None:
    number, end, side = answer
    held = subgoals.ends_of(base, number, end)
    _do_step(solve, base, subgoals.pick_up_peg(held))
    _do_step(solve, base, subgoals.insert_peg(base, held, side))


def _pattern(solve: _Solver, base: Any, answer: list[int]) -> None:
    for button in answer[1:]:
        solve("solve_swingonto", target=base.buttons_grid[button])


def _route(solve: _Solver, base: Any, answer: list[Any]) -> None:
    route, turns = answer
    for target, turn in zip(route[1:], turns, strict=True):
        button = base.buttons_grid[base.route_button_indices[target]]
        solve("solve_swingonto_withDirection", target=button, radius=0.2, direction=turn)


_SOLVE = {
    "VideoUnmask": _unmask,
    "VideoUnmaskSwap": _unmask,
    "VideoRepick": _repick,
    "VideoPlaceButton": _place,
    "VideoPlaceOrder": _place,
    "MoveCube": _move,
    "InsertPeg": _insert,
    "PatternLock": _pattern,
    "RouteStick": _route,
}
