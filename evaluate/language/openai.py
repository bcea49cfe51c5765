"""Models behind an OpenAI-compatible chat endpoint, such as vLLM, SGLang or ms-swift serve."""

import math
import os
import time
from collections.abc import Sequence
from typing import Any
from weakref import WeakSet

import httpx
import openai
from openai import OpenAI

from robomme_interference_data.errors import InvalidOptionError, ModelError, first_line
from robomme_interference_data.evaluate.deadline import shutdown_after
from robomme_interference_data.retry import growing, retry
from robomme_interference_data.storage.video.encode import png

from .images import data_url, mp4, within
from .models import ChatModel, Message, Part, Reply, Video

_WAITS = "Re-run the same command to resume."

_PAUSE_S = 0.5
"""Seconds to wait after the first invalid answer; they double after each further one."""

_LONGEST_PAUSE_S = 8.0
"""The longest pause; as the client has it after other faults."""

_DAY_S = 86_400.0

_UNREADABLE = (AttributeError, LookupError, RecursionError, TypeError, ValueError)
"""What the client raises for an answer that is no JSON, too deep, or of another form."""


class OpenAIModel(ChatModel):
    """A chat endpoint that takes images.

    After a temporary fault (no connection, no answer in time, 429, 5xx, an invalid answer) a
    question is repeated up to `repeats` times, with growing pauses or after `Retry-After`, at most
    two minutes. A refusal is an answer without text. The API key is
    `OPENAI_API_KEY`; local servers mostly need none.

    Args:
        url: The base, such as `http://localhost:8000/v1`.
        model: Name of the model at the endpoint.
        max_tokens: Maximum tokens of an answer.
        temperature: 0 for the most likely answer, as far as the server is deterministic.
        images: Maximum images in a question; videos are thinned out.
        video: How videos are sent: as `images`, or `mp4`, one `video_url` as vLLM and SGLang take.
        repeats: Maximum repetitions of a question.
        connect_s: Maximum seconds until a connection is open.
        response_s: Maximum seconds until the end of an answer, which has 16 MiB at most.
    """

    def __init__(
        self,
        url: str,
        model: str,
        *,
        max_tokens: int = 256,
        temperature: float = 0.0,
        images: int = 48,
        video: str = "images",
        repeats: int = 5,
        connect_s: float = 20.0,
        response_s: float = 300.0,
    ):
        if video not in ("images", "mp4"):
            raise InvalidOptionError.one_of("video", video, ("images", "mp4"))
        if min(max_tokens, images) < 1 or repeats < 0 or not 0 <= temperature < math.inf:
            raise InvalidOptionError(
                f"max_tokens {max_tokens}, images {images}, temperature {temperature}, repeats "
                f"{repeats}; expected at least 1, 1, 0 and 0"
            )
        if not (0 < connect_s <= _DAY_S and 0 < response_s <= _DAY_S):
            raise InvalidOptionError(
                f"connect_s {connect_s}, response_s {response_s}; expected seconds above 0, at "
                "most a day"
            )
        self._url, self._model = url, model
        self._settings: dict[str, Any] = {"max_tokens": max_tokens, "temperature": temperature}
        self.images = None if video == "mp4" else images
        self._repeats = repeats
        client: Any = BoundedClient(connect_s + response_s)
        self._client = OpenAI(
            base_url=url,
            api_key=_key(),
            timeout=openai.Timeout(response_s, connect=connect_s),
            max_retries=repeats,
            http_client=client,
        )

    def reply(self, messages: Sequence[Message]) -> Reply:
        """Ask, with repetitions after temporary faults; see `ChatModel.reply`."""
        conversation: Any = [
            {"role": message.role, "content": _content(message.parts)}
            for message in within(messages, self.images)
        ]
        began, calls = time.perf_counter(), 0

        def ask() -> Reply:
            nonlocal calls
            try:
                client = self._client.with_options(max_retries=self._repeats - calls)
                response = client.chat.completions.with_raw_response.create(
                    model=self._model, messages=conversation, **self._settings
                )
            except openai.NotFoundError as error:
                self.metadata()  # raises, with the served models, if this is none of them
                raise self._error(error) from error
            except openai.APIError as error:
                raise self._error(error) from error
            calls += response.retries_taken + 1
            return _read(response.parse(), calls, time.perf_counter() - began)

        def is_temporary(error: Exception) -> bool:
            return isinstance(error, _UNREADABLE) and calls <= self._repeats

        try:
            return retry(ask, is_temporary, growing(_PAUSE_S, _LONGEST_PAUSE_S))
        except _UNREADABLE as error:
            fault = f"{type(error).__name__}: {first_line(error)}"
            raise ModelError(
                f"{self._url} answers {calls} calls without a chat completion ({fault})",
                f"Is it the base of an OpenAI-compatible endpoint, mostly ending in /v1? {_WAITS}",
            ) from error

    def metadata(self) -> dict[str, Any]:
        """Return the model's name, after checking that the endpoint serves it."""
        try:
            known = [model.id for model in self._client.models.list()]
        except openai.APIError as error:
            raise self._error(error) from error
        except _UNREADABLE as error:
            raise ModelError(
                f"{self._url} does not list its models: {first_line(error)}",
                "Is it the base of an OpenAI-compatible endpoint, mostly ending in /v1?",
            ) from error
        if self._model not in known:
            raise ModelError(
                f"{self._url} serves no model {self._model!r}",
                f"It serves {', '.join(known) or 'none'}.",
            )
        return {"model": self._model}

    def close(self) -> None:
        """Close the connection."""
        self._client.close()

    def _error(self, error: openai.APIError) -> ModelError:
        status = getattr(error, "status_code", None)
        if isinstance(error, openai.APITimeoutError):
            return ModelError(f"{self._url} gave no answer in time", f"Raise response_s. {_WAITS}")
        if isinstance(error.__cause__, AnswerTooLongError):
            return ModelError(f"{self._url} sends too long an answer: {error.__cause__}")
        if isinstance(error, openai.APIConnectionError):
            cause = first_line(error.__cause__ or error)
            return ModelError(
                f"{self._url} cannot be reached: {cause}", f"Is the server running? {_WAITS}"
            )
        hints = {
            401: "Set its API key: export OPENAI_API_KEY=…",
            404: f"Does it serve the model {self._model!r}? Is the base right, mostly …/v1?",
            429: f"It is overloaded, or a limit was reached. {_WAITS}",
        }
        text = first_line(error)[:500]
        return ModelError(
            f"{self._url} answers {status or 'an error'}: {text}", hints.get(status or 0)
        )


