"""Whether the simulator plays the episode that the dataset recorded."""

from typing import Any

import numpy as np

from robomme_interference_data.buffer import Buffer
from robomme_interference_data.errors import RolloutError
from robomme_interference_data.simulators.base import Demonstration, EpisodeInfo, Observation

__all__ = ["STATE_TOLERANCE", "check_episode", "check_lesson"]

STATE_TOLERANCE = 0.01
"""How far, rad or m, the first live state may be from the recorded one: on another machine floating
point differs in its last bits, and an episode of another version of the suite by more."""


def check_episode(
    buffer: Buffer, played: Demonstration, first: Observation, info: EpisodeInfo
) -> None:
    """Check, without decoding a frame, that the simulator plays the episode that was recorded.

    Seed, difficulty, length of the lesson and goal must agree, and the first live state within
    `STATE_TOLERANCE`.

    Raises:
        RolloutError: One of them does not.
    """
    manifest = buffer.manifest
    compared: list[tuple[str, Any, Any]] = [
        ("seed", manifest.seed, info.seed),
        ("difficulty", manifest.difficulty, info.difficulty),
        ("length of the lesson", manifest.query.frame, len(played)),
        # Any of its wordings: which one comes first may depend on the source.
        ("goal", manifest.goal, manifest.goal if manifest.goal in info.goals else info.goal),
    ]
    for name, recorded, given in compared:
        if recorded is not None and recorded != given:
            raise RolloutError(
                f"{buffer.episode_id}: {name} is {recorded!r} in the dataset, {given!r} in the "
                "simulator",
                _OTHER_VERSION,
            )
    apart = float(np.abs(buffer.query_state() - first.state).max())
    if not apart <= STATE_TOLERANCE:
        raise RolloutError(
            f"{buffer.episode_id}: the first live state is {apart:.4f} away from the recorded one; "
            f"expected at most {STATE_TOLERANCE}",
            _OTHER_VERSION,
        )


_OTHER_VERSION = (
    "The dataset was recorded with another version of the simulator: build it again, or install "
    "the version that recorded it."
)


def check_lesson(buffer: Buffer, played: Demonstration, first: Observation) -> None:
    """Compare the lesson and query frame of the dataset with what the simulator played.

    Raises:
        RolloutError: They differ in a bit; says where first.
    """
    episode = buffer.episode_id
    lesson = next(s for s in buffer.sessions if s.role == "lesson")
    if lesson.stop - lesson.start != len(played):
        raise RolloutError(
            f"{episode}: the lesson has {lesson.stop - lesson.start} frames, the simulator's "
            f"demonstration {len(played)}"
        )
    if not np.array_equal(buffer.states[lesson.start : lesson.stop], played.states):
        raise RolloutError(f"{episode}: the lesson's states are not the simulator's")
    for camera in buffer.cameras:
        if camera not in first.images:
            continue
        for chunk in buffer.stream(64, (camera,), lesson.start, lesson.stop):
            at = chunk.start - lesson.start
            theirs = played.images[camera][at : at + len(chunk)]
            differing = (chunk.frames[camera] != theirs).any(axis=(1, 2, 3))
            if differing.any():
                raise RolloutError(
                    f"{episode}: frame {at + int(differing.argmax())} of the lesson's {camera} "
                    "camera is not what the simulator shows",
                    "Another renderer or machine made the dataset; the states agree.",
                )
        if not np.array_equal(buffer.query_frame(camera), first.images[camera]):
            raise RolloutError(
                f"{episode}: the first live {camera} view is not the recorded query frame"
            )
