"""Vision-language models by their text; each is imported when it is made."""

from collections.abc import Mapping, Sequence
from typing import Any
from urllib.parse import urlsplit

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.runtime.specs import Kind, Registry, Spec, bind_options
from robomme_interference_data.storage.hub import HubFiles, locate

from .model import ChatModel

MODELS = Registry(
    "model",
    {
        "openai": Kind(
            "openai:URL#MODEL, such as openai:http://localhost:8000/v1#Qwen/Qwen3-VL-4B-Instruct",
            f"{__package__}.openai:OpenAIModel",
            r"(?P<url>https?://[^#\s]+)#(?P<model>\S+)",
            extra="vlm",
            no_effect=("connect_s", "response_s", "repeats"),
        ),
        "transformers": Kind(
            "transformers:NAMESPACE/NAME[@REVISION] or transformers:FOLDER",
            f"{__package__}.transformers:TransformersModel",
            r"(?P<path>.+)",
            extra="vlm",
            # Files are known by their digests, wherever they lie.
            no_effect=("device", "adapter", "model", "revision"),
        ),
    },
)


def parse_model(text: str) -> Spec:
    """Read a model as it is written."""
    spec = MODELS.parse(text)
    if spec.kind == "openai" and not _is_endpoint(spec.given["url"]):
        raise InvalidOptionError.expected("model", text, MODELS.kinds["openai"].form)
    return spec


def _is_endpoint(url: str) -> bool:
    """Whether it has a host and no key, which would be shown with it; that has a variable."""
    try:
        parts = urlsplit(url)
        return bool(parts.hostname) and parts.port != 0 and "@" not in parts.netloc
    except ValueError:  # its port
        return False


def pin_model(text: str) -> str:
    """Return the one text of a model: one on the Hub has its commit, asked for once."""
    spec = parse_model(text)
    if spec.kind == "transformers":
        files = locate(spec.given["path"], "model")
        if isinstance(files, HubFiles):
            return f"transformers:{files.repo_id}@{files.commit}"
    return text


def make_model(text: str, options: Sequence[str] = (), also: Sequence[str] = ()) -> ChatModel:
    """Make a model in this process. No endpoint is reached before the first question."""
    spec = parse_model(text)
    factory = MODELS.factory(spec)
    bound = bind_options(f"model {text!r}", factory, spec.given, options, also)
    made: ChatModel = factory(**spec.given, **bound)
    return made


def model_identity(
    text: str, options: Sequence[str], metadata: Mapping[str, Any]
) -> dict[str, Any]:
    """Return what of a model can change an answer, as plain values.

    Where it is served or lies is no part of it, a digest of its files is.
    """
    spec = parse_model(text)
    bound = bind_options(f"model {text!r}", MODELS.factory(spec), spec.given, options)
    return {
        "kind": spec.kind,
        **MODELS.identity(spec, metadata),
        "options": MODELS.identity(spec, bound),
    }