def _key() -> str:
    """Return the key; servers of one's own take any."""
    key = os.environ.get("OPENAI_API_KEY", "").strip() or "none"
    if not (key.isascii() and key.isprintable()):
        raise InvalidOptionError(
            "OPENAI_API_KEY holds what no key does: more than one line, or other than ASCII",
            "Set it anew: export OPENAI_API_KEY=…",
        )
    return key


def _content(parts: Sequence[Part]) -> Any:
    if len(parts) == 1 and isinstance(parts[0], str):
        return parts[0]  # some chat templates take no lists for a system message
    content: list[dict[str, Any]] = []
    for part in parts:
        if isinstance(part, str):
            content.append({"type": "text", "text": part})
        elif isinstance(part, Video):
            url = {"url": data_url("video/mp4", mp4(part))}
            content.append({"type": "video_url", "video_url": url})
        else:
            url = {"url": data_url("image/png", png(part))}
            content.append({"type": "image_url", "image_url": url})
    return content


def _read(answer: Any, calls: int, seconds: float) -> Reply:
    """Read a completion; an invalid one raises an error of attribute access."""
    message = answer.choices[0].message
    text = message.content
    if text is not None and not isinstance(text, str):
        raise TypeError(f"content is {text!r}")
    # Half a surrogate pair is valid JSON, but cannot be sent back or written.
    text = (text or "").encode(errors="replace").decode()
    tokens = getattr(answer.usage, "total_tokens", None)
    return Reply(text, tokens if type(tokens) is int else None, calls, seconds)


# --- limits of an answer -------------------------------------------------------------------------

MAX_BYTES = 16 << 20
"""Maximum bytes of an answer; a usual one has a few thousand."""


class AnswerTooLongError(httpx.RequestError):
    """An answer has more bytes than `MAX_BYTES`."""


class BoundedClient(httpx.Client):
    """An HTTP client for one thread whose limits a server cannot extend.

    Args:
        answer_s: Maximum seconds from a request to the last byte of its answer.
    """

    def __init__(self, answer_s: float):
        super().__init__(follow_redirects=True, headers={"Accept-Encoding": "identity"})
        self._answer_s = answer_s
        self._streams: WeakSet[Any] = WeakSet()

    def send(self, request: httpx.Request, **options: Any) -> httpx.Response:  # type: ignore[override]
        """Send a request and read its answer, uncompressed, within the limits."""
        request.extensions = {**request.extensions, "trace": self._keep_stream}
        with shutdown_after(self._answer_s, self._sockets) as expired:
            try:
                response = _read_stream(super().send(request, **options | {"stream": True}))
            except httpx.TransportError:
                if not expired.is_set():
                    raise
        if expired.is_set():  # a shut down connection may look like the end of the answer
            raise httpx.ReadTimeout("no whole answer in time", request=request)
        return response

    def _sockets(self) -> list[Any]:
        return [stream.get_extra_info("socket") for stream in self._streams]

    def _keep_stream(self, event: str, info: dict[str, Any]) -> None:
        """Remember connections as they open; see httpx's `trace` extension."""
        if event.endswith((".connect_tcp.complete", ".start_tls.complete")):
            self._streams.add(info["return_value"])


def _read_stream(response: httpx.Response) -> httpx.Response:
    """Read a streamed response."""
    content = bytearray()
    try:
        for chunk in response.iter_raw():
            content += chunk
            if len(content) > MAX_BYTES:
                raise AnswerTooLongError(f"an answer of more than {MAX_BYTES} bytes")
    finally:
        response.close()
    # A server may compress all the same; without this header httpx does not decompress the answer,
    # whose size would then be unlimited.
    headers = [(k, v) for k, v in response.headers.multi_items() if k != "content-encoding"]
    return httpx.Response(
        response.status_code,
        headers=headers,
        content=bytes(content),
        request=response.request,
        extensions=response.extensions,
        history=response.history,
    )
