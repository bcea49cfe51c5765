"""SigLIP and SigLIP 2, the paper's encoders: the only file that imports transformers."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import PAPER_ENCODER
from robomme_interference_data.errors import FormatError, MissingExtraError, first_line
from robomme_interference_data.runtime.device import choose_device
from robomme_interference_data.storage.hub import HubFiles, locate
from robomme_interference_data.storage.weights import digest_weights

from . import encoder_name

_FILES = ("*.json", "*.safetensors")

_VERSION = 2
"""Version of the computation in this file, and of the digest of weights."""

_NOT_COMPUTING = ("_name_or_path", "architectures", "dtype", "transformers_version")
"""Settings of a vision tower that record its origin and do not affect its output."""

_INCOMPLETE = "The folder does not hold a complete model: download or save it again."


class Siglip:
    """The vision tower of a SigLIP or SigLIP 2 model: its pooled output.

    The fingerprint comes from the model's files. The weights are loaded when `features` is first
    called, so that a process that only needs the fingerprint does not load them.

    Args:
        model: Id on the Hub, with `@revision` unless it is the main branch, or a folder.
        device: Device to compute on, such as `cpu` or `cuda`; None for a GPU if there is one.
        batch: Images per batch; None for 32 on a GPU and 8 on a CPU.
    """

    centered = False

    def __init__(self, model: str, device: str | None = None, batch: int | None = None):
        files = locate(model, "model")  # a missing folder is reported before the slow imports
        try:
            import PIL  # noqa: F401 - the image processor needs it
            import torch
            import transformers
        except ImportError as error:
            library = f"torch, transformers and Pillow ({error})"
            raise MissingExtraError.needs("the encoder siglip", library, "retrieval") from error
        self._arguments = model, device, batch
        self.name = encoder_name(f"siglip:{model}")
        origin: dict[str, str | None] = {"model": None, "revision": None}
        self._folder = files.snapshot(*_FILES)
        if isinstance(files, HubFiles):
            origin = {"model": files.name, "revision": files.commit}
        self._device = choose_device(device)
        self._dtype = torch.float32
        if self._device.type == "cuda":
            self._dtype = torch.bfloat16 if torch.cuda.is_bf16_supported() else torch.float16
        self.computed_in = f"{self._device.type}, {str(self._dtype).removeprefix('torch.')}"
        self.batch = batch or (32 if self._device.type == "cuda" else 8)
        with self._format_errors():
            config = transformers.AutoConfig.from_pretrained(self._folder)
            classes: dict[str, Any] = {
                "siglip": transformers.SiglipVisionModel,
                "siglip2": transformers.Siglip2VisionModel,
            }
            model_type = str(config.model_type)
            if model_type.removesuffix("_vision_model") not in classes:
                raise FormatError(
                    f"{model} is a model of type {model_type!r}; expected SigLIP or SigLIP 2",
                    f'For example: encoder="siglip:{PAPER_ENCODER}"',
                )
            self._tower = classes[model_type.removesuffix("_vision_model")]
            if not any(self._folder.glob("*.safetensors")):
                raise OSError("it has no weights, *.safetensors")
            # Pillow resizes the same everywhere; the other backend needs torchvision.
            processors: Any = transformers.AutoImageProcessor
            self._processor = processors.from_pretrained(
                self._folder, backend="pil", local_files_only=True
            )
        tower = json.loads(getattr(config, "vision_config", config).to_json_string())
        self.fingerprint: dict[str, Any] = {
            "name": "siglip",
            "version": _VERSION,
            "transformers": str(transformers.__version__),
            **origin,
            "weights_sha256": digest_weights(self._folder, ["*.safetensors"]),
            "tower": {key: tower[key] for key in tower if key not in _NOT_COMPUTING},
            "preprocessing": {
                "class": type(self._processor).__name__,
                **json.loads(self._processor.to_json_string()),
            },
        }

    def __reduce__(self) -> tuple[Any, ...]:
        """Let a worker process load the model itself."""
        return Siglip, self._arguments

    def prepare(self, images: NDArray[np.uint8]) -> Any:
        """Preprocess images as the model's own image processor does."""
        return self._processor(images=list(images), return_tensors="pt")

    def features(self, prepared: Any) -> NDArray[np.float32]:
        """Return the pooled outputs of the vision tower, `(N, D) float32`."""
        import torch

        inputs = {
            name: value.to(self._device, self._dtype if value.is_floating_point() else None)
            for name, value in prepared.items()
        }
        with torch.inference_mode():
            pooled = self._vision(**inputs).pooler_output
        return pooled.float().cpu().numpy()

    @cached_property
    def _vision(self) -> Any:
        """The vision tower on its device, for inference."""
        with self._format_errors(), _quiet():
            vision, loading = self._tower.from_pretrained(
                self._folder, dtype="float32", local_files_only=True, output_loading_info=True
            )
        # transformers fills what the file lacks with random numbers.
        if missing := sorted(loading["missing_keys"]):
            raise FormatError(
                f"{self._folder} lacks {len(missing)} of the {len(vision.state_dict())} tensors of "
                f"the vision tower, such as {missing[0]}",
                _INCOMPLETE,
            )
        return vision.eval().to(self._device, self._dtype)

    @contextmanager
    def _format_errors(self) -> Iterator[None]:
        from safetensors import SafetensorError

        try:
            yield
        except FormatError:
            raise
        except (OSError, ValueError, RuntimeError, SafetensorError) as error:
            message = f"{self.name} cannot be loaded from {self._folder}: {first_line(error)}"
            raise FormatError(message, _INCOMPLETE) from error


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep transformers from reporting that the text tower of the file is not loaded."""
    import transformers

    logging: Any = transformers.utils.logging
    level, bars = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(level)
        if bars:
            logging.enable_progress_bar()
