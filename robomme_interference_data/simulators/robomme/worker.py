"""The worker that runs RoboMME, in RoboMME's own interpreter.

That interpreter has numpy < 2 and not this package, so this file imports neither, and keeps to
Python 3.11. It answers on an inherited pipe, because ManiSkill prints to stdout. Messages are not
pickled, because pickles of numpy 1 and 2 differ.
"""

import importlib
import importlib.util
import json
import os
import queue
import signal
import sys
import threading
import traceback
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

LISTS = {"front": "front_rgb_list", "wrist": "wrist_rgb_list"}
"""Camera name to the key under which RoboMME returns its frames."""

Answer = tuple[dict[str, Any], dict[str, list[Any]]]


def _sibling(name: str) -> Any:
    """Load a module from the file beside this one: its folder is not on the path."""
    spec: Any = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


_patches, _rendering = _sibling("maniskill_patches"), _sibling("render_on_demand")
_facts, _solvers, _steps = _sibling("facts"), _sibling("solvers"), _sibling("steps")


def send(
    channel: Connection, head: dict[str, Any], arrays: dict[str, list[Any]] | None = None
) -> None:
    """Send a message: its head as JSON, then the bytes of each array.

    `arrays` maps a name to numpy arrays of one shape and type; they arrive as one array with a new
    first axis.
    """
    arrays = arrays or {}
    described = []
    for name, items in arrays.items():
        if len({(item.dtype.str, item.shape) for item in items}) != 1:
            raise ValueError(f"{name}: expected arrays of one shape and type")
        described.append([name, items[0].dtype.str, [len(items), *items[0].shape]])
    channel.send_bytes(json.dumps({**head, "arrays": described}).encode())
    for items in arrays.values():
        for item in items:
            channel.send_bytes(item.tobytes())


def receive(channel: Connection) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the head and the arrays, by name, of the next message."""
    head = json.loads(channel.recv_bytes())
    arrays: dict[str, Any] = {}
    for name, dtype, shape in head.pop("arrays"):
        import numpy as np

        arrays[name] = np.empty(shape, dtype)
        for item in arrays[name].reshape(shape[0], -1):
            channel.recv_bytes_into(item)
    return head, arrays


def probe(folder: Path) -> dict[str, Any]:
    """Patch ManiSkill, and return RoboMME's families and the patches, or a `problem`."""
    if importlib.util.find_spec("robomme") is None:
        return {"problem": "robomme is not installed there"}
    try:
        numpy = str(importlib.import_module("numpy").__version__)
        if int(numpy.partition(".")[0]) >= 2:
            return {"problem": f"numpy is {numpy}; RoboMME needs numpy < 2"}
        families = list(_builder().get_task_list())
        return {"families": families, "patches": _patches.apply_patches(folder)}
    except _patches.CannotPatch as error:
        return {"problem": str(error)}
    except Exception as error:
        traceback.print_exc()
        return {"problem": f"robomme cannot be imported: {_text(error)}"}


