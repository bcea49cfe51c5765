"""Do steps of a task with the motion planners that play RoboMME's own demonstrations.

Runs in RoboMME's interpreter, as `worker.py` does. The solvers step an environment themselves; here
they run in a thread that hands out one action at a time, so that an episode is stepped from outside
as with any other policy.
"""

import importlib
import queue
import threading
from typing import Any

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
        self.actions: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.results: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)

    def step(self, action: Any) -> Any:
        self.actions.put(action)
        result = self.results.get()
        if result is None:
            raise _Abandoned
        return result


class SolverScript:
    """The actions of RoboMME's solvers in one live episode.

    Args:
        env: The environment, after the reset.
        steps: Its `Steps`; see `steps.py`.
    """

    def __init__(self, env: Any, steps: Any) -> None:
        self._env, self._steps = _Handing(env), steps
        self._planner: Any = None  # one, because it knows if the gripper holds something
        self._run: _SolverThread | None = None
        self._text: str | None = None  # of the subgoal that is followed
        self._next: tuple[str, list[list[int]]] | None = None

    def act(self, answer: Any) -> list[float]:
        """Return the next action for an answer, 8 numbers.

        It is the last one again until it was executed, and when all is done.

        Raises:
            NoPlanError: The planners find no motion.
        """
        if self._run is None:
            self._run = self._start(self._steps.of_answer(answer))
        return self._run.act()

    def follow(self, text: str | None, points: list[list[int]], seed: int) -> list[float]:
        """Return the next action towards a subgoal, 8 numbers; see `act`.

        As RoboMME's own wrapper does, it finishes a step before it begins the next one, for which
        it waits. A subgoal with the words of the step under way means that step; written after its
        end, it means another one. A subgoal that is not understood changes nothing; at first, the
        arm holds its pose.

        Args:
            text: The words of a subgoal that was just written; None if none was.
            points: Its points.
            seed: Seed for a draw among several things that it may mean.
        """
        done = self._run is None or self._run.done
        if text is not None and (done or text != self._text):
            self._next = text, points
        if done and self._next is not None:
            (self._text, points), self._next = self._next, None
            step = self._steps.of_subgoal(self._text, points, seed)
            if step is not None:
                self._run = self._start([step])
        if self._run is not None:
            return self._run.act()
        joints = self._env.unwrapped.agent.robot.qpos[0]
        return [*map(float, joints[:7]), 1.0]

    def _start(self, steps: Any) -> "_SolverThread":
        solvers = importlib.import_module("robomme.robomme_env.utils.subgoal_planner_func")
        planner = self._planner = self._planner or _planner(self._env, stick=self._steps.stick)

        def solve() -> None:
            for name, arguments in steps:
                getattr(solvers, name)(self._env, planner, **arguments)

        return _SolverThread(self._env, solve)

    def stepped(self, result: Any) -> None:
        """Keep what the environment returned for the last action, for the solvers."""
        if self._run is not None:
            self._run.result = result

    def close(self) -> None:
        """End the solvers' thread."""
        if self._run is not None:
            self._run.close()


class _SolverThread:
    """Solvers in a thread.

    Attributes:
        result: What the environment returned for their last action, if that was executed.
        done: Whether they have finished, or failed.
    """

    def __init__(self, env: _Handing, solve: Any) -> None:
        self._env, self.result, self.done = env, None, False
        self._last: list[float] | None = None
        self._thread = threading.Thread(target=self._solve, args=(solve,), daemon=True)
        self._thread.start()

    def act(self) -> list[float]:
        """Return the next action; see `SolverScript.act`."""
        if self._last is not None:
            if self.done or self.result is None:
                return self._last
            self._env.results.put(self.result)
            self.result = None
        made = self._env.actions.get()
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
            self._env.results.put(None)
            self._thread.join(0.2)

    def _solve(self, solve: Any) -> None:
        made = None
        try:
            solve()
        except _Abandoned:
            return
        except Exception as error:
            made = error
        self._env.actions.put(made)


def _planner(env: Any, *, stick: bool) -> Any:
    """Return RoboMME's planner, which tries again where a screw motion fails."""
    module = importlib.import_module("robomme.robomme_env.utils.planner_fail_safe")
    arm = "Stick" if stick else "Arm"
    own_options = {"joint_vel_limits": 0.3} if stick else {}
    planner = getattr(module, f"FailAwarePanda{arm}MotionPlanningSolver")(
        env,
        debug=False,
        vis=False,
        base_pose=env.unwrapped.agent.robot.pose,
        visualize_target_grasp_pose=False,
        print_env_info=False,
        **own_options,
    )
    straight, search = planner.move_to_pose_with_screw, planner.move_to_pose_with_RRTStar

    def move(*args: Any, **named: Any) -> Any:
        for plan in (straight, search):
            for _ in range(_TRIES):
                try:
                    result = plan(*args, **named)
                except module.ScrewPlanFailure:
                    continue
                if not (isinstance(result, int) and result == -1):
                    return result
        raise NoPlanError(f"no motion found in {2 * _TRIES} attempts")

    planner.move_to_pose_with_screw = move
    return planner
