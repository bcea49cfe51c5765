"""Responders to questions: the ideal observer, chance, or a model, with its prompt."""

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from robomme_interference_data.data.query import Query
from robomme_interference_data.data.questions import NOT_SHOWN, Question
from robomme_interference_data.errors import FormatError, InvalidOptionError
from robomme_interference_data.evaluate.run.config import AskConfig
from robomme_interference_data.simulators.registry import recorded_scene
from robomme_interference_data.storage.video.encode import decode_image

from .images import HistoryFrames
from .models import MODELS, Message, Part, Reply, Video
from .prompt_files import Prompt, as_text, describe_prompted, fill

CONTROLS = ("none", "blank", "text")
"""What a model does not see: nothing; the content of the history frames; all images."""


@dataclass(frozen=True)
class Prompted:
    """A question, with the history frames that are kept, and the parts of the answer they show."""

    question: Question
    query: Query
    seed: int
    known: Mapping[int, str] | None
    history: HistoryFrames

    def draw(self, letters: str) -> str:
        """Draw one of some letters, a function of episode and seed."""
        # Not a library's generator, whose draws may change with its version.
        lot = hashlib.sha256(f"{self.query.episode_id}/{self.seed}".encode()).digest()
        return letters[int.from_bytes(lot) % len(letters)]


def guess(prompted: Prompted) -> str:
    """Draw one of all options."""
    return prompted.draw(prompted.question.letters)


def abstain(prompted: Prompted) -> str:
    """Choose the option that it was not shown."""
    question = prompted.question
    if NOT_SHOWN not in question.answers:
        raise InvalidOptionError(
            f"the question of {question.episode_id} has no option that it was not shown",
            "Only questions of days have one: choose another model, such as guess.",
            option="model",
        )
    return question.letters[question.answers.index(NOT_SHOWN)]


def recall(prompted: Prompted) -> str:
    """Draw one of the options that agree with what the kept frames show; of all if none does.

    If they show nothing, and an option is that it was not shown, choose this one.
    """
    question, scene = prompted.question, recorded_scene(prompted.query)
    if scene is None or max(question.answers) >= len(scene.answers):
        raise FormatError(
            f"the options of {question.episode_id} are not answers that its scene allows",
            "recall needs a simulator whose possible answers are known, such as tabletop.",
        )
    if NOT_SHOWN in question.answers and not prompted.known:
        return abstain(prompted)
    agreeing = {scene.choice(answer) for answer in scene.agreeing(prompted.known or {})}
    fits = [
        letter
        for letter, number in zip(question.letters, question.answers, strict=True)
        if number != NOT_SHOWN and scene.choice(scene.answers[number]) in agreeing
    ]
    # Options are some of the scene's answers: what was seen may fit none of them.
    return prompted.draw("".join(fits) or question.letters)


@dataclass(frozen=True, kw_only=True)
class Responder:
    """Something without a model that answers questions, and what it declares of itself.

    Attributes:
        answer: Returns the letter of the chosen option.
        reads_history: Whether its answers depend on the history, its memory and its retrieval step.
        needs_scene: Whether it must know all answers that the scene allows.
    """

    answer: Callable[[Prompted], str]
    reads_history: bool
    needs_scene: bool


WITHOUT_MODEL = {
    "recall": Responder(answer=recall, reads_history=True, needs_scene=True),
    "abstain": Responder(answer=abstain, reads_history=False, needs_scene=False),
    "guess": Responder(answer=guess, reads_history=False, needs_scene=False),
}
"""The responders without a model, by name: the ideal observer, one that never knows, chance."""