class Episodes:
    """Runs one episode at a time, each in a new environment.

    A second reset of the same environment would give a different episode.
    """

    def __init__(self) -> None:
        self._env: Any = None
        self._cameras: list[str] = []
        self._subgoals = True
        self._script: Any = None
        self._rendering = _rendering.RenderOnDemand()

    def reset(
        self,
        family: str,
        split: str,
        index: int,
        setup: list[Any] | None,
        max_steps: int,
        cameras: list[str],
        frame_step: int,
        subgoals: bool,
    ) -> Answer:
        """Play a demonstration; return the facts about the episode, its frames and its states.

        `setup` is a seed and a difficulty in place of those in RoboMME's metadata, or None.
        Of the demonstration, every n-th frame is drawn, none if `every` is 0. The last frame and
        state are the first live observation. `scene` and `moments` are what `facts.py` reads, or
        `scene` is None and `unreadable` says why.
        """
        self.close()
        builder = _builder()(
            env_id=family, dataset=split, action_space="joint_angle", max_steps=max_steps
        )
        if setup is not None:
            replaced = dict(zip(("seed", "difficulty"), setup, strict=True))
            builder.metadata_index[family, index] = replaced
        seed, difficulty = builder.resolve_episode(index)
        # RoboMME would make an environment anyway, with a seed that belongs to no episode.
        if seed is None or not difficulty:
            return {"unknown": f"{family} has {builder.get_episode_num()} {split} episodes"}, {}
        self._env = builder.make_env_for_episode(index)
        self._cameras, self._subgoals = cameras, subgoals
        self._rendering.needs_front = self._must_locate if subgoals else bool
        self._select_cameras(frame_step > 0)
        log = _facts.LessonLog(self._env, family)
        kept = _rendering.KeptFrames(self._env.unwrapped, frame_step)
        self._rendering.keep = kept if frame_step else _rendering.always
        observations, info = self._env.reset()
        self._rendering.keep = _rendering.always
        goals = info["task_goal"]
        facts = {
            "seed": int(seed),
            "difficulty": str(difficulty),
            "goals": [goals] if isinstance(goals, str) else [str(goal) for goal in goals],
            "subgoal": self._subgoal(info),
        }
        arrays = {"states": _states(observations)}
        try:  # another version of RoboMME may have other attributes; all else works without them
            facts["scene"] = _facts.read_facts(self._env, family, _steps.pixel)
            arrays["moments"] = log.moments(self._env)
            steps = _steps.STEPS[family](self._env.unwrapped)
            self._script = _solvers.SolverScript(self._env, steps)
        except Exception as error:
            traceback.print_exc()
            facts |= {"scene": None, "unreadable": _text(error)}
        lesson = self._frames(observations) if frame_step else {}
        if lesson:
            kept.check(_facts.kept_steps(self._env)[:-1])
        for camera, image in self._rendering.images(self._env, cameras).items():
            arrays[camera] = [*lesson.get(camera, [])[: -1 : frame_step or 1], image]
        return facts, arrays

    def step(self, action: list[float], observe: bool) -> Answer:
        """Execute an action; return status and subgoal, the state and, if requested, the frames."""
        import numpy as np

        self._select_cameras(observe)
        result = self._env.step(np.array(action, np.float32))
        observations, _, _, _, info = result
        if self._script is not None:
            self._script.stepped(result)
        if info["status"] == "error":
            self.close()
            return {"status": "error", "message": str(info.get("error_message"))}, {}
        frames = self._frames(observations) if observe else {}
        arrays = {"states": _states(observations), **frames}
        facts = {"status": str(info["status"]), "subgoal": self._subgoal(info)}
        return facts, {name: items[-1:] for name, items in arrays.items()}

    def act(self, answer: Any) -> Answer:
        """Return the next action of RoboMME's solvers for an answer; the same one throughout."""
        return {"action": self._script.act(answer)}, {}

    def follow(self, text: str | None, points: list[list[int]], seed: int) -> Answer:
        """Return the next action of RoboMME's solvers; `text` is a new subgoal, or None."""
        return {"action": self._script.follow(text, points, seed)}, {}

    def close(self) -> None:
        """Close the environment, if there is one."""
        env, self._env = self._env, None
        script, self._script = self._script, None
        if script is not None:
            script.close()
        if env is not None:
            env.close()

    def _select_cameras(self, requested: bool) -> None:
        cameras = self._cameras if requested else []
        self._rendering.cameras = [_rendering.CAMERAS[camera] for camera in cameras]

    def _must_locate(self) -> bool:
        """Whether RoboMME needs a front image to locate the things that its subgoal names.

        Once it has found them it keeps their points until the subgoal changes.
        """
        layer = self._env
        while layer is not None and "latched_replacements" not in vars(layer):
            layer = vars(layer).get("env")
        if layer is None:  # another version of RoboMME
            return True
        text = getattr(layer.unwrapped, "current_subgoal_segment", None) or ""
        located = text == layer.last_subgoal_segment and layer.latched_replacements is not None
        return "<" in text and not located

    def _frames(self, observations: Any) -> dict[str, Any]:
        import numpy as np

        return {
            camera: [np.asarray(frame) for frame in observations[LISTS[camera]]]
            for camera in self._cameras
        }

    def _subgoal(self, info: dict[str, Any]) -> str | None:
        """Return RoboMME's current subgoal, with points if it has them."""
        texts = (info.get(f"{kind}_subgoal_online") for kind in ("grounded", "simple"))
        return next((str(text) for text in texts if text), None) if self._subgoals else None


def serve(channel: Connection, folder: Path) -> None:
    """Answer requests until the other side closes the pipe, which ends this process."""
    requests: queue.SimpleQueue[Any] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(channel, requests), daemon=True).start()
    hello = probe(folder)
    send(channel, hello)
    if "problem" in hello:
        return
    episodes = Episodes()
    while True:
        head, _ = requests.get()
        call = getattr(episodes, head.pop("call"))
        try:
            answer, arrays = call(**head)
        except Exception as error:
            traceback.print_exc()
            episodes.close()
            answer, arrays = {"failed": _text(error)}, {}
        send(channel, answer, arrays)


def _read(channel: Connection, requests: Any) -> None:
    """Queue requests; end this process, even during a call, when the other side is gone."""
    try:
        while True:
            requests.put(receive(channel))
    except Exception as error:
        if not isinstance(error, EOFError | OSError):
            traceback.print_exc()
        os._exit(1)


def _builder() -> Any:
    return importlib.import_module("robomme.env_record_wrapper").BenchmarkEnvBuilder


def _states(observations: Any) -> list[Any]:
    """Return states, `(8,) float32` each: seven joints and the opening of a finger."""
    import numpy as np

    joints = np.stack(observations["joint_state_list"])[:, :7]
    gripper = np.stack(observations["gripper_state_list"])[:, :1]
    return [*np.concatenate([joints, gripper], axis=1).astype(np.float32)]


def _text(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"


def main() -> None:
    """Serve on the pipe of a file descriptor; the second argument is a folder for patched files."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the other side handles Ctrl-C
    os.set_inheritable(int(sys.argv[1]), False)
    serve(Connection(int(sys.argv[1])), Path(sys.argv[2]))


if __name__ == "__main__":
    main()
