"""Prompts for subgoals, and how answers are parsed; prompts are files."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.schema.subgoal import Pixel, Subgoal, read_points, write_points

from .models import Part
from .prompt_files import Prompt, check_places, fill

DEFAULT_PROMPT = "grounded"

VIEWS = ("<history>", "<keyframes>", "<recent>", "<image>")
"""Placeholders of images: the history, the selected key frames, the last live frames (`MemER`), and
the current view."""

_MAX_LETTERS = 300

_SPECIAL = re.compile(r"<\|\w+\|>")
"""Special tokens of a model, such as `<|box_start|>`: most servers remove them from answers."""


@dataclass(frozen=True)
class NextSubgoal:
    """What a model answers: the subgoal, and the numbers of the recent frames to keep, from 0."""

    subgoal: Subgoal
    keyframes: tuple[int, ...] = ()


@dataclass(frozen=True)
class SubgoalPrompt(Prompt):
    """A prompt, as its TOML file has it.

    Attributes:
        system: The system message.
        first: The first question; may contain `VIEWS` and `{goal}`.
        then: Later questions; may also contain `{subgoals}`, the earlier ones, numbered.
        answer: `text` or `json`.
        subgoal_key: Key of the subgoal in a JSON answer.
        keyframes_key: Key of the numbers of frames to keep, from 1, in a JSON answer.
        point: Format of a point, with `{y}` and `{x}`.
        box: Format of a box, with `{y0}`, `{x0}`, `{y1}` and `{x1}`; its center counts.
        grid: Maximum of `{y}` and `{x}` over the whole image; 0 if they are pixels.
        history: What `<history>` becomes; contains `<history>` once, for the video.
        no_history: What it becomes without a history.
        separator: Text between the images of a placeholder.
        no_images: What another placeholder of images becomes without any.
    """

    packaged = ("simple", "grounded", "memer")  # as those of SimpleSG, GroundSG and MemER

    system: str
    first: str
    then: str
    answer: str = "text"
    subgoal_key: str = "subgoal"
    keyframes_key: str = "keyframes"
    point: str = "<{y}, {x}>"
    box: str = ""
    grid: int = 1000
    history: str = "<history>"
    no_history: str = "none"
    separator: str = ""
    no_images: str = "none"

    def __post_init__(self) -> None:
        for name in ("system", "first", "then", "point"):
            if not getattr(self, name).strip():
                raise InvalidOptionError(f"{name} is empty", "Expected text.")
        for name in ("first", "then", "history", "no_history"):
            check_places(name, getattr(self, name), (*VIEWS, "{goal}", "{subgoals}"))
        if self.history.count("<history>") != 1:
            raise InvalidOptionError.expected("history", self.history, "<history> once")
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
        """Whether it shows the last live frames, of which the model may keep some."""
        return any("<recent>" in text for text in (self.first, self.then))

    def fill(
        self,
        goal: str,
        earlier: Sequence[Subgoal],
        size: tuple[int, int],
        views: Mapping[str, Sequence[Part]],
    ) -> tuple[Part, ...]:
        """Return the question, text and images in order, for images of `size`, (H, W) px."""
        numbered = [f"{n}. {self.write(subgoal, size)}" for n, subgoal in enumerate(earlier, 1)]
        words = {"{goal}": goal, "{subgoals}": "; ".join(numbered)}
        text = self.then if earlier else self.first
        return fill(
            text.replace("<history>", self.history if views.get("<history>") else self.no_history),
            words,
            {place: views.get(place, ()) for place in VIEWS},
            separator=self.separator,
            no_images=self.no_images,
        )

    def write(self, subgoal: Subgoal, size: tuple[int, int]) -> str:
        """Return a subgoal with its points as the model writes them."""
        points = []
        for pixel in subgoal.points:
            y, x = (_to_grid(at, side, self.grid) for at, side in zip(pixel, size, strict=True))
            points.append(self.point.replace("{y}", str(y)).replace("{x}", str(x)))
        return write_points(subgoal.text, points)

    def read(self, text: str, size: tuple[int, int], shown: int = 0) -> NextSubgoal:
        """Parse an answer about an image of `size`, (H, W) px, and `shown` recent frames."""
        keyframes: tuple[int, ...] = ()
        if self.answer == "json":
            fields = _json_object(text)
            text = fields.get(self.subgoal_key)  # type: ignore[assignment]
            if not isinstance(text, str):
                raise InvalidOptionError.expected(f"its {self.subgoal_key}", text, "text")
            keyframes = _places(fields.get(self.keyframes_key) or [], shown)
        # Models quote or emphasize what they were asked for.
        lines = [line.strip().strip("\"'`*").strip() for line in text.strip().splitlines()]
        words = _SPECIAL.sub("", next(filter(None, lines), ""))
        if not 0 < len(words) <= _MAX_LETTERS:
            raise InvalidOptionError.expected(
                "the answer", words[:60], f"a subgoal of up to {_MAX_LETTERS} letters in one line"
            )
        plain, numbers = read_points(words, self._pattern)
        return NextSubgoal(
            Subgoal(plain, tuple(self._pixel(point, size) for point in numbers)), keyframes
        )

    @cached_property
    def _pattern(self) -> re.Pattern[str]:
        """Pattern of a box or a point, with any spaces."""
        forms = []
        for name, form in (("b", self.box), ("p", self.point)):
            parts = re.split(r"(\{\w+\})|\s+", _SPECIAL.sub("", form))
            words = [re.escape(word) for word in parts if word]
            text = r"\s*".join(words)
            if text:
                forms.append(re.sub(r"\\\{(\w+)\\\}", rf"(?P<{name}_\1>\\d{{1,5}})", text))
        return re.compile("|".join(forms))

    def _pixel(self, numbers: Mapping[str, int], size: tuple[int, int]) -> Pixel:
        pixel = []
        for axis, side in zip("yx", size, strict=True):
            # Groups of the pattern are `p_y`, `b_y0`, `b_y1`, …: a box has two numbers on an axis.
            values = [value for name, value in numbers.items() if name[2:].startswith(axis)]
            top = self.grid or side - 1
            if max(values) > top:
                raise InvalidOptionError.expected(
                    "a point of the answer", dict(numbers), f"numbers from 0 to {top}"
                )
            pixels = [_to_pixel(value, side, self.grid) for value in values]
            pixel.append(sum(pixels) // len(pixels))
        return pixel[0], pixel[1]


def _to_pixel(value: int, side: int, grid: int) -> int:
    """Return a pixel as RoboMME's client does: the end of the grid is one beyond the last pixel."""
    return value * side // grid if grid else value


