"""SigLIP and SigLIP 2, the paper's encoders: the only file that imports transformers."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import PAPER_ENCODER
from robomme_interference_data.errors import (
    FormatError,
    InvalidOptionError,
    MissingExtraError,
    first_line,
)
from robomme_interference_data.storage.hub import HubFiles, locate

from . import encoder_name

_FILES = ("*.json", "*.safetensors")

_VERSION = 1
"""Of what is done here: which output is taken, and how images reach the processor."""

_NOT_COMPUTING = ("_name_or_path", "architectures", "dtype", "transformers_version")
"""Settings of a vision tower that say where it came from, not what it computes."""

_NOT_WHOLE = "The folder is not a whole model: download or save it again."


class Siglip:
    """The vision tower of a SigLIP or SigLIP 2 model: its pooled output.

    Args:
        model: Id on the Hub, with `@revision` if it is not the main branch, or a folder.
        device: Where to compute, such as `cpu` or `cuda`; None for a GPU if there is one.
        batch: Images at a time; None for 32 on a GPU and 8 on a CPU.
    """

    centred = False

    def __init__(self, model: str, device: str | None = None, batch: int | None = None):
        files = locate(model, "model")  # a folder that is missing is told before seconds of imports
        try:
            import PIL  # noqa: F401 - the image processor needs it
            import torch
            import transformers
        except ImportError as error:
            library = f"torch, transformers and Pillow ({error})"
            raise MissingExtraError.needs("the encoder siglip", library, "retrieval") from error
        self._given = model, device, batch
        self._torch = torch
        self.name = encoder_name(f"siglip:{model}")
        origin: dict[str, str | None] = {"model": None, "revision": None}
        folder = files.snapshot(*_FILES)
        if isinstance(files, HubFiles):
            origin = {"model": files.repo_id, "revision": files.commit}
        try:
            self._device = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
            torch.empty(0, device=self._device)
        except (RuntimeError, AssertionError) as error:
            what = f"device {device!r} cannot be used: {first_line(error)}"
            raise InvalidOptionError(what, 'Try device="cpu".') from None
        self.batch = batch or (32 if self._device.type == "cuda" else 8)
        with _quiet(transformers):
            self._vision, self._processor = _load(transformers, model, folder)
        tower = json.loads(self._vision.config.to_json_string())
        self.fingerprint: dict[str, Any] = {
            "name": "siglip",
            "version": _VERSION,
            "transformers": str(transformers.__version__),
            **origin,
            "weights_sha256": _weights_digest(self._vision),
            "tower": {key: tower[key] for key in tower if key not in _NOT_COMPUTING},
            "preprocessing": {
                "class": type(self._processor).__name__,
                **json.loads(self._processor.to_json_string()),
            },
        }
        self._dtype = torch.float32
        if self._device.type == "cuda":
            self._dtype = torch.bfloat16 if torch.cuda.is_bf16_supported() else torch.float16
        self._vision.to(self._device, self._dtype)
        self.computed_in = f"{self._device.type}, {str(self._dtype).removeprefix('torch.')}"

    def __reduce__(self) -> tuple[Any, ...]:
        """Let a worker process load the model itself."""
        return Siglip, self._given

    def prepare(self, images: NDArray[np.uint8]) -> Any:
        """Preprocess images as the model's own image processor does."""
        return self._processor(images=list(images), return_tensors="pt")

    def features(self, prepared: Any) -> NDArray[np.float32]:
        """Return the pooled outputs of the vision tower, `(N, D) float32`."""
        inputs = {
            name: value.to(self._device, self._dtype if value.is_floating_point() else None)
            for name, value in prepared.items()
        }
        with self._torch.inference_mode():
            pooled = self._vision(**inputs).pooler_output
        return pooled.float().cpu().numpy()


@contextmanager
def _quiet(transformers: Any) -> Iterator[None]:
    """Keep transformers from reporting that the text tower of the file is left unread."""
    logging = transformers.utils.logging
    level, bars = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(level)
        if bars:
            logging.enable_progress_bar()


def _load(transformers: Any, model: str, folder: Path) -> tuple[Any, Any]:
    """Return the vision tower, in float32 and for inference, and its image processor."""
    from safetensors import SafetensorError

    try:
        kind = transformers.AutoConfig.from_pretrained(folder).model_type
        classes = {
            "siglip": transformers.SiglipVisionModel,
            "siglip2": transformers.Siglip2VisionModel,
        }
        tower = classes.get(kind.removesuffix("_vision_model"))
        if tower is None:
            raise FormatError(
                f"{model} is a model of type {kind!r}; expected SigLIP or SigLIP 2",
                f'For example: encoder="siglip:{PAPER_ENCODER}"',
            )
        vision, loading = tower.from_pretrained(
            folder, dtype="float32", local_files_only=True, output_loading_info=True
        )
        # transformers would make up what the file lacks, at random.
        if missing := sorted(loading["missing_keys"]):
            raise FormatError(
                f"{folder} lacks {len(missing)} of the {len(vision.state_dict())} tensors of the "
                f"vision tower of {model}, such as {missing[0]}",
                _NOT_WHOLE,
            )
        # Pillow resizes the same everywhere; the other backend only where torchvision is.
        processor = transformers.AutoImageProcessor.from_pretrained(
            folder, backend="pil", local_files_only=True
        )
    except FormatError:
        raise
    except (OSError, ValueError, RuntimeError, SafetensorError) as error:
        what = f"{model} cannot be loaded from {folder}: {first_line(error)}"
        raise FormatError(what, _NOT_WHOLE) from error
    return vision.eval(), processor


def _weights_digest(vision: Any) -> str:
    """Return the SHA-256 over the vision tower's weights, by name."""
    running = sha256()
    for name, value in sorted(vision.state_dict().items()):
        running.update(f"{name} {tuple(value.shape)}\n".encode())
        running.update(value.numpy().tobytes())
    return running.hexdigest()
