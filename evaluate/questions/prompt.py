"""How a question is put to a model, and how its answer is read: pure; prompts are files."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from robomme_interference_data.evaluate.models.model import Message, Part
from robomme_interference_data.evaluate.models.prompts import fill, read_prompt
from robomme_interference_data.questions import Question

PROMPTS = ("choice",)
"""The prompt that comes with the package."""

_SAID = re.compile(r"\b(?:answer|option|letter)\b\W*(?:is\b\W*)?([A-Z])\b", re.IGNORECASE)


@dataclass(frozen=True)
class QuestionPrompt:
    """A prompt, as its TOML file has it.

    Attributes:
        system: What the model is told first.
        question: What it is asked; holds `<history>`, `<picture>`, `{goal}`, `{question}` and
            `{options}`.
    """

    system: str
    question: str

    def __post_init__(self) -> None:
        for place in ("<history>", "<picture>", "{question}", "{options}"):
            if place not in self.question:
                raise ValueError(f"its question lacks {place}")

    def fill(
        self, goal: str, question: Question, views: Mapping[str, Sequence[Part]]
    ) -> list[Message]:
        """Return the conversation that a model is to answer.

        Args:
            goal: The goal in words.
            question: The question.
            views: Images for `<history>` and `<picture>`.
        """
        options = "\n".join(question.lines)
        words = {"{goal}": goal, "{question}": question.text, "{options}": options}
        asked = fill(self.question, words, views)
        return [Message("system", (self.system,)), Message("user", asked)]


def read_letter(text: str, letters: str) -> str | None:
    """Return the option that an answer names, or None.

    That is the answer itself, if it is a letter alone, whatever stands around it; else the last
    letter after the word answer, option or letter; else the only option's letter that stands
    alone, in capitals, in a text without another.

    Args:
        text: What the model wrote.
        letters: Letters of the options, such as `ABCD`.
    """
    bare = re.sub(r"[^A-Za-z]", "", text)
    said = [letter.upper() for letter in _SAID.findall(text)]
    alone = set(re.findall(rf"\b([{letters}])\b(?!['’ ][a-z])", text))
    for found in ([bare.upper()] if len(bare) == 1 else [], said[-1:], [*alone][:2]):
        if len(found) == 1:
            return found[0] if found[0] in letters else None
    return None


def load_prompt(name: str) -> tuple[QuestionPrompt, str]:
    """Read a prompt: `choice`, or a TOML file by its path; and the SHA-256 of its file.

    Raises:
        UnknownNameError: There is no such prompt, nor such a file.
        FormatError: The file is no prompt; says why.
    """
    return read_prompt(QuestionPrompt, __package__, PROMPTS, name, "docs/questions.md")
