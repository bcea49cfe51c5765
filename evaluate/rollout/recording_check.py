"""Whether the simulator plays the episode that the dataset recorded."""

from typing import Any

import numpy as np

from robomme_interference_data.constants import STATE
from robomme_interference_data.data.query import Query
from robomme_interference_data.errors import RunError
from robomme_interference_data.simulators.base import Demonstration, EpisodeInfo, Observation

STATE_TOLERANCE = 0.01
"""How far, rad or m, the first live state may be from the recorded one: on another machine floating
point differs in its last bits, and an episode of another version of the suite by more."""


def check_episode(
    query: Query, played: Demonstration, first: Observation, info: EpisodeInfo
) -> None:
    """Check, without decoding a frame, that the simulator plays the episode that was recorded.

    Seed, difficulty, length of the demonstration and goal must agree, and the first live state
    within `STATE_TOLERANCE`.
    """
    compared: dict[str, tuple[Any, Any]] = {
        "seed": (query.seed, info.seed),
        "difficulty": (query.difficulty, info.difficulty),
        "length of the demonstration": (query.lesson_frames, len(played)),
        # Any of its wordings: which one comes first may depend on the source.
        "goal": (query.goal, query.goal if query.goal in info.goals else info.goal),
    }
    wrong = [
        f"{name} is {recorded!r} in the dataset, {given!r} in the simulator"
        for name, (recorded, given) in compared.items()
        if recorded is not None and recorded != given
    ]
    apart = float(np.abs(query.state() - first.state).max())
    if not apart <= STATE_TOLERANCE:
        wrong.append(
            f"the first live state is {apart:.4f} away from the recorded one; expected at most "
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
    """Compare a recorded demonstration and first live observation with what the simulator played.

    Only cameras that the simulator drew are compared, and the first live views only if asked to.
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
                    "Another renderer or machine made the dataset; the states agree.",
                )
        if views and not np.array_equal(query.frame(camera), first.images[camera]):
            raise RunError(
                f"{query.episode_id}: the first live {camera} view is not the recorded one"
            )
