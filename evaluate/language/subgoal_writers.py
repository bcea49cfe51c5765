"""Writers of subgoals, which run before each chunk of a policy's actions: oracle, or a model."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.evaluate.policies.policy import RolloutInfo
from robomme_interference_data.schema.sampling import spread
from robomme_interference_data.schema.subgoal import Subgoal
from robomme_interference_data.simulators.base import Simulator
from robomme_interference_data.simulators.episode import Observation

from .images import HistoryFrames
from .models import ChatModel, Message, Part, Reply
from .prompt_files import as_text, describe_prompted
from .subgoal_prompt import NextSubgoal, SubgoalPrompt, merge_near


@dataclass(frozen=True)
class Turn:
    """One subgoal: a line of a transcript in the run's folder.

    Attributes:
        step: Number of actions before it.
        subgoal: The subgoal, with points as `<y, x>`.
        prompt: The prompt of the model, with `[image]` and `[video of n frames]`.
        answer: The answer of the model.
        fault: Why the answer is invalid; None if it is valid.
        keyframes: The selected key frames, by the number of actions before them.
        tokens: Tokens of prompt and answer; None if not reported.
        calls: Number of calls of the model.
        seconds: Time until the answer.
    """

    step: int
    subgoal: str
    prompt: str | None = None
    answer: str | None = None
    fault: str | None = None
    keyframes: tuple[int, ...] = ()
    tokens: int | None = None
    calls: int = 0
    seconds: float = 0.0


class SubgoalWriter(ABC):
    """Writes subgoals, one rollout at a time.

    The calls come in this order: `start`; `watch` with the first live observation; `next`; up to
    16 actions are executed; `watch` with the observations after them; `next`; and so on.

    Attributes:
        every_frame: Whether `watch` gets the observations after every action; if not, only the one
            on which the policy acts next.
        turns: The subgoals of this rollout.
    """

    every_frame: bool = False

    def __init__(self) -> None:
        self.turns: list[Turn] = []

    def start(self, history: HistoryFrames, info: RolloutInfo, simulator: Simulator) -> None:
        """Clear the state and prepare for a rollout; only `oracle` may use the simulator."""
        self.turns = []

    def watch(self, observations: Sequence[Observation]) -> None:
        """Receive the observations since the last call, the current one last."""

    @abstractmethod
    def next(self, observation: Observation, step: int) -> Subgoal:
        """Return the next subgoal.

        Args:
            observation: The current observation, the last one of `watch`.
            step: Number of actions so far.
        """

    @abstractmethod
    def metadata(self) -> dict[str, Any]:
        """Return plain values that identify the writer, for `run.json`."""

    def close(self) -> None:
        """Release all resources."""


class OracleWriter(SubgoalWriter):
    """`oracle`: the simulator's own current subgoal, which knows the hidden answer."""

    def start(self, history: HistoryFrames, info: RolloutInfo, simulator: Simulator) -> None:
        """Keep the simulator."""
        super().start(history, info, simulator)
        self._simulator = simulator

    def next(self, observation: Observation, step: int) -> Subgoal:
        """Return the simulator's subgoal; see `Simulator.subgoal` for its errors."""
        subgoal = self._simulator.subgoal()
        self.turns.append(Turn(step, subgoal.grounded))
        return subgoal

    def metadata(self) -> dict[str, Any]:
        """Return its name."""
        return {"subgoals": "oracle", "privileged": True}


