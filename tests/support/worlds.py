"""A simulator without physics over a buffer set's episodes, and a policy that cheats if it can."""

import os
import re
import signal
import time
from collections.abc import Iterator, Mapping, Sequence, Set
from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data import BufferSet, Query, load_buffer_set
from robomme_interference_data.constants import STATE
from robomme_interference_data.data.questions import read_questions
from robomme_interference_data.errors import SimulatorCrashError
from robomme_interference_data.evaluate.policies.policy import Frames, RolloutInfo
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.schema.subgoal import Subgoal
from robomme_interference_data.simulators.base import Simulator
from robomme_interference_data.simulators.episode import Demonstration, EpisodeInfo, Observation

BUFFER_SET = "WORLDS_DATA"
TROUBLE = "WORLDS_TROUBLE"
RENDERER = "WORLDS_RENDERER"
PAUSE = "WORLDS_PAUSE"
ANSWER_FRAME = 3
STEPS = 40


@cache
def buffer_set_at(path: str) -> BufferSet:
    return load_buffer_set(path, threads=1)


def buffer_set_here() -> BufferSet:
    return buffer_set_at(str(Path(os.environ[BUFFER_SET]).resolve()))


def query_of(episode: str) -> tuple[Query, NDArray[np.float32], Observation]:
    """A query of the buffer set, the states of its lesson, and its first live observation."""
    return query_at(str(Path(os.environ[BUFFER_SET]).resolve()), episode)


@cache
def query_at(path: str, episode: str) -> tuple[Query, NDArray[np.float32], Observation]:
    query = buffer_set_at(path).query(episode)
    dataset, index = query.dataset, query.record.episode_index
    states = dataset.read_vectors(index, STATE, 0, query.lesson_frames)
    views = {camera: query.frame(camera) for camera in dataset.cameras}
    return query, states, Observation(views, query.state())


def lesson_images(query: Query) -> dict[str, NDArray[np.uint8]]:
    dataset, index = query.dataset, query.record.episode_index
    return {
        camera: np.stack(
            [frame.copy() for frame in dataset.iter_frames(index, camera, 0, query.lesson_frames)]
        )
        for camera in dataset.cameras
    }


class World:
    """Simulates the episodes of the buffer set in `WORLDS_DATA`.

    The answer is the lesson's state at frame 3. An action that equals it succeeds; after 40 steps
    the episode fails. A file `<Family>-<index>` in the folder `WORLDS_TROUBLE` makes an episode
    `raise`, `die`, `hang` or `error` at step 5, once if the text ends in `once`; or `endless`.
    """

    def __init__(self) -> None:
        self.pause = float(os.environ.get(PAUSE, "0"))
        self.drawn = 0

    def reset(
        self, episode_id: str, demonstration: bool = True
    ) -> tuple[Demonstration, Observation, EpisodeInfo]:
        self.trouble = trouble_of(EpisodeId.parse(episode_id))
        query, states, self.seen = query_of(episode_id)
        self.answer, self.steps = states[ANSWER_FRAME], 0
        lesson = Demonstration(
            lesson_images(query) if demonstration else {}, states, np.zeros_like(states)
        )
        goals = query.record.goals
        info = EpisodeInfo(goals, str(query.difficulty), query.seed or 0, "world")
        return lesson, self.seen, info

    def step(self, action: NDArray[np.float32], observe: bool = True) -> tuple[Observation, Status]:
        time.sleep(self.pause)
        self.steps += 1
        if self.trouble and self.steps == 5:
            self._break()
        status = Status.ONGOING
        if np.array_equal(action[:7], self.answer[:7]):
            status = Status.SUCCESS
        elif self.steps >= STEPS and self.trouble != "endless":
            status = Status.FAIL
        if self.trouble == "error" and self.steps == 7:
            status = Status.ERROR
        self.drawn += observe
        return Observation(self.seen.images if observe else {}, self.seen.state), status

    def act(self, policy: str, known: Any = None) -> NDArray[np.float32]:
        return np.append(self.answer[:7], np.float32(1.0))

    def subgoal(self) -> Subgoal:
        return Subgoal(f"go on from step {self.steps} to <point>", ((self.steps, 7),))

    def follow_subgoal(self, subgoal: Subgoal | None) -> NDArray[np.float32]:
        return self.act("follow-subgoals")

    def close(self) -> None:
        pass

    def _break(self) -> None:
        if self.trouble.startswith("raise"):
            raise SimulatorCrashError("the world fell apart", "Pick it up.")
        if self.trouble.startswith("die"):
            os.kill(os.getpid(), signal.SIGKILL)
        if self.trouble.startswith("hang"):
            time.sleep(3600)


def trouble_of(episode: EpisodeId) -> str:
    folder = os.environ.get(TROUBLE)
    path = Path(folder or "/nowhere") / f"{episode.family}-{episode.index}"
    text = path.read_text() if path.exists() else ""
    if text.endswith("once"):
        path.unlink()
    return text


