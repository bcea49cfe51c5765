"""Responders to questions: the ideal observer, chance, or a model."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from robomme_interference_data.data.query import Query
from robomme_interference_data.data.questions import Question
from robomme_interference_data.errors import FormatError
from robomme_interference_data.evaluate.run.config import AskConfig
from robomme_interference_data.simulators.registry import recorded_scene
from robomme_interference_data.storage.encode import decode_image

from .images import HistoryFrames
from .models import MODELS, Reply, Video
from .prompt_files import as_text
from .question_prompt import QuestionPrompt, read_letter

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
        lot = hashlib.sha256(f"{self.query.episode_id}/{self.seed}".encode()).digest()
        return letters[int.from_bytes(lot) % len(letters)]


def guess(prompted: Prompted) -> str:
    """Draw one of all options."""
    return prompted.draw(prompted.question.letters)


def recall(prompted: Prompted) -> str:
    """Draw one of the options that agree with what the kept frames show; of all if none does."""
    question, scene = prompted.question, recorded_scene(prompted.query)
    if scene is None or max(question.answers) >= len(scene.answers):
        raise FormatError(
            f"the options of {question.episode_id} are not answers that its scene allows",
            "recall needs a simulator whose possible answers are known, such as tabletop.",
        )
    agreeing = {scene.choice(answer) for answer in scene.agreeing(prompted.known or {})}
    choices = [scene.choice(scene.answers[number]) for number in question.answers]
    fits = [
        letter
        for letter, choice in zip(question.letters, choices, strict=True)
        if choice in agreeing
    ]
    return prompted.draw("".join(fits) or question.letters)


WITHOUT_MODEL = {"recall": recall, "guess": guess}
"""The responders without a model."""


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
                    frames = np.full_like(frames, 128)
                views["<history>"] = [Video(frames, prompted.query.dataset.fps)]
        messages = self._prompt.fill(prompted.query.goal, prompted.question, views)
        reply = self._model.reply(messages)
        letter = read_letter(reply.text, prompted.question.letters)
        return letter, as_text(messages[-1].parts), reply

    def metadata(self) -> dict[str, Any]:
        """Return the model's metadata, and the SHA-256 of the prompt."""
        return {"model": self._model.metadata(), "prompt_sha256": self._prompt.sha256}

    def close(self) -> None:
        """Close the model."""
        self._model.close()
