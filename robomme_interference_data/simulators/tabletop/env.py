"""The ManiSkill environment behind all nine families."""

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.structs.types import SimConfig
from numpy.typing import NDArray

from robomme_interference_data.constants import DIFFICULTIES, FAMILIES, FPS
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.schema.evidence import spans_of_parts
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.schema.shifts import Shift
from robomme_interference_data.schema.subgoal import Pixel, Subgoal
from robomme_interference_data.simulators.episode import CAMERAS, Demonstration, Observation

from .bodies import Color, SceneBuilder
from .camera import FRONT_EYE, FRONT_TARGET, FRONT_VIEW, SIZE, to_pixels
from .drawing import PANDA, SHADER, draw_low_polygon
from .episodes import difficulty_of, turn_of
from .families import draw_episode
from .family import Layout
from .motion import BASE, Arm, Point, Script
from .renderer import make_renderer

if TYPE_CHECKING:
    from .scene_shift import SceneShift
    from .subgoal_follower import SubgoalFollower

_POSSIBLE: dict[str, tuple[Any, ...]] = {
    "num_envs": (1,),
    "obs_mode": ("rgb", "state", "state_dict", "none"),
    "reward_mode": ("sparse", "none"),
    "control_mode": ("pd_joint_pos",),
    "render_mode": (None, "rgb_array", "sensors"),
    "robot_uids": (PANDA,),
    "sim_backend": ("physx_cpu", "cpu", "auto"),
}
# Without rendering.
_POSSIBLE_BLIND = _POSSIBLE | {"obs_mode": ("none", "state", "state_dict"), "render_mode": (None,)}


