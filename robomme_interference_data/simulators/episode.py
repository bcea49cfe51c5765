"""What a simulator returns at the beginning of an episode and after each action, and its checks."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robomme_interference_data.errors import InvalidOptionError, SimulatorError
from robomme_interference_data.schema.records import EvidenceSpan
from robomme_interference_data.schema.subgoal import Subgoal

CAMERAS = ("front", "wrist")
"""The cameras of RoboMME and of simulators that declare no others, in canonical order."""

ACTION_SIZE = 8
"""Length of RoboMME's actions and states, and where none is declared: 7 joints, the gripper."""


@dataclass(frozen=True)
class Observation:
    """What a policy sees at one time step. Shapes and units are RoboMME's.

    Attributes:
        images: Camera name (`front`, `wrist`) to image, `(256, 256, 3) uint8` RGB. Only the
            cameras that the simulator renders; empty if no images were requested.
        state: `(8,) float32`: 7 joint positions in rad, then the opening of one finger, 0 closed
            to 0.04 m open.
        subgoal: The next subgoal for the policy, if a subgoal writer provides one.
    """

    images: dict[str, NDArray[np.uint8]]
    state: NDArray[np.float32]
    subgoal: Subgoal | None = None


@dataclass(frozen=True)
class Demonstration:
    """The lesson of an episode: T time steps, without the first live observation.

    It may be a demonstration that was played separately, or the first phase of the episode itself,
    such as a cue: the history of a buffer is given to the policy between it and the live part.

    Attributes:
        images: Camera name to frames, `(T, H, W, 3) uint8` RGB; only every n-th frame if these were
            requested, empty if none were.
        states: `(T, 8) float32`, as `Observation.state`; `states[t]` belongs to frame t.
        actions: `(T, 8) float32`, executed after frame t: 7 absolute joint targets in rad, then
            the gripper, −1 closed to 1 open. `(0, 8)` if unknown.
        evidence: Which frames show each part of the hidden answer; None if unknown. Policies never
            receive it.
        scene: What the scene allows and hides, as JSON that `Simulator.scene` reads; None if it
            follows from the seed, or is unknown. Policies never receive it.
    """

    images: dict[str, NDArray[np.uint8]]
    states: NDArray[np.float32]
    actions: NDArray[np.float32]
    evidence: tuple[EvidenceSpan, ...] | None = None
    scene: str | None = None

    def __len__(self) -> int:
        return len(self.states)

    def __repr__(self) -> str:
        cameras = {name: frames.shape for name, frames in self.images.items()}
        return f"Demonstration(frames={len(self)}, images={cameras})"


@dataclass(frozen=True)
class EpisodeInfo:
    """Public facts about an episode, without the hidden answer.

    Attributes:
        goals: All wordings of the goal, at least one.
        difficulty: `easy`, `medium` or `hard`; None if a recording names none.
        seed: Seed of the scene; None if a recording names none.
        simulator: Registered name of the simulator.
    """

    goals: tuple[str, ...]
    difficulty: str | None
    seed: int | None
    simulator: str

    @property
    def goal(self) -> str:
        """The first wording of the goal."""
        return self.goals[0]


EpisodeStart = tuple[Demonstration, Observation, EpisodeInfo]


def choose_cameras(
    names: Sequence[str] | None, available: Sequence[str] = CAMERAS
) -> tuple[str, ...]:
    """Return the named cameras, all by default, sorted; raise for one that is not available."""
    for name in names or ():
        if name not in available:
            raise InvalidOptionError.one_of("camera", name, available)
    return tuple(sorted(available if names is None else set(names)))


