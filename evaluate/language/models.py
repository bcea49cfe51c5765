"""Vision-language models: their interface, and their kinds by name; each is imported when made."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.runtime.specs import Registry, SpecKind


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


def _is_endpoint(target: str) -> bool:
    """Whether a URL has a host, and no key, which messages would show."""
    try:
        parts = urlsplit(target.partition("#")[0])
        return bool(parts.hostname) and parts.port != 0 and "@" not in parts.netloc
    except ValueError:  # an invalid port
        return False


MODELS = Registry(
    "model",
    {
        "openai": SpecKind(
            "openai:URL#MODEL, such as openai:http://localhost:8000/v1#Qwen/Qwen3-VL-4B-Instruct",
            f"{__package__}.openai:OpenAIModel",
            r"(?P<url>https?://[^#\s]+)#(?P<model>\S+)",
            extra="vlm",
            not_in_identity=("connect_s", "response_s", "repeats"),
            valid=_is_endpoint,
        ),
        "transformers": SpecKind(
            "transformers:NAMESPACE/NAME[@REVISION] or transformers:FOLDER",
            f"{__package__}.transformers:TransformersModel",
            r"(?P<path>.+)",
            extra="vlm",
            # Digests identify files, wherever they are.
            not_in_identity=("device", "adapter", "model", "revision"),
            on_hub=True,
        ),
    },
)


def model_identity(
    text: str, options: Sequence[str], metadata: Mapping[str, Any]
) -> dict[str, Any]:
    """Return what of a model can change an answer, as plain values: digests, but no addresses."""
    spec = MODELS.parse(text)
    return {
        "kind": spec.kind,
        **MODELS.identity(spec, metadata),
        "options": MODELS.identity(spec, MODELS.options(text, options)),
    }
