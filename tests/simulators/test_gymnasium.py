"""The suite's Gymnasium ids: episodes, options and errors."""

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from support.lazy import lazy
from support.messages import raises

import robomme_interference_data.simulators.tabletop  # noqa: F401, registers the ids
from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.errors import InvalidOptionError, NoRendererError

gymnasium, torch, _ = lazy("gymnasium"), lazy("torch"), lazy("mani_skill")
tabletop_env = lazy("robomme_interference_data.simulators.tabletop.env")

SEED = 19803  # of MoveCube/test/3


def make(**options: Any) -> Any:
    """Make an environment whose demonstration is not drawn, which takes seconds."""
    try:
        made = gymnasium.make("tabletop/MoveCube-v1", **options)
    except NoRendererError as error:
        pytest.skip(str(error))
    made.unwrapped.demonstrated = ()
    return made


def run(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", code]
    return subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=240, env=environment or None
    )


def test_the_package_registers_the_families_and_imports_nothing_heavy() -> None:
    code = """
import sys
import robomme_interference_data.cli.simulate_command
assert "gymnasium" not in sys.modules
import robomme_interference_data.simulators.tabletop
assert not {"sapien", "torch", "mani_skill"} & set(sys.modules)
import gymnasium
print(*sorted(name for name in gymnasium.registry if name.startswith("tabletop/")))
"""
    done = run(code)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == sorted(f"tabletop/{family}-v1" for family in FAMILIES)


@pytest.mark.slow
def test_an_episode_is_the_simulators(tabletop: Any) -> None:
    env = make(render_mode="rgb_array")
    seen, info = env.reset(seed=SEED)
    lesson, first, about = tabletop.reset("MoveCube/test/3", demonstration=False)
    assert info["goal"] == about.goal
    assert np.array_equal(info["demonstration"].states, lesson.states)
    for name in ("front", "wrist"):
        assert np.array_equal(seen["sensor_data"][name]["rgb"][0], first.images[name])
    assert np.array_equal(seen["agent"]["qpos"][0, :8], first.state)
    view = env.render()
    assert (view.shape, view.dtype) == ((1, 256, 256, 3), torch.uint8)
    assert np.array_equal(view[0], first.images["front"])
    seen, _, _, _, info = env.step(env.unwrapped.act("oracle"))
    assert not info["success"]
    assert np.array_equal(env.render()[0], seen["sensor_data"]["front"]["rgb"][0])
    env.close()


@pytest.mark.parametrize(
    "options",
    [
        {"obs_mode": "rgbd"},
        {"render_mode": "human"},
        {"control_mode": "pd_ee_delta_pose"},
        {"num_envs": 2},
        {"obs_mode": "rgb", "render": False},
    ],
)
def test_unsupported_options(options: dict[str, Any]) -> None:
    with raises(InvalidOptionError):
        tabletop_env.TabletopEnv(**options)


@pytest.mark.slow
def test_seeds_and_options_of_a_reset() -> None:
    env = make(render=False, control_mode="pd_joint_pos", num_envs=1, obs_mode="state")
    env.unwrapped.demonstrating = False
    for seed, difficulty in ((0, "easy"), (2**32 - 1, "easy"), (2**32 - 2, "hard")):
        seen, info = env.reset(seed=seed)
        assert info["difficulty"] == difficulty  # the remainder by 3
        assert seen.shape == (1, 18)  # positions and velocities of nine joints
    assert env.reset(seed=0, options={"difficulty": "hard"})[1]["difficulty"] == "hard"
    for seed in (-1, 2**32, "a", 0.5):
        with raises(InvalidOptionError):
            env.unwrapped.reset(seed=seed)
    for answer in (3, -4, "push", 1.0):
        with raises(InvalidOptionError):
            env.reset(seed=0, options={"answer": answer})
    for difficulty in ("eesy", 7):
        with raises(InvalidOptionError):
            env.reset(seed=0, options={"difficulty": difficulty})
    env.close()


def test_without_a_vulkan_device_there_is_one_error() -> None:
    code = (
        "from robomme_interference_data.simulators.tabletop.renderer import make_renderer\n"
        "from robomme_interference_data.errors import NoRendererError\n"
        "try: make_renderer()\n"
        "except NoRendererError as error: print(error)\n"
    )
    done = run(code, VK_ICD_FILENAMES="/nonexistent", VK_DRIVER_FILES="/nonexistent")
    assert "no Vulkan device on this machine can render" in done.stdout, done.stderr
    assert "sudo make vulkan" in done.stdout


def test_without_a_writable_home_the_renderer_prints_nothing() -> None:
    code = (
        "from robomme_interference_data.simulators.tabletop.renderer import make_renderer\n"
        "make_renderer()\n"
    )
    caches = dict.fromkeys(("XDG_CACHE_HOME", "MESA_SHADER_CACHE_DIR"), "")
    done = run(code, HOME="/proc/nonexistent", **caches)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
