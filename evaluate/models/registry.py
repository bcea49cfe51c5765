"""Vision-language models by what is written on the command line; imported when they are made."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from robomme_interference_data.errors import InvalidOptionError, UnknownNameError, nearest
from robomme_interference_data.evaluate.specs import bind_options
from robomme_interference_data.lazy import load_extra
from robomme_interference_data.storage.hub import HubFiles, locate

from .model import ChatModel

_KINDS = {
    "openai": (
        r"(?P<url>https?://[^#\s]+)#(?P<model>\S+)",
        "openai:URL#MODEL, such as openai:http://localhost:8000/v1#Qwen/Qwen3-VL-4B-Instruct",
    ),
    "transformers": (
        r"(?P<path>.+)",
        "transformers:NAMESPACE/NAME[@REVISION] or transformers:FOLDER",
    ),
}
"""What follows each kind, and how that is told."""

_WITHOUT_EFFECT = {
    "openai": ("connect_s", "response_s", "repeats"),
    "transformers": ("device", "adapter", "model", "revision"),
}
"""Options, and what models say of themselves, that no answer depends on, by kind: where they run,
or lie (files are known by their digests), and how long they are waited for."""


@dataclass(frozen=True)
class ModelSpec:
    """A model as it is written: its kind, and the arguments that the text gives."""

    kind: str
    given: dict[str, str]


def parse_model(text: str) -> ModelSpec:
    """Read a model as it is written.

    Raises:
        UnknownNameError: There is no such kind.
        InvalidOptionError: What follows the kind is not as it should be.
    """
    kind, _, rest = text.partition(":")
    if kind not in _KINDS:
        forms = ", ".join(form for _, form in _KINDS.values())
        raise UnknownNameError(
            f"there is no model {text!r}; expected {forms}", nearest(kind, _KINDS, more="")
        )
    pattern, form = _KINDS[kind]
    match = re.fullmatch(pattern, rest, re.DOTALL)
    if match is None or (kind == "openai" and not _is_endpoint(match["url"])):
        raise InvalidOptionError.expected("model", text, form)
    return ModelSpec(kind, match.groupdict())


def _is_endpoint(url: str) -> bool:
    """Whether it has a host and no key, which would be told with it; that has a variable."""
    try:
        parts = urlsplit(url)
        return bool(parts.hostname) and parts.port != 0 and "@" not in parts.netloc
    except ValueError:  # its port
        return False


def pin_model(text: str) -> str:
    """Return the one text of a model: one on the Hub has its commit, asked for once.

    Raises:
        UnknownNameError, InvalidOptionError: The model is not written as it should be.
        HubError: The Hub does not know it, or cannot be reached.
    """
    spec = parse_model(text)
    if spec.kind == "transformers":
        files = locate(spec.given["path"], "model")
        if isinstance(files, HubFiles):
            return f"transformers:{files.repo_id}@{files.commit}"
    return text


def make_model(
    text: str, options: Sequence[str] = (), what: str = "model", also: Sequence[str] = ()
) -> ChatModel:
    """Make a model in this process. No endpoint is reached before the first question.

    Args:
        text: The model as it is written, see `parse_model`.
        options: Its options, each `NAME=VALUE`: see `OpenAIModel` and `TransformersModel`.
        what: What has options, for the messages: `--model-option`.
        also: Further options that `what` has, for the messages.

    Raises:
        UnknownNameError: There is no such model.
        InvalidOptionError: It is not written as it should be, or does not take an option.
        MissingExtraError: Its libraries are not installed.
        ModelError, HubError: Its files cannot be loaded.
    """
    spec, factory = parse_model(text), _factory(text)
    made: ChatModel = factory(
        **spec.given, **bind_options(text, factory, spec.given, options, what, also)
    )
    return made


def model_identity(
    text: str, options: Sequence[str], said: Mapping[str, Any], what: str = "model"
) -> dict[str, Any]:
    """Return what of a model can change an answer, as plain values.

    Where it is served or lies is no part of it, a digest of its files is; `said` is its metadata.
    """
    spec = parse_model(text)
    taken = bind_options(text, _factory(text), spec.given, options, what)
    without = _WITHOUT_EFFECT[spec.kind]
    told = {name: value for name, value in said.items() if name not in without}
    kept = {name: value for name, value in sorted(taken.items()) if name not in without}
    return {"kind": spec.kind, **told, "options": kept}


def _factory(text: str) -> Callable[..., Any]:
    kind = parse_model(text).kind
    name = {"openai": "OpenAIModel", "transformers": "TransformersModel"}[kind]
    return load_extra(f"{__package__}.{kind}", name, f"the model {text}", "vlm")