def _to_grid(pixel: int, side: int, grid: int) -> int:
    """Return a number on the grid as ms-swift does: nearest, and half to even."""
    return round(pixel / side * grid) if grid else pixel


def _json_object(text: str) -> dict[str, Any]:
    """Return the JSON object in an answer, with any text around it."""
    # Models put it into a code block, or between sentences.
    start, stop = text.find("{"), text.rfind("}")
    try:
        value = json.loads(text[start : stop + 1])
    except (ValueError, RecursionError):
        value = None
    if not isinstance(value, dict):
        raise InvalidOptionError.expected("the answer", text[:60], "a JSON object")
    return value


def _places(numbers: Any, shown: int) -> tuple[int, ...]:
    """Return numbers of frames, from 0, of an answer, which counts them from 1."""
    if not isinstance(numbers, list) or any(
        type(number) is not int or not 1 <= number <= shown for number in numbers
    ):
        raise InvalidOptionError.expected(
            "its frames to keep", numbers, f"numbers from 1 to {shown}, the recent frames shown"
        )
    return tuple(number - 1 for number in numbers)


def merge_near(frames: Sequence[int], distance: int) -> list[int]:
    """Return the median of each group of frames, of an even number the upper one, ascending.

    A frame at most `distance` after another is in the same group, as in the released MemER client.
    """
    groups: list[list[int]] = []
    for frame in sorted(set(frames)):
        if groups and frame - groups[-1][-1] <= distance:
            groups[-1].append(frame)
        else:
            groups.append([frame])
    return [group[len(group) // 2] for group in groups]
