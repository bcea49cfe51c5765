"""Questions of the golden `tabletop` buffer set, put to whoever answers."""

from functools import cache
from pathlib import Path
from typing import Any

from support.chat_server import ChatServer, Seen
from support.tabletop import QUERIES, TABLETOP

from robomme_interference_data import load_buffer_set
from robomme_interference_data.data.questions import Question, read_questions
from robomme_interference_data.evaluate import RunResult
from robomme_interference_data.evaluate.run.config import AskConfig
from robomme_interference_data.evaluate.run.evaluation import run_evaluation
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.runtime.executor import Executor, Serial


@cache
def questions() -> dict[EpisodeId, Question]:
    """All questions of the buffer set."""
    return read_questions(load_buffer_set(TABLETOP))


def right_letter(episode: EpisodeId) -> str:
    """The letter of the right option."""
    question = questions()[episode]
    return question.letters[question.right]


def ask(
    out: Path, *, executor: Executor | None = None, progress: Any = None, **changes: Any
) -> RunResult:
    """Ask all questions under k0, unless told otherwise."""
    usual: dict[str, Any] = {"model": "recall", "buffer_set": TABLETOP, "conditions": ("k0",)}
    config = AskConfig(out=out, **usual | changes)
    return run_evaluation(config, executor=executor or Serial(), progress=progress)


def behind(server: ChatServer, **changes: Any) -> dict[str, Any]:
    """Settings that put the questions to a server's model."""
    return {"model": f"openai:{server.url}#tiny", "system": "tiny"} | changes


def look(seen: Seen) -> str:
    """Answer as somebody who knows what is right as soon as a frame shows a part of it."""
    *history, _ = seen.images
    for image in history:
        _, number, part = image[0, 0]
        if part and number < len(QUERIES):
            return f"The answer is {right_letter(QUERIES[number])}."
    return "I cannot tell."
