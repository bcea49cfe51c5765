"""RoboMME's side of the official simulator: runs in RoboMME's own interpreter, started by path.

That interpreter has numpy < 2 and no package of ours, so this file imports neither, and keeps to
Python 3.11. It answers on an inherited pipe, never on stdout, where ManiSkill prints. No pickles
go through it: those of numpy 1 and 2 differ.
"""

import importlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import queue
import signal
import subprocess
import sys
import threading
import traceback
import urllib.parse
import urllib.request
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

LISTS = {"front": "front_rgb_list", "wrist": "wrist_rgb_list"}
"""Camera name to the key under which RoboMME returns its frames."""


def _neighbour(name: str) -> Any:
    """Load the module in the file beside this one: its folder is not on the path."""
    spec: Any = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


_patches, _drawing = _neighbour("maniskill_patches"), _neighbour("render_on_demand")


def send(
    channel: Connection, head: dict[str, Any], arrays: dict[str, list[Any]] | None = None
) -> None:
    """Send a message: its head as JSON, then the bytes of each of its arrays.

    Args:
        channel: The pipe.
        head: Plain values; `arrays` is taken.
        arrays: Name to at least one numpy array, all of one shape and type; they arrive as one
            array with a new first axis.
    """
    arrays = arrays or {}
    described = []
    for name, items in arrays.items():
        kinds = {(item.dtype.str, item.shape) for item in items}
        if len(kinds) != 1:
            raise ValueError(f"{name}: expected arrays of one shape and type, got {sorted(kinds)}")
        (dtype, shape) = kinds.pop()
        described.append([name, dtype, [len(items), *shape]])
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
    """Patch what differs in this installation; return RoboMME's families and what was patched.

    Or what it lacks, or what cannot be patched, as `problem`.

    Args:
        folder: See `maniskill_patches.apply_patches`.
    """
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


def installed_versions() -> dict[str, str]:
    """Return the versions in this interpreter, each with its commit if that is known."""
    found = {"robomme_python": platform.python_version()}
    for name in ("robomme", "mani_skill", "sapien", "torch", "numpy"):
        key = "robomme" if name == "robomme" else f"robomme_{name}"
        try:
            installed = importlib.metadata.distribution(name)
        except importlib.metadata.PackageNotFoundError:  # it is only on the path
            continue
        origin = json.loads(installed.read_text("direct_url.json") or "{}")
        commit = origin.get("vcs_info", {}).get("commit_id") or _commit(origin.get("url", ""))
        found[key] = f"{installed.version}+{commit}" if commit else installed.version
    return found


