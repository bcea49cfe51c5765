"""The published systems' prompts and options; prompts are read from the released client's code.

The texts of these prompts are RoboMME's. This package has the digest of each prompt, and its form:
how points are written, what separates images, what an answer is.
"""

import ast
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robomme_interference_data.constants import POSITION_LIMIT
from robomme_interference_data.errors import FormatError, InvalidOptionError, named
from robomme_interference_data.storage.text import read_text

from .subgoal_prompt import SubgoalPrompt

CLIENT = "RoboMME/robomme_policy_learning@3507f80ddc47a6c6363d4af9a51afaa1a3992944"
"""The released client."""

FOLDER = "examples/robomme/subgoal_prediction/qwenvl"
"""Its folder with prompts."""

_PLACES = {
    "video_prefix": "<history>",
    "self.task_goal": "{goal}",
    "self._wrap_history_subgoals(self.history_simple_subgoals)": "{subgoals}",
    "self._wrap_history_subgoals(self.history_grounded_subgoals)": "{subgoals}",
    "self._wrap_images(key_frame_paths)": "[<keyframes>]",
    "self._wrap_images(self.current_execution_frame_paths)": "[<recent>]",
}
"""Expressions in its texts, and the placeholders that stand for them."""


@dataclass(frozen=True)
class Published:
    """How a published system questions its model.

    Attributes:
        file: File of the client that has its prompt.
        number: Which prompt of that file it is, from 0.
        sha256: `SubgoalPrompt.sha256`.
        form: Keys of its prompt that are not in the client's texts.
        options: Options of subgoals and model.
    """

    file: str
    number: int
    sha256: str
    form: Mapping[str, Any]
    options: Mapping[str, Any]

    def check(self, name: str, prompt: SubgoalPrompt, options: Mapping[str, Any]) -> None:
        """Raise an `InvalidOptionError` if a prompt, or one of all options, is another one."""
        page = "docs/how-to/official-simulator.md"
        own = f"Or set {named('system')} to a name of your own: see {page}."
        command = (
            f"evaluate BUFFER_SET --system {name} --policy websocket://HOST:PORT --out RUN "
            f"--subgoals openai:URL#MODEL --set subgoal_prompt=CLONE/{FOLDER}/{self.file}"
        )
        if prompt.sha256 != self.sha256:
            raise InvalidOptionError(
                f"{named('subgoal_prompt')} is not the prompt of {name}",
                f"Set it to the file of a clone of {CLIENT}. {own}",
                command,
            )
        for option, value in self.options.items():
            if options[option] != value:
                raise InvalidOptionError(
                    f"the option {option} of subgoals is {options[option]}; {name} has {value}",
                    f"Leave it out. {own}",
                    command,
                )


_FORM = {"no_history": "", "point": "<|box_start|>({y},{x})<|box_end|>"}
_MEMER = {
    "answer": "json",
    "subgoal_key": "current_subtask",
    "keyframes_key": "keyframe_positions",
    "separator": ", ",
    "no_images": "",
}
_OPTIONS = {
    "frames": POSITION_LIMIT,  # all
    "fps": 30.0,
    "video": "mp4",
    "max_tokens": 128,
    "temperature": 0.0,
}

PUBLISHED: Mapping[str, Published] = {
    "symbolic-simplesg": Published(
        file="api.py",
        number=0,
        sha256="c440b8a178cb83811dea9e0790e9b774fbf2fedcca8bfb40af2a16cdcf6a03c0",
        form=_FORM,
        options=_OPTIONS,
    ),
    "symbolic-groundsg": Published(
        file="api.py",
        number=1,
        sha256="7bc8c70a505c11db5344a36767955b85b54389c5e6618c0a0a491370002403cc",
        form=_FORM,
        options=_OPTIONS,
    ),
    "memer": Published(
        file="api_memer.py",
        number=0,
        sha256="27034c2257e44cd0b32519d1064f0ab8f23406306604af37e37dde71f7ec4b86",
        form=_FORM | _MEMER,
        options=_OPTIONS | {"recent": 8, "stride": 2, "near": 8},
    ),
}
"""The published systems with a model in front of the policy."""


def load_published(name: str, system: str | None) -> SubgoalPrompt:
    """Read a prompt, see `Prompt.load`; from a file of the client, that of a published system."""
    published = PUBLISHED.get(system or "")
    if published is None or not name.endswith(".py"):
        return SubgoalPrompt.load(name)
    try:
        return read_client(read_text(Path(name)), published)
    except (ValueError, SyntaxError, OSError) as error:
        raise FormatError(
            f"{name} is not {published.file} of the released client: {error}",
            f"Expected {FOLDER}/{published.file} in a clone of {CLIENT}.",
        ) from None


def read_client(code: str, published: Published) -> SubgoalPrompt:
    """Read the prompt of a system from the client's code, which is not run."""
    texts: dict[str, list[str]] = {"self.system_prompt": [], "user_prompt": [], "video_prefix": []}
    for name, value in _assignments(ast.parse(code)):
        if name in texts:
            texts[name].append(_text(value.body if isinstance(value, ast.IfExp) else value))
    systems, questions, videos = texts.values()
    # The code assigns each system prompt, then its questions: the first one, and a later one last.
    of_each = len(questions) // max(1, len(systems))
    first = published.number * of_each
    if not videos or not of_each or published.number >= len(systems):
        raise ValueError("it has no prompts")
    return SubgoalPrompt(
        system=systems[published.number],
        first=questions[first],
        then=questions[first + of_each - 1],
        history=videos[0].replace("<video>", "<history>"),
        **published.form,
    )


def _assignments(tree: ast.AST) -> Iterator[tuple[str, ast.expr]]:
    """Yield all assignments to one name, in their order in the text."""
    assignments = [node for node in ast.walk(tree) if isinstance(node, ast.Assign)]
    for node in sorted(assignments, key=lambda node: node.lineno):
        yield ast.unparse(node.targets[0]), node.value


def _text(value: ast.expr) -> str:
    """Return a text of the code, with placeholders for its expressions."""
    if isinstance(value, ast.Constant) and isinstance(value.value, str):
        return value.value
    if isinstance(value, ast.JoinedStr):
        return "".join(map(_text, value.values))
    place = isinstance(value, ast.FormattedValue) and _PLACES.get(ast.unparse(value.value))
    if not place:
        raise ValueError(f"line {value.lineno} has {ast.unparse(value)[:60]}")
    return place
