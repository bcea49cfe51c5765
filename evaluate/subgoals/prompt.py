"""How a model is asked for subgoals, and how its answers are read; prompts are files."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.evaluate.models.model import Part
from robomme_interference_data.evaluate.models.prompts import check_places, fill, read_prompt
from robomme_interference_data.schema.subgoal import Pixel, Subgoal, read_points, write_points

PROMPTS = ("simple", "grounded", "memer")
"""The prompts that come with the package: for SimpleSG, GroundSG and MemER."""

VIEWS = ("<history>", "<keyframes>", "<recent>", "<image>")
"""Where images stand in a prompt: the history, key frames that were kept, the last live frames
(`MemER`), and what is seen now. A list without an image is the word `none`."""

_MOST_LETTERS = 300

_SPECIAL = re.compile(r"<\|\w+\|>")
"""Special tokens of a model, such as `<|box_start|>`: servers mostly leave them out of answers."""


@dataclass(frozen=True)
class Answer:
    """What an answer says."""

    subgoal: Subgoal
    keyframes: tuple[int, ...] = ()


@dataclass(frozen=True)
class Prompt:
    """A prompt, as its TOML file has it.

    Attributes:
        system: What the model is told first.
        first: What it is asked at first; may hold `VIEWS`, and `{goal}`.
        then: What it is asked later; also `{subgoals}`, the earlier ones, numbered.
        answer: `text`, or `json`.
        subgoal_key: Of a JSON answer: the key of the subgoal.
        keyframes_key: Of a JSON answer: the key of the numbers of frames to keep, from 1.
        point: How a point is written, with `{y}` and `{x}`.
        box: How a box is written, with `{y0}`, `{x0}`, `{y1}` and `{x1}`; its middle counts.
        grid: What `{y}` and `{x}` go up to over the whole image; 0 if they are pixels.
    """

    system: str
    first: str
    then: str
    answer: str = "text"
    subgoal_key: str = "subgoal"
    keyframes_key: str = "keyframes"
    point: str = "<{y}, {x}>"
    box: str = ""
    grid: int = 1000

    def __post_init__(self) -> None:
        for name in ("system", "first", "then", "point"):
            if not getattr(self, name).strip():
                raise InvalidOptionError(f"{name} is empty", "Expected text.")
        for name in ("first", "then"):
            check_places(name, getattr(self, name), (*VIEWS, "{goal}", "{subgoals}"))
        if self.answer not in ("text", "json"):
            raise InvalidOptionError.one_of("answer", self.answer, ("text", "json"))
        if not 0 <= self.grid <= 10_000:
            raise InvalidOptionError.expected("grid", self.grid, "0, for pixels, to 10000")
        for name, parts in (("point", ("y", "x")), ("box", ("y0", "x0", "y1", "x1"))):
            text = getattr(self, name)
            if text and any(text.count(f"{{{part}}}") != 1 for part in parts):
                needed = " and ".join(f"{{{part}}}" for part in parts)
                raise InvalidOptionError.expected(name, text, f"{needed}, each once")

    @property
    def watches(self) -> bool:
        """Whether it shows the last live frames: then the model may keep some of them."""
        return any("<recent>" in text for text in (self.first, self.then))

    def fill(
        self,
        goal: str,
        earlier: Sequence[Subgoal],
        size: tuple[int, int],
        views: Mapping[str, Sequence[Part]],
    ) -> tuple[Part, ...]:
        """Return what the model is asked, words and images in order.

        Args:
            goal: The goal in words.
            earlier: Subgoals before this one; without any, `first` is asked.
            size: Height and width of the front image in pixels.
            views: Images for each of `VIEWS`.
        """
        told = [f"{n}. {self.write(subgoal, size)}" for n, subgoal in enumerate(earlier, 1)]
        words = {"{goal}": goal, "{subgoals}": "; ".join(told)}
        return fill(
            self.then if earlier else self.first,
            words,
            {place: views.get(place, ()) for place in VIEWS},
        )

    def write(self, subgoal: Subgoal, size: tuple[int, int]) -> str:
        """Return a subgoal with its points as the model writes them."""
        points = []
        for pixel in subgoal.points:
            y, x = (_to_grid(at, side, self.grid) for at, side in zip(pixel, size, strict=True))
            points.append(self.point.replace("{y}", str(y)).replace("{x}", str(x)))
        return write_points(subgoal.text, points)

    def read(self, text: str, size: tuple[int, int], shown: int = 0) -> Answer:
        """Read an answer.

        Args:
            text: What the model wrote.
            size: Height and width of the front image in pixels.
            shown: How many recent frames it was shown.
        """
        keyframes: tuple[int, ...] = ()
        if self.answer == "json":
            said = _json_object(text)
            text = said.get(self.subgoal_key)  # type: ignore[assignment]
            if not isinstance(text, str):
                raise InvalidOptionError.expected(f"its {self.subgoal_key}", text, "text")
            keyframes = _places(said.get(self.keyframes_key) or [], shown)
        lines = [line.strip().strip("\"'`*").strip() for line in text.strip().splitlines()]
        words = _SPECIAL.sub("", next(filter(None, lines), ""))
        if not 0 < len(words) <= _MOST_LETTERS:
            raise InvalidOptionError.expected(
                "the answer", words[:60], f"a subgoal of up to {_MOST_LETTERS} letters in a line"
            )
        found, numbers = read_points(words, self._pattern)
        return Answer(Subgoal(found, tuple(self._pixel(one, size) for one in numbers)), keyframes)

    @cached_property
    def _pattern(self) -> re.Pattern[str]:
        """What a box or a point looks like; blanks may stand anywhere in it."""
        forms = []
        for name, form in (("b", self.box), ("p", self.point)):
            parts = re.split(r"(\{\w+\})|\s+", _SPECIAL.sub("", form))
            words = [re.escape(word) for word in parts if word]
            text = r"\s*".join(words)
            forms += [re.sub(r"\\\{(\w+)\\\}", rf"(?P<{name}_\1>\\d{{1,5}})", text)] * bool(text)
        return re.compile("|".join(forms))

    def _pixel(self, numbers: Mapping[str, int], size: tuple[int, int]) -> Pixel:
        pixel = []
        for axis, side in zip("yx", size, strict=True):
            given = [value for name, value in numbers.items() if name[2:].startswith(axis)]
            top = self.grid or side - 1
            if max(given) > top:
                raise InvalidOptionError.expected(
                    "a point of the answer", dict(numbers), f"numbers from 0 to {top}"
                )
            pixels = [_to_pixel(value, side, self.grid) for value in given]
            pixel.append(sum(pixels) // len(pixels))
        return pixel[0], pixel[1]


def _to_pixel(value: int, side: int, grid: int) -> int:
    return min(value * side // grid, side - 1) if grid else value


def _to_grid(pixel: int, side: int, grid: int) -> int:
    """Return the smallest number on the grid that stands for a pixel."""
    return -(-pixel * grid // side) if grid else pixel


def _json_object(text: str) -> dict[str, Any]:
    """Return the JSON object in an answer, whatever stands around it."""
    start, stop = text.find("{"), text.rfind("}")
    try:
        said = json.loads(text[start : stop + 1])
    except (ValueError, RecursionError):
        said = None
    if not isinstance(said, dict):
        raise InvalidOptionError.expected("the answer", text[:60], "a JSON object")
    return said


def _places(given: Any, shown: int) -> tuple[int, ...]:
    """Return numbers of frames, which answers count from 1, counted from 0."""
    sound = isinstance(given, list) and all(
        type(number) is int and 1 <= number <= shown for number in given
    )
    if not sound:
        raise InvalidOptionError.expected(
            "its frames to keep", given, f"numbers from 1 to {shown}, the recent frames shown"
        )
    return tuple(number - 1 for number in given)


def merge_near(frames: Sequence[int], distance: int) -> list[int]:
    """Return the median of each group of frames, of an even number the upper one, ascending.

    A frame belongs to the group of the one before it if it is at most `distance` after it (the
    rule of the released MemER client).
    """
    groups: list[list[int]] = []
    for frame in sorted(set(frames)):
        if groups and frame - groups[-1][-1] <= distance:
            groups[-1].append(frame)
        else:
            groups.append([frame])
    return [group[len(group) // 2] for group in groups]


def load_prompt(name: str) -> tuple[Prompt, str]:
    """Read a prompt: one of `PROMPTS`, or a TOML file by its path."""
    return read_prompt(Prompt, __package__, PROMPTS, name, "docs/subgoals.md")
