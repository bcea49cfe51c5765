"""How a question is put to a model, and how its answer is read: pure; prompts are files."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from robomme_interference_data.data.questions import Question
from robomme_interference_data.evaluate.models.model import Message, Part
from robomme_interference_data.evaluate.models.prompts import fill, read_prompt

PROMPTS = ("choice",)
"""The prompt that comes with the package."""

_ONE = r"\b(?!\s*(?:[,/]|or\b|and\b)\s*[A-H]\b)"
"""After a letter: it is not the first of several."""

_LETTER = rf"([A-H]|[a-h](?![ '’]\w)){_ONE}"
"""An option's letter, and no article."""

_ANSWER = re.compile(rf"(?i:\banswer\b\W*(?:(?:is|option|letter)\b\W*)*){_LETTER}")
_FIRST = re.compile(rf"^[^\w\n]*([A-H]){_ONE}(?=[*_`'\"]*(?:[.:,)\]]|\s+[-–—]|\s*$))", re.MULTILINE)
_OPTION = re.compile(rf"(?i:\b(?:option|letter)\b\W*(?:is\b\W*)?){_LETTER}")
_ALONE = re.compile(r"\b([B-H]|A(?!['’ ](?!or\b|and\b|is\b)[a-z]))\b")


@dataclass(frozen=True)
class QuestionPrompt:
    """A prompt, as its TOML file has it.

    Attributes:
        system: What the model is told first.
        question: What it is asked; holds `<history>`, `<picture>`, `{question}` and `{options}`,
            and `{goal}` if it is to be told.
    """

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

    That is, whatever stands around it: the letter that is all of the answer; else the last one
    after the word answer; else the one with which a line begins, as in "B. Because …"; else the one
    after the words option or letter; else the one that stands alone, in capitals. Where one of
    these finds several letters, or one of no option, none was named. What a model wrote while it
    thought, before `</think>`, is left aside.
    """
    said = text.rpartition("</think>")[2]
    bare = re.sub(r"[^A-Za-z]", "", said)
    ways = [[bare] if len(bare) == 1 else [], _ANSWER.findall(said)[-1:]]
    ways += [pattern.findall(said) for pattern in (_FIRST, _OPTION, _ALONE)]
    named = {letter.upper() for letter in next(filter(None, ways), ())}
    return named.pop() if len(named) == 1 and named <= {*letters} else None


def load_prompt(name: str) -> tuple[QuestionPrompt, str]:
    """Read a prompt: `choice`, or a TOML file by its path; and the SHA-256 of its file."""
    return read_prompt(QuestionPrompt, __package__, PROMPTS, name, "docs/questions.md")
