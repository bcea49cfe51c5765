"""RoboMME's own loop, a program for RoboMME's interpreter that `robomme.py` runs and times.

Its arguments are the patches of ManiSkill (`maniskill_patches.py`), a folder for them, a family,
and a number of steps. It prints the seconds of a reset and of the steps, the processor seconds of
both, and a digest of all images.
"""

import contextlib
import hashlib
import importlib
import importlib.util
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np


def play(builder: Any, index: int, steps: int) -> dict[str, Any]:
    """Play an episode: the reset, then as many steps along the states of its demonstration."""
    images: list[Any] = []
    worked, began = time.process_time(), time.perf_counter()
    env = builder.make_env_for_episode(index)
    seen, _ = env.reset()
    images += [seen["front_rgb_list"], seen["wrist_rgb_list"]]
    ready = time.perf_counter()
    path = [np.asarray(state)[:7] for state in seen["joint_state_list"]]
    for number in range(steps):
        action = np.append(path[min(number, len(path) - 1)], 1).astype(np.float32)
        seen, _, _, _, info = env.step(action)
        images += [seen["front_rgb_list"][-1:], seen["wrist_rgb_list"][-1:]]
        if info["status"] != "ongoing":
            break
    ended, processor = time.perf_counter(), time.process_time() - worked
    env.close()
    digest = hashlib.sha256()
    for frame in (frame for frames in images for frame in frames):
        digest.update(np.ascontiguousarray(frame))
    return {
        "reset_s": ready - began,
        "step_s": (ended - ready) / (number + 1),
        "processor_s": processor,
        "images": digest.hexdigest(),
    }


def main() -> None:
    """Play the episode."""
    patches, folder, family, steps = sys.argv[1:]
    with contextlib.redirect_stdout(sys.stderr):  # ManiSkill prints there
        spec: Any = importlib.util.spec_from_file_location("patches", patches)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        wrapper = importlib.import_module("robomme.env_record_wrapper")
        module.apply_patches(Path(folder))
        builder = wrapper.BenchmarkEnvBuilder(
            env_id=family, dataset="test", action_space="joint_angle", max_steps=1300
        )
        builder.make_env_for_episode(1).close()  # to be warm
        result = play(builder, 0, int(steps))
    print(json.dumps(result))


if __name__ == "__main__":
    main()