class TabletopEnv(BaseEnv):  # type: ignore[misc]
    """One family's episodes: `reset(seed=s)` plays the demonstration of that seed's episode.

    `reset` takes seeds from 0 to 2**32 - 1 and the options `difficulty` and `answer`, the index of
    a hidden answer that replaces the seed's own. Its info holds `goal`, `goals`, `difficulty` and
    `demonstration`.

    Args:
        family: Task family; may also be set before a reset.
        render: Whether to render; without, observations hold no images.
        **options: ManiSkill's options, limited to one environment on the CPU, joint targets as
            actions, `obs_mode` `rgb`, `state`, `state_dict` or `none`, `render_mode` `rgb_array`
            (the front view) or `sensors` (both cameras), and a sparse reward or none.

    Attributes:
        demonstrated: Cameras that render the demonstration.
        frame_step: They render every n-th frame of it.
        demonstrating: Whether a reset plays the demonstration at all.
        shift: Shift of the live scene.
        table: Color of every table; None for each family's own.
    """

    SUPPORTED_ROBOTS = [PANDA]  # noqa: RUF012, ManiSkill's name and type
    metadata = {"render_modes": ["rgb_array", "sensors"]}  # noqa: RUF012, Gymnasium's

    def __init__(self, family: str = FAMILIES[0], render: bool = True, **options: Any):
        self.family = family
        self.drawing = render
        self.demonstrated: Sequence[str] = CAMERAS
        self.frame_step = 1
        self.demonstrating = False
        self.shift: Shift | None = None
        self.table: Color | None = None
        self._scene_shift: SceneShift | None = None  # of the running episode, once it has a shift
        for name, values in (_POSSIBLE if render else _POSSIBLE_BLIND).items():
            if options.setdefault(name, values[0]) not in values:
                expected = " or ".join(map(repr, values))
                raise InvalidOptionError.expected(name, options[name], expected)
        options.setdefault("render_backend", "cpu" if render else "none")
        make_renderer()  # sapien needs one even without rendering
        super().__init__(**options)
        self.demonstrating = True

    # --- ManiSkill's hooks ---------------------------------------------------------------------

    @property
    def _default_sim_config(self) -> SimConfig:
        return SimConfig(sim_freq=10 * FPS, control_freq=FPS)

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        pose = sapien_utils.look_at(eye=FRONT_EYE, target=FRONT_TARGET)
        view = {"fov": FRONT_VIEW, "near": 0.01, "far": 10, "shader_config": SHADER}
        return [CameraConfig("front", pose, SIZE, SIZE, **view)]

    def _load_agent(self, options: dict[str, Any]) -> None:
        super()._load_agent(options, sapien.Pose(BASE))
        if self.scene.can_render():
            draw_low_polygon(self.agent.robot._objs[0], self.layout.stick)

    def _load_scene(self, options: dict[str, Any]) -> None:
        self.builder = SceneBuilder(self.scene)
        self.builder.room(self.table or self.layout.table, self.layout.floor)
        self.layout.build(self.builder)

    def _load_lighting(self, options: dict[str, Any]) -> None:
        self.scene.set_ambient_light([0.45, 0.45, 0.45])
        self.scene.add_directional_light([-0.5, 0.4, -1], [0.75, 0.75, 0.72])
        self.scene.add_directional_light([0.4, -0.7, -0.6], [0.25, 0.25, 0.28])

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict[str, Any]) -> None:
        self.arm = Arm(self.agent.robot._objs[0], self.layout.pace, self.layout.stick)
        self.status = Status.ONGOING
        self._scripts: dict[str, Script] = {}
        self._follower: SubgoalFollower | None = None
        self.rest()

    def _after_control_step(self) -> None:
        self.layout.react(self.arm)

    def evaluate(self) -> dict[str, torch.Tensor]:
        """Return `success` and `fail` as ManiSkill expects them."""
        return {
            "success": torch.tensor([self.status is Status.SUCCESS]),
            "fail": torch.tensor([self.status is Status.FAIL]),
        }

    # --- an episode ----------------------------------------------------------------------------

    def reset(
        self, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start the episode of a seed: play its demonstration, then set up the live scene."""
        options = options or {}
        if seed is None:
            seed = int(self._main_rng.randint(2**31))
        number = _index(np.ravel(seed)[0], 0, 2**32, "seed")
        difficulty = options.get("difficulty", difficulty_of(number))
        if difficulty not in DIFFICULTIES:
            raise InvalidOptionError.one_of("difficulty", difficulty, DIFFICULTIES)
        episode = draw_episode(self.family, number, difficulty)
        answers, count = episode.answers, len(episode.answers)
        answer = _index(options.get("answer", turn_of(number, count)), -count, count, "answer")
        self.number, self.episode, self.answer = number, episode, answers[answer]
        self.guess = answers[turn_of(number, count, stream=1)]
        observed, info = self.load(episode, number, options)
        if self.demonstrating:
            info["demonstration"] = self._demonstrate()
            if self.shift is not None:
                self.show(self.shift)
            observed = self.get_obs(self.get_info())
        goal = episode.goal
        info.update(goal=goal, goals=(goal,), difficulty=difficulty)
        return observed, info

    def load(
        self, layout: Layout, seed: int = 0, options: Mapping[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Build what stands on the table, with the arm at its home pose, at rest."""
        self.layout, self._scene_shift = layout, None
        options = dict(options or {}, reconfigure=True)  # nothing else is reproducible
        loaded: tuple[Any, dict[str, Any]] = super().reset(seed=seed, options=options)
        return loaded

    def _step_action(self, action: Any) -> Any:
        done = super()._step_action(action)
        if self.status is Status.ONGOING:
            self.status = self.episode.judge(self.arm, self.answer)
        return done

    def act(
        self, policy: str, known: Mapping[int, str] | None = None, answer: int | None = None
    ) -> NDArray[np.float32]:
        """Return the next action of a policy, `(8,) float32`; see `Simulator.act`."""
        if policy not in self._scripts:
            if policy == "answer":
                answers = self.episode.answers
                chosen = answers[_index(answer, 0, len(answers), "answer")]
            elif policy == "recall":
                chosen = self.episode.recalled(known or {}, self.number)
            else:
                chosen = self.answer if policy == "oracle" else self.guess
            self.arm.reset()
            self._scripts[policy] = self.episode.solve(self.arm, chosen)
        next(self._scripts[policy], None)  # a finished script holds its last pose
        return self.arm.action.copy()

    def hold(self) -> NDArray[np.float32]:
        """Return the last commanded action once more, `(8,) float32`."""
        return self.arm.action.copy()

    def subgoal(self) -> Subgoal:
        """Return the next subgoal; see `Simulator.subgoal`."""
        last = self.episode.steps - 1
        step = self.episode.step(self.answer, min(self.episode.progress(), last))
        return Subgoal(step.text, self.to_pixels(step.at))

    def follow_subgoal(self, subgoal: Subgoal | None) -> NDArray[np.float32]:
        """Return the next action, `(8,) float32`; see `Simulator.follow_subgoal`."""
        if self._follower is None:
            if subgoal is None:
                return self.act("guess")
            self.arm.reset()
            # Here, because few policies follow subgoals.
            from .subgoal_follower import SubgoalFollower

            answers = self.episode.shuffled(self.number)
            self._follower = SubgoalFollower(self.episode, self.arm, answers, self.to_pixels)
        self._follower.act(subgoal)
        return self.arm.action.copy()

    def to_pixels(self, points: Sequence[Point]) -> tuple[Pixel, ...]:
        """Project points into the current front image; see `camera.to_pixels`."""
        pose = self._camera("front").global_pose if self.drawing else None
        return to_pixels(points, None if pose is None else pose.to_transformation_matrix())

    def observe(self, cameras: Sequence[str] = CAMERAS) -> Observation:
        """Return the current observation with the images of some cameras."""
        images = {}
        if self.drawing and cameras:
            self.scene.sub_scenes[0].update_render()
            for name in cameras:
                camera = self._camera(name)
                camera.take_picture()
                images[name] = np.ascontiguousarray(camera.get_picture("Color")[..., :3])
        return Observation(images, self.arm.state)

    def show(self, shift: Shift | None, seed: int | None = None, part: float = 1.0) -> None:
        """Apply a shift, or a part of it, from now on; None for no shift.

        `seed` is that of a new scene's shifts, by default the episode's.
        """
        if not self.drawing or (shift is None and self._scene_shift is None):
            return
        if self._scene_shift is None:
            # Here, because most runs have no shift; the scene is still as it was built.
            from .scene_shift import SceneShift

            cameras = {name: self._camera(name) for name in CAMERAS}
            seed = self.number if seed is None else seed
            scene, bodies = self.scene.sub_scenes[0], self.builder.bodies
            self._scene_shift = SceneShift(scene, cameras, bodies, seed)
        self._scene_shift.show(shift, part)

    def render_rgb_array(self, camera_name: str | None = None) -> torch.Tensor:
        """Return a camera's image, front by default, `(1, 256, 256, 3) uint8` RGB."""
        name = camera_name or CAMERAS[0]
        return torch.from_numpy(self.observe((name,)).images[name])[None]

    def _camera(self, name: str) -> Any:
        return self._sensors[name].camera._render_cameras[0]

    def execute(self, script: Script) -> Iterator[NDArray[np.float32]]:
        """Execute a script, and judge nothing; yield each action, `(8,) float32`, before it."""
        for _ in script:
            action = self.arm.action.copy()
            yield action
            super()._step_action(action)

    def _demonstrate(self) -> Demonstration:
        seen, actions, shown = [], [], []
        script = self.episode.demonstrate(self.arm, self.answer)
        for number, action in enumerate(self.execute(script)):
            shown.append(self.episode.showing)
            seen.append(self.observe(() if number % self.frame_step else self.demonstrated))
            actions.append(action)
        self.builder.restore()
        self.rest()
        return Demonstration(
            {
                name: np.stack(
                    [observation.images[name] for observation in seen[:: self.frame_step]]
                )
                for name in seen[0].images
            },
            np.stack([observation.state for observation in seen]),
            np.stack(actions),
            spans_of_parts(shown, self.episode.parts(self.answer)),
        )

    def rest(self) -> None:
        """Set the arm to its home pose, at rest."""
        self.arm.reset()
        robot = self.agent.robot._objs[0]
        qpos = np.array(self.arm.home_qpos, dtype=np.float32)
        qpos[7:] = 0.0 if self.layout.stick else 0.04
        robot.set_qpos(qpos)
        robot.set_qvel(np.zeros_like(qpos))
        self.agent.controller.reset()
        self.agent.set_action(torch.from_numpy(self.arm.action)[None])


def _index(value: Any, start: int, stop: int, what: str) -> int:
    """Check that a value is a whole number from start to stop - 1, and return it."""
    if not isinstance(value, int | np.integer) or not start <= value < stop:
        raise InvalidOptionError.expected(what, value, f"a whole number, {start} to {stop - 1}")
    return int(value)
