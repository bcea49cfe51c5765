"""What every vision-language model is to the harness, wherever it runs."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Video:
    """Frames that follow each other.

    Attributes:
        frames: `(T, H, W, 3) uint8` RGB, T at least 1.
        fps: Frames per second at which they are shown.
    """

    frames: NDArray[np.uint8]
    fps: float


Part = str | NDArray[np.uint8] | Video
"""Words, an image, `(H, W, 3) uint8` RGB, or a video."""


@dataclass(frozen=True)
class Message:
    """One message of a conversation: its parts in order."""

    role: Literal["system", "user", "assistant"]
    parts: tuple[Part, ...]


@dataclass(frozen=True)
class Reply:
    """What a model answered.

    Attributes:
        text: Its words; empty if it refused, or had nothing to say.
        tokens: Tokens of question and answer together; None if it does not say.
        calls: How often it was asked for this answer: more than once after faults.
        seconds: Until the answer was there, waiting before further calls included.
    """

    text: str
    tokens: int | None
    calls: int
    seconds: float


class ChatModel(ABC):
    """A vision-language model. It keeps nothing from one call to the next.

    Attributes:
        images: Images of a question at most: frames of videos, which count, too, are thinned out.
            None if it is sent videos as such, which have no bound.
    """

    images: int | None = None

    @abstractmethod
    def reply(self, messages: Sequence[Message]) -> Reply:
        """Answer a conversation whose last message is the user's."""

    @abstractmethod
    def metadata(self) -> dict[str, Any]:
        """Return plain values that say which model this is, for the record of the run."""

    def close(self) -> None:
        """Release everything."""