def _commit(url: str) -> str | None:
    """Return the commit of the folder that a package was installed from, if it is a checkout."""
    folder = urllib.request.url2pathname(urllib.parse.urlparse(url).path)
    if not url.startswith("file:") or not Path(folder, ".git").exists():
        return None
    command = ["git", "-C", folder, "describe", "--always", "--abbrev=40", "--dirty"]
    try:
        done = subprocess.run(
            [*command, "--exclude=*"], check=True, capture_output=True, text=True, timeout=20
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


class UnknownEpisode(Exception):
    """RoboMME has no such episode."""


class Episodes:
    """One episode at a time, each in an environment of its own.

    A second reset of the same environment gives a different episode.
    """

    def __init__(self) -> None:
        self._env: Any = None
        self._cameras: list[str] = []
        self._subgoals = True
        self._drawing = _drawing.Drawing()

    def reset(
        self,
        family: str,
        split: str,
        index: int,
        max_steps: int,
        cameras: list[str],
        demonstration: bool,
        subgoals: bool,
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Play a demonstration; return what is known of the episode, and frames and states.

        The last frame and state are the first live observation; without `demonstration`, frames
        are of that one only. With `subgoals` these are told.
        """
        self.close()
        builder = _builder()(
            env_id=family, dataset=split, action_space="joint_angle", max_steps=max_steps
        )
        seed, difficulty = builder.resolve_episode(index)
        # RoboMME makes an environment all the same, with a seed that belongs to no episode.
        if seed is None or not difficulty:
            raise UnknownEpisode(f"{family} has {builder.get_episode_num()} {split} episodes")
        self._env = builder.make_env_for_episode(index)
        self._cameras, self._subgoals = cameras, subgoals
        self._draw(demonstration)
        observations, info = self._env.reset()
        goals = info["task_goal"]
        about = {
            "seed": int(seed),
            "difficulty": str(difficulty),
            "goals": [goals] if isinstance(goals, str) else [str(goal) for goal in goals],
            "subgoal": _subgoal(info) if subgoals else None,
        }
        arrays = {"states": _states(observations)}
        if demonstration:
            return about, arrays | self._frames(observations)
        seen = self._drawing.see(self._env, cameras)
        return about, arrays | {camera: [frame] for camera, frame in seen.items()}

    def step(self, action: list[float], observe: bool) -> tuple[dict[str, Any], dict[str, Any]]:
        """Execute an action; return status and subgoal, and one state and, if wanted, one frame."""
        import numpy as np

        self._draw(observe)
        observations, _, _, _, info = self._env.step(np.array(action, np.float32))
        if info["status"] == "error":
            self.close()
            return {"status": "error", "message": str(info.get("error_message"))}, {}
        frames = self._frames(observations) if observe else {}
        shown = {camera: those[-1:] for camera, those in frames.items()}
        told = {
            "status": str(info["status"]),
            "subgoal": _subgoal(info) if self._subgoals else None,
        }
        return told, {**shown, "states": _states(observations)[-1:]}

    def close(self) -> None:
        """Close the environment, if there is one."""
        env, self._env = self._env, None
        if env is not None:
            env.close()
        self._drawing.forget()

    def _draw(self, shown: bool) -> None:
        """Have drawn what comes: what is shown, and the front view, in which subgoals are found."""
        wanted = {*self._cameras} if shown else set()
        wanted |= {"front"} if self._subgoals else set()
        self._drawing.cameras = [_drawing.CAMERAS[camera] for camera in wanted]

    def _frames(self, observations: Any) -> dict[str, Any]:
        import numpy as np

        frames = {}
        for camera in self._cameras:
            frames[camera] = [np.asarray(frame) for frame in observations[LISTS[camera]]]
            if len(frames[camera]) != len(observations["joint_state_list"]):
                raise ValueError(f"{len(frames[camera])} frames of {camera}, others of states")
        return frames


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
        call = episodes.step if head.pop("call") == "step" else episodes.reset
        try:
            answer, found = call(**head)
        except UnknownEpisode as error:
            answer, found = {"unknown": str(error)}, {}
        except Exception as error:
            traceback.print_exc()
            episodes.close()
            answer, found = {"failed": _text(error)}, {}
        send(channel, answer, found)


def _read(channel: Connection, requests: Any) -> None:
    """Queue requests; end this process, whatever it is doing, when the other side is gone."""
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
    """Return states, `(8,) float32` each: seven joints and the way of a finger."""
    import numpy as np

    joints = np.stack(observations["joint_state_list"])[:, :7]
    gripper = np.stack(observations["gripper_state_list"])[:, :1]
    return [*np.concatenate([joints, gripper], axis=1).astype(np.float32)]


def _subgoal(info: dict[str, Any]) -> str | None:
    """Return what RoboMME says is to be done next, with places if it says them; or None."""
    for kind in ("grounded", "simple"):
        if told := info.get(f"{kind}_subgoal_online"):
            return str(told)
    return None


def _text(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"


def main() -> None:
    """Serve on the pipe whose descriptor is the first argument; the second is a folder of ours.

    With `versions` alone, print what is installed.
    """
    if sys.argv[1:] == ["versions"]:
        sys.stdout.write(json.dumps(installed_versions()))  # noqa: TID251 - a program of its own
        return
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the other side's to handle
    os.set_inheritable(int(sys.argv[1]), False)
    serve(Connection(int(sys.argv[1])), Path(sys.argv[2]))


if __name__ == "__main__":
    main()
