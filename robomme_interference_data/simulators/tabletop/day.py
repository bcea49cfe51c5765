"""Plays a planned day: one stream of frames, without a cut.

Every task is played in a fresh scene, as its demonstration is. Between two tasks, the things of
the old one slide out of view and those of the new one slide in, while the arm goes from one home
pose to the other: a scene of its own holds both, and nothing in it is subject to physics.
"""

import gc
import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.days import DayPlan, PlannedTask
from robomme_interference_data.schema.evidence import spans_of_parts
from robomme_interference_data.schema.records import DaySpan
from robomme_interference_data.schema.shifts import NO_SHIFT, parse_shift
from robomme_interference_data.simulators.episode import Observation

from .bodies import Body, Color, SceneBuilder
from .camera import AWAY
from .episodes import difficulty_of, seed_of
from .families import draw_episode
from .family import Family, Layout
from .motion import Arm, Script, eased

if TYPE_CHECKING:
    from .env import TabletopEnv

TimeStep = tuple[Observation, NDArray[np.float32]]
"""An observation, and the action `(8,) float32` that is executed after it."""

TABLE: Color = (0.58, 0.56, 0.50)
"""Color of the table, on which the things of all families are visible."""

IDLE = 32
"""Frames of idle time."""

_INSIDE = -0.045  # m: length of a stick that is hidden in the hand

_Shown = tuple[Observation, NDArray[np.float32], tuple[int, ...]]
"""A frame, and the parts of the answer that it shows."""


class EmptyTable:
    """A table without anything on it."""

    table: ClassVar[Color] = TABLE
    floor: ClassVar[Color] = Family.floor
    stick: ClassVar[float] = 0.0
    pace: ClassVar[float] = Family.pace
    showing: tuple[int, ...] = ()

    def build(self, builder: SceneBuilder) -> None:
        """Build nothing."""

    def react(self, arm: Arm) -> None:
        """Change nothing."""


@dataclass(frozen=True)
class Standing:
    """How things and arm stand where a task begins or ends.

    Attributes:
        layout: What builds the things.
        poses: Their poses, in the order in which they are built.
        qpos: Positions of all joints, `(9,) float64`.
    """

    layout: Layout
    poses: Sequence[Any]
    qpos: NDArray[np.float64]

    def build(self, builder: SceneBuilder) -> list[Body]:
        """Build the things."""
        first = len(builder.bodies)
        self.layout.build(builder)
        return builder.bodies[first:]


class Transition(EmptyTable):
    """The things of two tasks, and a stick that the hand can draw in."""

    def __init__(self, before: Standing, after: Standing):
        self._before, self._after = before, after
        self._sticks = before.layout.stick, after.layout.stick

    def build(self, builder: SceneBuilder) -> None:
        """Build the things of both tasks."""
        self._groups = [
            (self._before.build(builder), self._before.poses),
            (self._after.build(builder), self._after.poses),
        ]

    def qpos(self, part: float) -> NDArray[np.float64]:
        """Return the joint positions after a part of the way, `(9,) float64`."""
        return self._before.qpos + part * (self._after.qpos - self._before.qpos)

    def action(self, part: float) -> NDArray[np.float32]:
        """Return the action that leads there, `(8,) float32`."""
        gripper = -1.0 if self._after.layout.stick else 1.0
        return np.append(self.qpos(part)[:7], gripper).astype(np.float32)

    def add_stick(self, env: "TabletopEnv") -> None:
        """Add the stick to the loaded scene, if one of the tasks has one."""
        self._robot = env.agent.robot._objs[0]
        self._stick = None
        if any(self._sticks) and env.scene.can_render():
            import sapien

            from .drawing import stick_shape

            drawn = sapien.render.RenderBodyComponent()
            drawn.attach(stick_shape(max(self._sticks)))
            self._stick = sapien.Entity()
            self._stick.add_component(drawn)
            env.scene.sub_scenes[0].add_entity(self._stick)
            self._hand = next(n for n in self._robot.links if n.name.endswith("panda_hand"))

    def move(self, part: float) -> None:
        """Set everything to where it is after a part of the way."""
        import sapien

        for (bodies, poses), y in zip(self._groups, (part, part - 1), strict=True):
            for body, pose in zip(bodies, poses, strict=True):
                body.pose = sapien.Pose(pose.p + np.array([0, y * AWAY, 0], np.float32), pose.q)
        self._robot.set_qpos(self.qpos(part).astype(np.float32))
        if self._stick is not None:
            old, new = (stick or _INSIDE for stick in self._sticks)
            drawn_in = old + part * (new - old) - max(self._sticks)
            self._stick.set_pose(self._hand.entity_pose * sapien.Pose([0, 0, drawn_in]))