def action_array(
    action: ArrayLike,
    *,
    chunk: bool = False,
    size: int = ACTION_SIZE,
    state_size: int | None = None,
) -> NDArray[np.float32]:
    """Check an action, and return it as `(size,) float32`; a chunk of n ≥ 1 as `(n, size)`.

    The error about another size says so if it is that of a state.
    """
    expected = f"({size},) action"
    if chunk:
        expected = f"(n, {size}) actions, n at least 1"
    try:
        array = np.asarray(action)
    except ValueError:
        raise _wrong_action("rows of several lengths", expected, size) from None
    shape = array.shape[1:] if chunk else array.shape
    if shape != (size,) or not len(array):
        fault = f"shape {array.shape}"
        if array.shape[-1:] == (state_size,) and state_size != size:
            fault += f", {state_size} values as in a state"
        raise _wrong_action(fault, expected, size)
    if array.dtype.kind not in "fiu":
        raise _wrong_action(f"dtype {array.dtype}", f"{expected}, of numbers", size)
    with np.errstate(over="ignore"):
        converted = array.astype(np.float32)
    wrong = np.argwhere(~np.isfinite(converted)).tolist()
    if wrong:
        where = f"{wrong[0]}".replace("[", "(").replace("]", ")")
        fault = f"{array[tuple(wrong[0])]} at {where}"
        if len(wrong) > 1:
            fault += f", the first of {len(wrong)} such values"
        raise _wrong_action(fault, f"{expected}, of finite float32 numbers", size)
    return converted


def _wrong_action(fault: str, expected: str, size: int) -> InvalidOptionError:
    return InvalidOptionError(
        f"got {fault}; expected {expected}",
        "An action is 7 absolute joint targets in rad, then the gripper, −1 closed to 1 open."
        if size == ACTION_SIZE
        else "The simulator, or the recordings, have actions of this size.",
    )


_START_HINT = (
    "Return (Demonstration, Observation, EpisodeInfo): states (T, S) and (S,) float32, actions "
    "(T, action_size) float32, images (H, W, 3) uint8 of the declared `cameras`."
)


def check_start(start: Any, name: str, cameras: Sequence[str], action_size: int) -> None:
    """Compare the beginning of an episode with what a simulator declares.

    Args:
        start: What `_begin` returned.
        name: Name of the simulator's class, for errors.
        cameras: Its cameras.
        action_size: Length of its actions.
    """
    kinds = (Demonstration, Observation, EpisodeInfo)
    parts = start if isinstance(start, tuple) else (start,)
    if len(parts) != len(kinds) or not all(map(isinstance, parts, kinds)):
        returned = ", ".join(type(part).__name__ for part in parts)
        raise _wrong_start(name, [f"`_begin` returned {returned}"])
    lesson, first, _ = parts
    state, states, actions = map(np.asarray, (first.state, lesson.states, lesson.actions))
    wrong: list[str] = []
    if state.ndim != 1 or state.dtype != np.float32:  # of no values, if none were recorded
        wrong.append(f"the first live state is {state.dtype} {state.shape}")
    elif states.shape != (len(states), *state.shape) or states.dtype != np.float32:
        wrong.append(
            f"the lesson's states are {states.dtype} {states.shape}, a live one {state.shape}"
        )
    if (
        actions.shape not in ((0, action_size), (len(states), action_size))
        or actions.dtype != np.float32
    ):
        wrong.append(
            f"the lesson's actions are {actions.dtype} {actions.shape}; expected "
            f"{(len(states), action_size)}, or {(0, action_size)} if they are unknown"
        )
    for camera, image in first.images.items():
        if camera not in cameras:
            wrong.append(f"the camera {camera!r} is none of {', '.join(cameras)}")
        elif image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            wrong.append(f"the image of {camera!r} is {image.dtype} {image.shape}")
    if wrong:
        raise _wrong_start(name, wrong)


def check_drawn(
    lesson: Demonstration, first: Observation, cameras: Iterable[str], frame_step: int = 1
) -> None:
    """Check that a simulator drew these cameras; every n-th frame of the lesson, or none at all."""
    expected = len(range(0, len(lesson), frame_step))
    for camera in cameras:
        frames = len(lesson.images.get(camera, ())) if lesson.images else expected
        if camera not in first.images or frames != expected:
            drawn = ", ".join(first.images) or "no camera"
            raise SimulatorError(
                f"the simulator was to draw {camera}; it drew {drawn}, and {frames} of "
                f"{expected} frames of the lesson",
                "Draw the cameras of the setting `cameras`, and all that are declared without it.",
            )


def _wrong_start(name: str, wrong: list[str]) -> SimulatorError:
    return SimulatorError(f"simulator {name}: {'; '.join(wrong)}", _START_HINT)
