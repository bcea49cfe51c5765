"""Prompts for questions, and how answers are parsed; prompts are files."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from robomme_interference_data.data.questions import Question

from .models import Message, Part
from .prompt_files import Prompt, fill

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
    ways = [[bare] if len(bare) == 1 else [], _ANSWER.findall(answer)[-1:]]
    ways += [pattern.findall(answer) for pattern in (_FIRST, _OPTION, _ALONE)]
    named = {letter.upper() for letter in next(filter(None, ways), ())}
    return named.pop() if len(named) == 1 and named <= {*letters} else None
