"""Vision-language models in this process, with transformers."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
import transformers
from jinja2 import TemplateError
from PIL import Image

from robomme_interference_data.errors import (
    InvalidOptionError,
    MissingExtraError,
    ModelError,
    first_line,
)
from robomme_interference_data.runtime.device import choose_device
from robomme_interference_data.storage.hub import HubFiles, locate
from robomme_interference_data.storage.weights import digest_weights

from .images import within
from .models import ChatModel, Message, Reply

_FILES = ("*.json", "*.safetensors", "*.jinja", "*.txt", "*.model")


class TransformersModel(ChatModel):
    """A vision-language model and its processor, as `save_pretrained` writes them.

    It decodes greedily, so the same question has the same answer on one machine. Frames of videos
    are shown as images.

    Args:
        path: A folder, or a model on the Hub, `namespace/name` or `namespace/name@revision`.
        adapter: A PEFT adapter for it, a folder or on the Hub.
        device: `cpu`, `cuda` or `cuda:1`; None for the first GPU, or else the CPU.
        max_tokens: Maximum tokens of an answer.
        images: Maximum images in a question; videos are thinned out.
    """

    def __init__(
        self,
        path: str,
        *,
        adapter: str | None = None,
        device: str | None = None,
        max_tokens: int = 256,
        images: int = 48,
    ):
        if min(max_tokens, images) < 1:
            raise InvalidOptionError(
                f"max_tokens {max_tokens}, images {images}; expected at least 1"
            )
        self._max_tokens, self.images = max_tokens, images
        self._device = choose_device(device)
        files = locate(path, "model")
        self._path, self._folder = path, files.snapshot(*_FILES)
        self._metadata: dict[str, Any] = {"sha256": digest_weights(self._folder, _FILES)}
        if isinstance(files, HubFiles):
            self._metadata |= {"model": files.name, "revision": files.commit}
        self._adapter: Path | None = None
        if adapter is not None:
            if find_spec("peft") is None:
                raise MissingExtraError.needs("an adapter", "peft", "vlm")
            self._adapter = locate(adapter, "model").snapshot(*_FILES)
            self._metadata["adapter_sha256"] = digest_weights(self._adapter, _FILES)
        with self._explained():
            processors: Any = transformers.AutoProcessor
            self._processor = processors.from_pretrained(self._folder)
            # Cheap checks: the weights themselves are loaded by the first question.
            transformers.AutoConfig.from_pretrained(self._folder)
            if not any(self._folder.glob("*.safetensors")):
                raise OSError("it has no weights, *.safetensors")
        self._model: Any = None

    @contextmanager
    def _explained(self) -> Iterator[None]:
        try:
            yield
        except (OSError, ValueError, RuntimeError, KeyError, TypeError) as error:
            raise ModelError(
                f"transformers cannot load the model {self._path}: {first_line(error)}",
                "Expected an image-text-to-text model with its processor, as save_pretrained "
                "writes both.",
            ) from error

    def _load(self) -> Any:
        """Load the weights on first use: the driver needs only their digest."""
        with self._explained():
            models: Any = transformers.AutoModelForImageTextToText
            model = models.from_pretrained(self._folder, dtype="auto")
            if self._adapter is not None:
                from peft import PeftModel

                model = PeftModel.from_pretrained(model, self._adapter)
            return model.to(self._device).eval()

    def reply(self, messages: Sequence[Message]) -> Reply:
        """Answer; see `ChatModel.reply`."""
        if self._model is None:
            self._model = self._load()
        began = time.perf_counter()
        conversation = [
            {
                "role": message.role,
                "content": [
                    {"type": "text", "text": part}
                    if isinstance(part, str)
                    else {"type": "image", "image": Image.fromarray(np.asarray(part))}
                    for part in message.parts
                ],
            }
            for message in within(messages, self.images)
        ]
        try:
            inputs = self._processor.apply_chat_template(
                conversation,
                add_generation_prompt=True,
                tokenize=True,
                return_dict=True,
                return_tensors="pt",
            ).to(self._device)
            with torch.inference_mode():
                tokens = self._model.generate(
                    **inputs, max_new_tokens=self._max_tokens, do_sample=False
                )[0]
        except (RuntimeError, ValueError, TypeError, IndexError, TemplateError) as error:
            raise ModelError(
                f"the model failed: {type(error).__name__}: {first_line(error)}",
                "If memory is too small, set fewer images (images=16) or another device.",
            ) from error
        answer = tokens[inputs["input_ids"].shape[1] :]
        text = self._processor.batch_decode(answer[None], skip_special_tokens=True)[0]
        return Reply(text.strip(), len(tokens), 1, time.perf_counter() - began)

    def metadata(self) -> dict[str, Any]:
        """Return the SHA-256 of its files and of its adapter's; on the Hub also the commit."""
        return dict(self._metadata)
