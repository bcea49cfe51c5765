"""Vision-language models by their text; each is imported when it is made."""

from collections.abc import Mapping, Sequence
from typing import Any
from urllib.parse import urlsplit

from robomme_interference_data.runtime.specs import Kind, Registry


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
        "openai": Kind(
            "openai:URL#MODEL, such as openai:http://localhost:8000/v1#Qwen/Qwen3-VL-4B-Instruct",
            f"{__package__}.openai:OpenAIModel",
            r"(?P<url>https?://[^#\s]+)#(?P<model>\S+)",
            extra="vlm",
            no_effect=("connect_s", "response_s", "repeats"),
            valid=_is_endpoint,
        ),
        "transformers": Kind(
            "transformers:NAMESPACE/NAME[@REVISION] or transformers:FOLDER",
            f"{__package__}.transformers:TransformersModel",
            r"(?P<path>.+)",
            extra="vlm",
            # Digests identify files, wherever they are.
            no_effect=("device", "adapter", "model", "revision"),
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
