"""Recorded executions, played back, to compare a policy's actions with those of a recording."""

from collections.abc import Iterator, Sequence
from typing import Any, override

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import ACTION, EXECUTIONS, MAX_STEPS, RECORDINGS, STATE
from robomme_interference_data.data.dataset import camera_feature
from robomme_interference_data.data.loading import load_buffer_set, open_dataset
from robomme_interference_data.errors import HashMismatchError, SimulatorError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.storage.arrays import FeatureDigests

from .base import Simulator
from .episode import Demonstration, EpisodeInfo, EpisodeStart, Observation, choose_cameras


class Recordings(Simulator):
    """Plays back the executions of a buffer set; actions change nothing but the measured error.

    An episode ends as `measured` after its last recorded action, or after 1300 steps.

    Args:
        buffer_set: Folder or repository of the buffer set.
        cameras: Cameras to decode, any of the recordings'.
    """

    name = RECORDINGS
    about = "recordings, played back"
    settings = ("cameras", "buffer_set")
    policies = ("hold", "mean")
    plays_back = True
    try_out = False

    def __init__(self, buffer_set: str, cameras: Sequence[str] = ()):
        self._buffer_set = load_buffer_set(buffer_set, threads=1)
        self._executions = open_dataset(self._buffer_set, EXECUTIONS)
        self.cameras = self._executions.cameras
        self._cameras = choose_cameras(cameras, self.cameras)
        (self.action_size,) = self._executions.features[ACTION]
        self._sums: dict[int, NDArray[np.float64]] = {}

    def last_action(self) -> NDArray[np.float32] | None:
        """Return the recorded action of the last step, `(A,) float32`; None before the first."""
        done = len(self._errors)
        return self._actions[done - 1] if done else None

    def mean_action(self) -> NDArray[np.float32]:
        """Return the mean recorded action of other episodes than the current one, `(A,) float32`.

        They are those of its family, or if there are none of all families; all steps have equal
        weight. The current episode is left out, since a policy cannot know its actions either.
        """
        episodes = self._executions.records()
        others = [record for record in episodes if record.episode_id != self._current.episode_id]
        others = [
            record
            for record in others
            if record.episode_id.family == self._current.episode_id.family
        ] or others
        if not others:
            raise SimulatorError(
                f"{self._current.episode_id} is the only recording, so there is no mean action of "
                "others",
                "Build the executions of more episodes, or run another policy.",
            )
        total = sum(self._sum_of(record.episode_index) for record in others)
        return np.asarray(total / sum(record.length for record in others), np.float32)

    def _sum_of(self, index: int) -> NDArray[np.float64]:
        """Return the sum of the recorded actions of an episode, `(A,) float64`."""
        if index not in self._sums:
            length = self._executions.record(index).length
            actions = self._executions.read_vectors(index, ACTION, 0, length)
            self._sums[index] = actions.sum(axis=0, dtype=np.float64)
        return self._sums[index]

    @override
    def columns(self) -> dict[str, Any]:
        by_value = np.mean(self._errors, axis=0)
        return {
            "action_l1": round(float(by_value.mean()), 9),
            "action_l1_values": " ".join(f"{value:.9f}" for value in by_value),
        }

    @override
    def _begin(self, episode: EpisodeId, frame_step: int) -> EpisodeStart:
        query, executions = self._buffer_set.query(episode), self._executions
        index = executions.index_of(episode)
        record = self._current = executions.record(index)
        self._actions = executions.read_vectors(index, ACTION, 0, min(record.length, MAX_STEPS))
        self._errors: list[NDArray[np.float64]] = []
        self._observations = self._observed(record, len(self._actions))
        self._seen = next(self._observations)
        states = query.dataset.read_vectors(
            query.record.episode_index, STATE, 0, query.lesson_frames
        )
        lesson = Demonstration({}, states, np.empty((0, self.action_size), np.float32))
        info = EpisodeInfo(record.goals, record.difficulty, record.seed, RECORDINGS)
        return lesson, self._seen, info

    @override
    def _execute(
        self, episode: EpisodeId, action: NDArray[np.float32], observe: bool
    ) -> tuple[Observation, Status]:
        recorded = self._actions[len(self._errors)].astype(float)
        self._errors.append(np.abs(action - recorded))
        seen = next(self._observations, None)
        if seen is None:
            return self._seen, Status.MEASURED
        self._seen = seen
        return seen, Status.ONGOING

    def _observed(self, record: EpisodeRecord, length: int) -> Iterator[Observation]:
        """Yield the observations, and compare whole recordings with their SHA-256."""
        index, digests = record.episode_index, FeatureDigests()
        states = self._executions.read_vectors(index, STATE, 0, length)
        digests.update(STATE, states)
        digests.update(ACTION, self._actions)
        streams = {
            camera: self._executions.iter_frames(index, camera, 0, length)
            for camera in self._cameras
        }
        for state in states:
            images = {camera: np.array(next(stream)) for camera, stream in streams.items()}
            for camera, image in images.items():
                digests.update(camera_feature(camera), image)
            yield Observation(images, state)
        recorded, decoded = record.feature_sha256, digests.current()
        if length == record.length and not decoded.items() <= recorded.items():
            raise HashMismatchError.damaged(
                f"the execution {record.episode_id} in {self._executions.files.describe()} differs "
                "from its recorded SHA-256"
            )
