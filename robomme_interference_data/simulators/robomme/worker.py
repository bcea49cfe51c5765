"""The worker that runs RoboMME, in RoboMME's own interpreter; see `RemoteSimulator`.

That interpreter has numpy < 2 and not this package, so this file does not import it, and keeps to
Python 3.11.
"""

import importlib
import importlib.metadata
import importlib.util
import traceback
from contextlib import suppress
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

NEEDED = {
    "cv2": "opencv-python",
    "defusedxml": "defusedxml",
    "gymnasium": "gymnasium==0.29.1",
    "h5py": "h5py",
    "imageio": "imageio",
    "mani_skill": "mani-skill==3.0.1",
    "matplotlib": "matplotlib",
    "mplib": "mplib==0.1.1",
    "pytorch_kinematics": "pytorch-kinematics==0.7.6",
    "sapien": "sapien",
    "scipy": "scipy",
    "torch": "torch",
    "transforms3d": "transforms3d",
}
"""Modules that RoboMME imports, or its ManiSkill, to the distributions that contain them."""


class CannotRun(ImportError):
    """This interpreter cannot run RoboMME.

    The program that runs this file reads `install`, distributions that it needs, or `fix`.
    """

    def __init__(self, why: str, *install: str, fix: str | None = None):
        super().__init__(why)
        self.install, self.fix = install, fix


def check_versions() -> None:
    """Check the versions of libraries of which RoboMME needs an older one."""
    numpy = str(importlib.import_module("numpy").__version__)
    if int(numpy.partition(".")[0]) >= 2:
        raise CannotRun(f"numpy is {numpy}; RoboMME needs numpy < 2", "numpy<2")
    with suppress(importlib.metadata.PackageNotFoundError):
        gymnasium = importlib.metadata.version("gymnasium")
        if not gymnasium.startswith("0.29."):
            raise CannotRun(
                f"gymnasium is {gymnasium}; RoboMME needs gymnasium 0.29", NEEDED["gymnasium"]
            )


def families() -> list[str]:
    """Return RoboMME's families."""
    try:
        return list(_builder().get_task_list())
    except Exception as error:
        missing = _missing(error) if isinstance(error, ModuleNotFoundError) else {}
        why = f"robomme cannot be imported: {_text(error)}"
        if missing:
            why = f"robomme needs modules that are missing: {', '.join(missing)}"
        raise CannotRun(why, *missing.values()) from error


def _missing(error: ModuleNotFoundError) -> dict[str, str]:
    """Return all missing modules with their distributions, the one of an error first.

    None if RoboMME itself lacks a part, which no index has.
    """
    first = str(error.name).partition(".")[0]
    if first == "robomme":
        return {}
    further = {name: NEEDED[name] for name in NEEDED if importlib.util.find_spec(name) is None}
    return {first: NEEDED.get(first, first), **further}


class Episodes:
    """Runs one episode at a time, each in a new environment.

    A second reset of the same environment would give a different episode.

    Args:
        cameras: Names of the cameras to draw.
        subgoals: Whether to report subgoals, for which RoboMME draws its front camera.
        max_steps: After so many steps an episode is late.
        cache: Folder for patched files.
    """

    def __init__(self, cameras: list[str], subgoals: bool, max_steps: int, cache: str):
        if importlib.util.find_spec("robomme") is None:
            raise CannotRun("robomme is not installed there")
        check_versions()
        self._families = families()
        try:
            self._patches = _patches.apply_patches(Path(cache))
        except _patches.CannotPatch as error:
            raise CannotRun(str(error)) from error
        except _patches.CannotWrite as error:
            fix = "Free space there, or set XDG_CACHE_HOME to another folder."
            raise CannotRun(str(error), fix=fix) from error
        self._cameras, self._subgoals, self._max_steps = cameras, subgoals, max_steps
        self._env: Any = None
        self._script: Any = None
        self._rendering = _rendering.RenderOnDemand()

    def describe(self) -> Answer:
        """Return RoboMME's families, and what was patched."""
        return {"families": self._families, "patches": self._patches}, {}

    def reset(
        self, family: str, split: str, index: int, frame_step: int, setup: list[Any] | None
    ) -> Answer:
        """Play a demonstration; return the facts about the episode, its frames and its states.

        `setup` is a seed and a difficulty in place of those in RoboMME's metadata, or None.
        `scene` and `moments` are what `facts.py` reads, or `scene` is None and `unreadable` says
        why.
        """
        self.close()
        builder = _builder()(
            env_id=family, dataset=split, action_space="joint_angle", max_steps=self._max_steps
        )
        if setup is not None:
            replaced = dict(zip(("seed", "difficulty"), setup, strict=True))
            builder.metadata_index[family, index] = replaced
        seed, difficulty = builder.resolve_episode(index)
        # RoboMME would make an environment anyway, with a seed that belongs to no episode.
        if seed is None or not difficulty:
            return {"unknown": f"{family} has {builder.get_episode_num()} {split} episodes"}, {}
        self._env = builder.make_env_for_episode(index)
        self._rendering.needs_front = self._must_locate if self._subgoals else bool
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
        for camera, image in self._rendering.images(self._env, self._cameras).items():
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
