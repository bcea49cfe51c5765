"""The interface of vision-language models."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Video:
    """Consecutive frames.

    Attributes:
        frames: `(T, H, W, 3) uint8` RGB, T at least 1.
        fps: Frames per second at which they are shown.
    """

    frames: NDArray[np.uint8]
    fps: float


Part = str | NDArray[np.uint8] | Video
"""Text, an image `(H, W, 3) uint8` RGB, or a video."""


@dataclass(frozen=True)
class Message:
    """One message of a conversation: its parts in order."""

    role: Literal["system", "user", "assistant"]
    parts: tuple[Part, ...]


@dataclass(frozen=True)
class Reply:
    """The answer of a model.

    Attributes:
        text: Its text; empty after a refusal.
        tokens: Tokens of question and answer together; None if not reported.
        calls: Number of calls for this answer: more than one after faults.
        seconds: Time of all calls, with the pauses between them.
    """

    text: str
    tokens: int | None
    calls: int
    seconds: float


class ChatModel(ABC):
    """A vision-language model, without state between calls.

    Attributes:
        images: Maximum images of a question, with the frames of videos, which are thinned out. None
            if the model takes videos as such.
    """

    images: int | None = None

    @abstractmethod
    def reply(self, messages: Sequence[Message]) -> Reply:
        """Answer a conversation whose last message is the user's."""

    @abstractmethod
    def metadata(self) -> dict[str, Any]:
        """Return plain values that identify the model, for `run.json`."""

    def close(self) -> None:
        """Release all resources."""
