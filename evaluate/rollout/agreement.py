"""Checks that a simulator plays an episode as the buffer set records it, when a rollout begins."""

from typing import Any

import numpy as np

from robomme_interference_data.constants import STATE
from robomme_interference_data.data.query import Query
from robomme_interference_data.errors import RunError, SimulatorError
from robomme_interference_data.simulators.episode import Demonstration, EpisodeInfo, Observation

STATE_TOLERANCE = 0.01
"""Maximum distance, rad or m, of the first live state from the recorded one: between machines only
the last bits differ, between versions of the suite more."""


def check_episode(
    query: Query, played: Demonstration, first: Observation, info: EpisodeInfo
) -> None:
    """Compare seed, difficulty, lesson length, goal and first live state with the recorded ones.

    A state or image of another shape fits no episode, and is a `SimulatorError`.
    """
    recorded_shapes = {"state": query.dataset.features[STATE]}
    live_shapes = {"state": first.state.shape}
    for camera in sorted(first.images.keys() & {*query.dataset.cameras}):
        recorded_shapes[camera] = query.dataset.shape(camera)
        live_shapes[camera] = first.images[camera].shape
    if live_shapes != recorded_shapes:
        raise SimulatorError(
            f"the simulator gives {live_shapes}; the buffer set was recorded with "
            f"{recorded_shapes}",
            "Build the buffer set from this simulator, or correct its sizes.",
        )
    compared: dict[str, tuple[Any, Any]] = {
        "seed": (query.seed, info.seed),
        "difficulty": (query.difficulty, info.difficulty),
        "length of the demonstration": (query.lesson_frames, len(played)),
        # Any of its wordings: their order may depend on the source.
        "goal": (query.goal, query.goal if query.goal in info.goals else info.goal),
    }
    wrong = [
        f"{name} is {recorded!r} in the dataset, {played_value!r} in the simulator"
        for name, (recorded, played_value) in compared.items()
        if recorded is not None and recorded != played_value
    ]
    distance = float(np.abs(query.state() - first.state).max(initial=0.0))
    if not distance <= STATE_TOLERANCE:
        wrong.append(
            f"the first live state is {distance:.4f} away from the recorded one; expected at most "
            f"{STATE_TOLERANCE}"
        )
    if wrong:
        raise RunError(
            f"{query.episode_id}: {'; '.join(wrong)}",
            "The dataset was recorded with another version of the simulator: build it again, or "
            "install the version that recorded it.",
        )


def check_lesson(
    query: Query, played: Demonstration, first: Observation, *, views: bool = True
) -> None:
    """Compare a recorded demonstration, and the first live `views`, with the simulator's playback.

    Cameras that the simulator did not draw are left out. The recorded frames were compared with
    their SHA-256 before.
    """
    dataset, episode, frames = query.dataset, query.record.episode_index, query.lesson_frames
    if not np.array_equal(dataset.read_vectors(episode, STATE, 0, frames), played.states):
        raise RunError(f"{query.episode_id}: the lesson's states are not the simulator's")
    for camera in dataset.cameras:
        if camera not in first.images:
            continue
        recorded = dataset.iter_frames(episode, camera, 0, frames)
        for number, (ours, theirs) in enumerate(zip(recorded, played.images[camera], strict=True)):
            if not np.array_equal(ours, theirs):
                raise RunError(
                    f"{query.episode_id}: frame {number} of the lesson's {camera} camera is not "
                    "what the simulator shows",
                    "Another renderer or machine made the dataset, or its video is damaged; the "
                    "states agree.",
                    "verify BUFFER_SET",
                )
        if views and not np.array_equal(query.frame(camera), first.images[camera]):
            raise RunError(
                f"{query.episode_id}: the first live observation is not the recorded one in "
                f"{camera}"
            )