class PlayedDay:
    """A planned day as the simulator plays it.

    Args:
        env: The environment; nothing else may use it before the last frame.
        plan: The day.
        cameras: Names of the cameras to render.

    Attributes:
        spans: The spans that were played, without digests; all of them after the last frame.

    Raises:
        UnknownNameError: The plan has an episode that does not exist.
    """

    def __init__(self, env: "TabletopEnv", plan: DayPlan, cameras: Sequence[str]):
        for task in plan.tasks:
            if task.episode is not None:
                seed_of(task.episode)
        self.spans: list[DaySpan] = []
        self._env, self._plan, self._cameras = env, plan, cameras
        # Of the day, so that the table looks the same from task to task.
        self._look = int.from_bytes(hashlib.sha256(str(plan.day).encode()).digest()[:4])
        self._cuts: dict[EpisodeId, int] = {}

    def frames(self) -> Iterator[TimeStep]:
        """Yield each time step of the day once, in order.

        The same plan gives the same frames, bit for bit.
        """
        self.spans.clear()
        # ManiSkill collects garbage for every scene: that takes a third of a second unless it skips
        # what was there before.
        gc.freeze()
        try:
            yield from self._frames()
        finally:
            gc.unfreeze()

    def _frames(self) -> Iterator[TimeStep]:
        self._env.load(EmptyTable())
        standing = self._standing()
        look = self._plan.tasks[0].shift
        for task in self._plan.tasks:
            # The scene is built once to see how it begins, and once more to be played.
            next(self._begin(task)[1])
            way = Transition(standing, self._standing())
            transition = self._travel(way, task, look)
            yield from self._span(self._plan.day, "transition", task.shift, transition)
            parts, script = self._begin(task)
            source = task.episode or self._plan.day
            played = self._play(script, task)
            yield from self._span(source, task.part, task.shift, played, parts)
            standing, look = self._standing(), task.shift

    def _span(
        self,
        source: EpisodeId,
        part: str,
        shift: str,
        frames: Iterator[_Shown],
        texts: Sequence[str] = (),
    ) -> Iterator[TimeStep]:
        """Yield the frames of a span, then record it; `texts` are the parts of the answer."""
        start = self.spans[-1].stop if self.spans else 0
        shown = []
        for observation, action, showing in frames:
            shown.append(showing)
            yield observation, action
        evidence = (
            replace(seen, start=start + seen.start, stop=start + seen.stop)
            for seen in spans_of_parts(shown, texts)
        )
        stop = start + len(shown)
        self.spans.append(DaySpan(source, part, shift, start, stop, "", tuple(evidence)))

    def _travel(self, way: Transition, task: PlannedTask, look: str) -> Iterator[_Shown]:
        """Yield the frames of a transition; `look` is how the table looked before."""
        self._env.load(way)
        way.add_stick(self._env)
        count = task.transition + 1
        # A day has one shift at most: it comes or goes on the way.
        shift = parse_shift(task.shift) or parse_shift(look)
        old, new = (float(name != NO_SHIFT) for name in (look, task.shift))
        for step in range(1, count):
            part = eased(step / count)
            way.move(part)
            self._env.show(shift, self._look, old + part * (new - old))
            yield self._env.observe(self._cameras), way.action(eased((step + 1) / count)), ()

    def _play(self, script: Script, task: PlannedTask) -> Iterator[_Shown]:
        """Yield the frames of a task."""
        self._env.show(parse_shift(task.shift), self._look)
        for action in self._env.execute(script):
            yield self._env.observe(self._cameras), action, self._env.layout.showing

    def _begin(self, task: PlannedTask) -> tuple[tuple[str, ...], Script]:
        """Load the scene of a task; return the texts of its answer's parts, and its script."""
        env = self._env
        if task.episode is None:
            env.load(EmptyTable())
            return (), env.arm.wait(IDLE)
        if task.part == "lesson":
            return self._demonstrate(task.episode)
        if task.episode not in self._cuts:
            self._cuts[task.episode] = self._find_cut(task.episode)
        cut = self._cuts[task.episode]
        parts, script = self._demonstrate(task.episode)
        until_cut = islice(script, cut)
        if task.part == "first":
            return parts, chain(until_cut, env.arm.go_home())
        for _ in env.execute(until_cut):
            pass
        place = env.arm.commanded
        env.rest()
        env.layout.react(env.arm)  # the arm has left what it touched
        return parts, chain(env.arm.leave_home(*place), script)

    def _demonstrate(self, episode: EpisodeId) -> tuple[tuple[str, ...], Script]:
        """Load the scene of an episode; return its parts, and the script of its demonstration."""
        seed = seed_of(episode)
        scene = draw_episode(episode.family, seed, difficulty_of(seed))
        number = episode.answer
        answer = scene.own_answer(seed) if number is None else scene.answers[number]
        self._env.load(scene, seed)
        return scene.parts(answer), scene.demonstrate(self._env.arm, answer)

    def _find_cut(self, episode: EpisodeId) -> int:
        """Return how many frames of a demonstration are its first piece."""
        _, script = self._demonstrate(episode)
        return cut_of([self._env.layout.showing for _ in self._env.execute(script)])

    def _standing(self) -> Standing:
        """Return how everything stands now."""
        env = self._env
        poses = [thing.pose for thing in env.builder.things]
        qpos = np.array(env.agent.robot._objs[0].qpos, dtype=np.float64)
        return Standing(env.layout, poses, qpos)


def cut_of(shown: Sequence[Sequence[int]]) -> int:
    """Return where a demonstration is cut into two pieces: the frames of the first one.

    It is cut before a frame with a further part of the answer, as near to the middle as possible.
    Nothing is held there: the plan has pieces only of families whose arm moves a stick.

    Args:
        shown: The parts that each frame shows.
    """
    seen: set[int] = set()
    cuts = []
    for frame, parts in enumerate(shown):
        if seen and not seen.issuperset(parts):
            cuts.append(frame)
        seen.update(parts)
    return min(cuts, key=lambda cut: abs(2 * cut - len(shown)))