class ModelResponder:
    """A vision-language model; `images` is the maximum for a question, None without a limit."""

    def __init__(self, config: AskConfig):
        self._model = MODELS.make(config.model, config.model_options)
        self._control = config.control
        self.images = None if config.control == "text" else self._model.images
        self._prompt = QuestionPrompt.load(config.prompt)

    def answer(self, prompted: Prompted) -> tuple[str | None, str, Reply]:
        """Ask the model; return the letter that it names, if any, the prompt, and the reply."""
        views: dict[str, list[Any]] = {"<history>": [], "<picture>": []}
        if self._control != "text":
            try:
                views["<picture>"] = [decode_image(prompted.question.picture)]
            except FormatError as error:
                raise error.about(f"the question of {prompted.question.episode_id}") from None
            if len(prompted.history):
                frames = prompted.history.frames(range(len(prompted.history)))
                if self._control == "blank":
                    # Gray frames leave prompt and number of images as they are: only the content is
                    # gone.
                    frames = np.full_like(frames, 128)
                views["<history>"] = [Video(frames, prompted.query.dataset.fps)]
        messages = self._prompt.fill(prompted.query.goal, prompted.question, views)
        reply = self._model.reply(messages)
        letter = read_letter(reply.text, prompted.question.letters)
        return letter, as_text(messages[-1].parts), reply

    def metadata(self) -> dict[str, Any]:
        """Return the model's metadata, and the SHA-256 of the prompt."""
        return describe_prompted(self._model, self._prompt)

    def close(self) -> None:
        """Close the model."""
        self._model.close()


# --- prompts and answers -------------------------------------------------------------------------

_ONE = r"\b(?!\s*(?:[,/]|or\b|and\b)\s*[A-H]\b)"
"""After a letter: not the first of several."""

_LETTER = rf"([A-H]|[a-h](?![ '’]\w)){_ONE}"
"""The letter of an option, not an article."""

_ANSWER = re.compile(rf"(?i:\banswer\b\W*(?:(?:is|option|letter)\b\W*)*){_LETTER}")
_FIRST = re.compile(rf"^[^\w\n]*([A-H]){_ONE}(?=[*_`'\"]*(?:[.:,)\]]|\s+[-–—]|\s*$))", re.MULTILINE)
_OPTION = re.compile(rf"(?i:\b(?:option|letter)\b\W*(?:is\b\W*)?){_LETTER}")
_ALONE = re.compile(r"\b([B-H]|A(?!['’ ](?!or\b|and\b|is\b)[a-z]))\b")


@dataclass(frozen=True)
class QuestionPrompt(Prompt):
    """A prompt, as its TOML file has it.

    Attributes:
        system: The system message.
        question: The question, with `<history>`, `<picture>`, `{question}`, `{options}` and,
            optionally, `{goal}`.
    """

    packaged = ("choice",)

    system: str
    question: str

    def __post_init__(self) -> None:
        if not self.system.strip():
            raise ValueError("its system is empty")
        for place in ("<history>", "<picture>", "{question}", "{options}"):
            if place not in self.question:
                raise ValueError(f"its question lacks {place}")

    def fill(
        self, goal: str, question: Question, views: Mapping[str, Sequence[Part]]
    ) -> list[Message]:
        """Return the conversation, with the images of `<history>` and `<picture>`."""
        options = "\n".join(question.lines)
        words = {"{goal}": goal, "{question}": question.text, "{options}": options}
        text = fill(self.question, words, views)
        return [Message("system", (self.system,)), Message("user", text)]


def read_letter(text: str, letters: str) -> str | None:
    """Return the option that an answer names, or None, given the letters of all options.

    That is the first of these: the only letter of the answer; the last letter after the word
    answer; the letter at the beginning of a line, as in "B. Because …"; the letter after the words
    option or letter; a single capital letter. If several letters match, or one that is no option,
    the answer names none. Text before `</think>` is ignored.
    """
    answer = text.rpartition("</think>")[2]
    bare = re.sub(r"[^A-Za-z]", "", answer)
    # From the clearest form to the least clear: the first that matches decides.
    ways = [[bare] if len(bare) == 1 else [], _ANSWER.findall(answer)[-1:]]
    ways += [pattern.findall(answer) for pattern in (_FIRST, _OPTION, _ALONE)]
    named = {letter.upper() for letter in next(filter(None, ways), ())}
    return named.pop() if len(named) == 1 and named <= {*letters} else None