class ModelWriter(SubgoalWriter):
    """A vision-language model in front of a policy.

    With a prompt that shows recent frames, the model may select key frames, which later prompts
    show; of frames near each other the median is kept (`MemER`). After an invalid answer the
    subgoal stays unchanged; at first it is the goal.

    Args:
        model: The model.
        prompt: The prompt.
        frames: Number of history frames that the model sees, evenly spread.
        fps: Frames per second of their video; None for the pace at which they were recorded.
        recent: Number of live frames that it sees, if the prompt shows them.
        stride: Steps from one of them to the next.
        near: Maximum distance of frames near each other.
    """

    def __init__(
        self,
        model: ChatModel,
        prompt: SubgoalPrompt,
        *,
        frames: int = 32,
        fps: float | None = None,
        recent: int = 8,
        stride: int = 2,
        near: int = 8,
    ):
        super().__init__()
        for name, value in (("frames", frames), ("recent", recent), ("stride", stride)):
            if value < 1:
                raise InvalidOptionError.expected(
                    f"the option {name} of subgoals", value, "1 or more"
                )
        if near < 0:
            raise InvalidOptionError.expected("the option near of subgoals", near, "0 or more")
        if fps is not None and not 1 <= fps <= 120:
            raise InvalidOptionError.expected("the option fps of subgoals", fps, "1 to 120")
        self._model, self._frames, self._fps, self._near = model, frames, fps, near
        self.prompt, self.every_frame = prompt, prompt.watches
        self._recent, self._stride = recent, stride
        # No more live frames than the prompt can show.
        self._seen: deque[NDArray[np.uint8]] = deque(maxlen=(recent - 1) * stride + 1)

    def start(self, history: HistoryFrames, info: RolloutInfo, simulator: Simulator) -> None:
        """Decode the history frames that the model sees."""
        super().start(history, info, simulator)
        self._camera = history.camera
        places = spread(0, len(history), self._frames)
        self._history: list[Part] = [history.video(places, self._fps)] if places else []
        self._goal = info.goal
        self._subgoal = Subgoal(info.goal)  # until the first valid answer
        self._earlier: list[Subgoal] = []
        self._kept: dict[int, NDArray[np.uint8]] = {}
        self._seen.clear()
        self._count = 0  # live frames so far

    def watch(self, observations: Sequence[Observation]) -> None:
        """Keep the last live frames, if the prompt shows them."""
        for observation in observations:
            self._seen.append(observation.images[self._camera])
            self._count += 1

    def next(self, observation: Observation, step: int) -> Subgoal:
        """Ask the model; an invalid answer leaves the subgoal unchanged."""
        image = observation.images[self._camera]
        size = (image.shape[0], image.shape[1])
        recent = self._recent_frames()
        # Live frames have numbers from 0, and the last one that was seen has `_count` - 1.
        images = {number: self._seen[number - self._count] for number in recent}
        views: dict[str, Sequence[Part]] = {
            "<history>": self._history,
            "<keyframes>": [self._kept[number] for number in sorted(self._kept)],
            "<recent>": list(images.values()),
            "<image>": [image],
        }
        question = self.prompt.fill(self._goal, self._earlier, size, views)
        reply = self._model.reply(
            [Message("system", (self.prompt.system,)), Message("user", question)]
        )
        answer, fault = self._read(reply, size, len(recent))
        if answer is not None:
            self._subgoal = answer.subgoal
            # A subgoal of which only the points moved is still the same one.
            if not self._earlier or answer.subgoal.text != self._earlier[-1].text:
                self._earlier.append(answer.subgoal)
            self._keep(images, [recent[place] for place in answer.keyframes])
        self.turns.append(
            Turn(
                step,
                self._subgoal.grounded,
                prompt=as_text(question),
                answer=reply.text,
                fault=fault,
                keyframes=tuple(sorted(self._kept)),
                tokens=reply.tokens,
                calls=reply.calls,
                seconds=round(reply.seconds, 4),
            )
        )
        return self._subgoal

    def metadata(self) -> dict[str, Any]:
        """Return the model's metadata, and the SHA-256 of the prompt."""
        return describe_prompted(self._model, self.prompt)

    def close(self) -> None:
        """Close the model."""
        self._model.close()

    def _read(
        self, reply: Reply, size: tuple[int, int], shown: int
    ) -> tuple[NextSubgoal | None, str | None]:
        if not reply.text.strip():
            return None, "an empty answer"
        try:
            return self.prompt.read(reply.text, size, shown), None
        except InvalidOptionError as error:
            return None, error.message

    def _recent_frames(self) -> list[int]:
        """Return the numbers of the live frames that the model sees, the current one last."""
        if not self.prompt.watches:
            return []
        first = self._count - len(self._seen)
        return list(range(self._count - 1, first - 1, -self._stride))[: self._recent][::-1]

    def _keep(self, images: dict[int, NDArray[np.uint8]], numbers: Sequence[int]) -> None:
        frames = self._kept | {number: images[number] for number in numbers}
        self._kept = {number: frames[number] for number in merge_near([*frames], self._near)}