class Cheat:
    """Repeats the lesson if any frame or state of it leaks to the policy; otherwise it holds.

    It knows all demonstrations of the buffer set, and searches every object that is reachable from
    the info, the goal, the history and the live observations for one of their frames or states.
    """

    cameras: tuple[str, ...] = ("front",)
    history_cameras: tuple[str, ...] = ("front", "wrist")
    wants_history = True
    privileged = False
    every_frame = True
    other_states = "refuse"
    memory = None

    def reset(self, info: RolloutInfo) -> None:
        self.info = info
        self.answer: NDArray[np.float32] | None = None
        self.states: list[NDArray[np.float32]] = []
        self.live: list[int] = []
        self.chunks: list[tuple[int, int]] = []
        self.search(info)

    def add_history(self, frames: Frames, states: NDArray[np.float32], exec_start_idx: int) -> None:
        assert sorted(frames) == ["front", "wrist"]
        assert all(len(part) == len(states) for part in frames.values())
        self.search((frames, states))
        self.states += list(states)
        self.chunks.append((len(states), exec_start_idx))

    def observe(self, frames: Frames, states: NDArray[np.float32]) -> None:
        assert list(frames) == ["front"] and len(frames["front"]) == len(states)
        self.search((frames, states))
        self.live.append(len(states))

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        self.search((observation, goal))
        state = observation.state if self.answer is None else self.answer
        return np.tile(np.append(state[:7], np.float32(1.0)), (16, 1))

    def search(self, given: object) -> None:
        """Take the answer from the first frame or state of a demonstration."""
        if self.answer is None:
            found = (known()[piece] for piece in pieces(given, set()) if piece in known())
            self.answer = next(found, None)

    def metadata(self) -> dict[str, Any]:
        return {"policy": "cheat"}

    def close(self) -> None:
        pass


@cache
def known() -> dict[bytes, NDArray[np.float32]]:
    """Map every frame and joint state of the lessons, as bytes, to the answer.

    The one live observation and state that `World` shows of an episode is left out.
    """
    answers: dict[bytes, NDArray[np.float32]] = {}
    shown: set[bytes] = set()
    for episode in FAMILIES:
        query, states, seen = query_of(f"{episode}/test/0")
        images = list(lesson_images(query).values())
        answers |= dict.fromkeys(pieces([states, images], set()), states[ANSWER_FRAME])
        shown |= set(pieces([seen.state, list(seen.images.values())], set()))
    return {piece: answer for piece, answer in answers.items() if piece not in shown}


FAMILIES = ("VideoRepick", "MoveCube")
"""The tests run the first test episode of each."""


def pieces(given: object, seen: set[int]) -> Iterator[bytes]:
    """Yield every image, and every seven numbers that could be joints, of an object."""
    if id(given) in seen:
        return
    seen.add(id(given))
    if isinstance(given, np.ndarray):
        if given.dtype == np.uint8 and given.ndim >= 3:
            yield from (image.tobytes() for image in given.reshape(-1, *given.shape[-3:]))
        elif given.dtype.kind == "f" and given.ndim and given.shape[-1] >= 7:
            rows = given.reshape(-1, given.shape[-1]).astype(np.float32)
            yield from (row[:7].tobytes() for row in rows)
        return
    if isinstance(given, str):
        numbers = np.array(re.findall(r"-?\d+\.\d+(?:e-?\d+)?", given), np.float32)
        yield from (numbers[at : at + 7].tobytes() for at in range(len(numbers) - 6))
    elif isinstance(given, Mapping):
        yield from pieces([*given.keys(), *given.values()], seen)
    elif isinstance(given, Sequence | Set):
        for one in given:
            yield from pieces(one, seen)
    if hasattr(given, "__dict__") and not isinstance(given, type):
        yield from pieces(list(vars(given).values()), seen)


def make_cheat() -> Cheat:
    return Cheat()


class Scripted(World):
    """Carries out answers at once: the first action has the number of one, and it is right or not.

    Only for episodes whose questions the buffer set has.
    """

    def reset(
        self, episode_id: str, demonstration: bool = True
    ) -> tuple[Demonstration, Observation, EpisodeInfo]:
        question = read_questions(buffer_set_here())[EpisodeId.parse(episode_id)]
        self.right = question.answers[question.right]
        self.acted: int | None = None
        return super().reset(episode_id, demonstration)

    def act(self, policy: str, known: Any = None, answer: int | None = None) -> NDArray[np.float32]:
        assert policy == "answer" and answer is not None
        self.acted = answer
        return np.zeros(8, np.float32)

    def step(self, action: NDArray[np.float32], observe: bool = True) -> tuple[Observation, Status]:
        if self.acted is None:  # the policy holds its pose
            return Observation({}, self.seen.state), Status.ONGOING
        right = self.acted == self.right
        return Observation({}, self.seen.state), Status.SUCCESS if right else Status.FAIL


class Rendered(Simulator):
    """What `rendered_world` declares: the renderer in `WORLDS_RENDERER`."""

    @classmethod
    def renderer(cls) -> str | None:
        return os.environ.get(RENDERER)


def rendered_world() -> Rendered:
    """A `World` on a machine with that renderer."""
    return cast(Rendered, World())
