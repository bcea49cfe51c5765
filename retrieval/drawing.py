"""Draw why a part of a history was chosen."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.data.buffer import Buffer
from robomme_interference_data.viz.figure import GREY, INK, Page, ink_on, open_page, tidy, tint
from robomme_interference_data.viz.filmstrip import LESSON_COLOR, mark_evidence, session_colors

from .explain import Explanation, frames_text
from .segment import Span
from .select import MIN_FRAMES, Choice, Similarities

# Inches.
_WIDTH, _HEIGHT = 7.2, 6.1
_LEFT, _RIGHT = 0.55, 7.1  # of what shares the axis of frames
_SPAN = _RIGHT - _LEFT
_SHOWN = 14  # pictures in the strip
_BAR = 0.19
_CURVE = 1.05
_LARGE = 1.15  # the pictures that are compared

_CHOSEN = "#6A1B9A"  # no session has it
_CURVE_INK = "#555555"
_SEGMENT = "#d9d9d9"


def draw_retrieval(
    buffer: Buffer,
    measured: Similarities,
    choice: Choice,
    found: Explanation,
    live: NDArray[np.uint8],
    out: Path,
) -> None:
    """Draw a choice: film strip, true sessions, cuts, segments, and cosines with the query.

    The same choice gives the same bytes with the same version of matplotlib.

    Args:
        buffer: The buffer.
        measured: Its cosines.
        choice: What was chosen of it.
        found: Why.
        live: What the robot sees first, `(H, W, 3) uint8` RGB.
        out: File to write, `.png` or `.svg`.
    """
    with open_page(out, _WIDTH) as page:
        page.height = _HEIGHT
        page.figure.set_size_inches(_WIDTH, _HEIGHT)
        picture = _Picture(page, buffer, measured, choice, found)
        picture.head()
        top = picture.strip(0.64)
        top = picture.true_sessions(top + 0.05)
        picture.adjacent(picture.axes(top + 0.14))
        top = picture.segments(top + 0.14 + _CURVE + 0.07)
        picture.alike(picture.axes(top + 0.14))
        top += 0.14 + _CURVE + 0.36
        page.text((_LEFT + _RIGHT) / 2, top - 0.19, "frame in the buffer", 6.5, color=GREY)
        picture.compared(live, top)


@dataclass
class _Picture:
    """What is drawn, and where; methods draw a part from `top` on and return where it ends."""

    page: Page
    buffer: Buffer
    measured: Similarities
    choice: Choice
    found: Explanation

    def __post_init__(self) -> None:
        self.colors = session_colors(self.buffer.sessions)
        self.session = self.buffer.session_index

    def head(self) -> None:
        page, grade = self.page, self.found.grade
        title = f"{grade.episode_id}   {grade.condition}"
        page.text(0.1, 0.06, title, 10, align="left", bold=True, width=0.55 * _WIDTH)
        how = f"{self.found.encoder}, {self.found.camera} camera, rule {grade.rule}"
        page.text(_RIGHT, 0.1, how, 6.5, align="right", color=GREY, width=0.4 * _WIDTH)
        goal = f"Goal: {self.buffer.goal}"
        page.text(0.1, 0.27, goal, 7.5, align="left", width=_WIDTH - 0.2)
        frames = f"frames {frames_text(self.choice.spans)} of {grade.history_frames}"
        result = f"chosen: {frames};  {self.found.graded()}"
        page.text(0.1, 0.43, result, 7.5, align="left", bold=True, color=_CHOSEN)

    def strip(self, top: float) -> float:
        """Draw pictures in the places of their frames on the axis; those chosen are marked."""
        page, pitch = self.page, _SPAN / _SHOWN
        size = pitch - 0.05
        chosen = {*self.choice.frames.tolist()}
        for place in range(_SHOWN):
            frame = (2 * place + 1) * len(self.buffer) // (2 * _SHOWN)
            x = _LEFT + place * pitch + 0.025
            color = self.colors[self.session[frame]]
            tall = page.picture(self.buffer.frame(frame, self.found.camera), x, top, size)
            page.box(x, top + tall + 0.012, size, 0.035, fill=color, edge=color, line=0)
            if frame in chosen:
                page.box(x, top, size, tall, fill="none", edge=_CHOSEN, line=2)
            page.text(x + size / 2, top + tall + 0.055, str(frame), 5.5, color=GREY)
        return top + tall + 0.2

    def true_sessions(self, top: float) -> float:
        page = self.page
        self._label(top, "true", "sessions")
        for number, (session, color) in enumerate(
            zip(self.buffer.sessions, self.colors, strict=True)
        ):
            x, width = self._bar((session.start, session.stop), top, color, "white")
            lesson = session.role == "lesson"
            names = [f"LESSON {session.family}", "LESSON"] if lesson else [session.family]
            room = width - 0.04
            # Text may shrink by a quarter.
            fitting = (
                n for n in [*names, f"{number}"] if page.text_width(n, 4.2, bold=True) < room
            )
            if name := next(fitting, None):
                ink = ink_on(color)
                page.text(x + width / 2, top + 0.045, name, 5.5, width=room, bold=True, color=ink)
        mark_evidence(page, self.buffer, _LEFT, _SPAN / len(self.buffer), top + _BAR)
        return top + _BAR

    def segments(self, top: float) -> float:
        """Draw the segments; what was chosen stands out, those too short are hollow."""
        self._label(top, "found", "segments")
        for start, stop in self.choice.segments:
            short = stop - start < MIN_FRAMES
            fill, edge = ("white", GREY) if short else (_SEGMENT, "white")
            self._bar((start, stop), top, fill, edge)
        for span in self.choice.spans:  # of the oracle it is no segment
            x, width = self._bar(span, top, _CHOSEN, "white")
            if self.page.text_width("chosen", 6, bold=True) < width:
                self.page.text(x + width / 2, top + 0.05, "chosen", 6, bold=True, color="white")
        return top + _BAR

    def axes(self, top: float) -> Any:
        """Add axes of frames, with the lesson in the background."""
        place = (_LEFT / _WIDTH, 1 - (top + _CURVE) / _HEIGHT, _SPAN / _WIDTH, _CURVE / _HEIGHT)
        axes = self.page.figure.add_axes(place)
        for span in self.measured.lesson:
            axes.axvspan(*span, color=tint(LESSON_COLOR, 0.13), linewidth=0, zorder=0)
        axes.set_xlim(0, len(self.buffer))
        tidy(axes)
        axes.tick_params(labelsize=6, length=2)
        return axes

    def adjacent(self, axes: Any) -> None:
        """Draw the cosine of each frame with the next, the threshold, and the cuts."""
        values, threshold = self.measured.adjacent, self.choice.threshold
        places = np.arange(1, len(values) + 1)  # a cut lies before this frame
        axes.plot(places, values, color=_CURVE_INK, linewidth=0.9)
        label = f"threshold {threshold:.3f}"
        axes.axhline(threshold, color="black", linewidth=0.9, linestyle="--", label=label)
        cut = values < threshold
        marks = {"color": "black", "markersize": 4, "ls": "", "label": f"{int(cut.sum())} cuts"}
        axes.plot(places[cut], values[cut], "v", **marks)
        axes.tick_params(labelbottom=False)
        shaded = "cosine of each frame with the next; shaded: the true lesson"
        line = "; dark line above: shows the answer" if self.buffer.evidence else ""
        _name(axes, shaded + line)

    def alike(self, axes: Any) -> None:
        """Draw the cosine of each frame with what the robot sees, and each segment's score."""
        values, found = self.measured.alike, self.found
        axes.plot(np.arange(len(values)) + 0.5, values, color=_CURVE_INK, linewidth=0.9)
        for span in self.choice.spans:
            axes.axvspan(*span, facecolor="none", edgecolor=_CHOSEN, linewidth=1.2, zorder=3)
        for segment, score in self.choice.scores.items():
            color = _CHOSEN if segment[0] in self.choice.frames else GREY
            axes.plot(segment, (score, score), color=color, linewidth=1.2)
        for name, frame, cosine, color, marker, size in (
            ("closest frame", found.closest, found.cosine, _CHOSEN, "*", 9),
            ("closest outside", found.other, found.other_cosine, GREY, "o", 4.5),
        ):
            if frame is not None:
                mark = {"color": color, "markersize": size, "label": f"{name}, {frame}"}
                axes.plot(frame + 0.5, cosine, marker, zorder=4, **mark)
        _name(
            axes, "cosine of each frame with what the robot sees now; bars: score of each segment"
        )

    def compared(self, live: NDArray[np.uint8], top: float) -> None:
        """Draw what the robot sees beside the closest frames, inside the choice and outside."""
        page, found = self.page, self.found
        shown = [("what the robot sees now", live, "black", "the first live observation", "")]
        for title, frame, cosine in (
            ("closest frame that was chosen", found.closest, found.cosine),
            ("closest frame outside", found.other, found.other_cosine),
        ):
            if frame is not None:
                image = self.buffer.frame(frame, found.camera)
                number = int(self.session[frame])
                one = self.buffer.sessions[number]
                below = f"frame {frame}, cosine {cosine:.3f}", f"{one.role} {one.source}"
                shown.append((title, image, self.colors[number], *below))
        step = _SPAN / 3
        for place, (title, image, color, *lines) in enumerate(shown):
            x = _LEFT + place * step + (step - _LARGE) / 2
            page.text(x + _LARGE / 2, top, title, 6.5, bold=True, width=step - 0.05)
            tall = page.picture(image, x, top + 0.14, _LARGE)
            page.box(x, top + 0.14, _LARGE, tall, fill="none", edge=color, line=2)
            for line, text in enumerate(lines):
                y = top + 0.18 + tall + 0.11 * line
                page.text(x + _LARGE / 2, y, text, 6, width=step - 0.05, color=GREY)

    def _label(self, top: float, first: str, second: str) -> None:
        self.page.text(_LEFT - 0.05, top, first, 6, align="right", color=GREY)
        self.page.text(_LEFT - 0.05, top + 0.09, second, 6, align="right", color=GREY)

    def _bar(self, span: Span, top: float, fill: str, edge: str) -> tuple[float, float]:
        """Draw a span of frames to scale; return its left edge and its width."""
        scale = _SPAN / len(self.buffer)
        x, width = _LEFT + span[0] * scale, (span[1] - span[0]) * scale
        self.page.box(x, top, width, _BAR, fill=fill, edge=edge, line=0.6)
        return x, width


def _name(axes: Any, title: str) -> None:
    axes.set_title(title, loc="left", size=6.5, color=INK, pad=2)
    place = {"loc": "lower right", "bbox_to_anchor": (1.005, 0.985), "ncols": 2}
    look = {"frameon": False, "fontsize": 6, "borderpad": 0, "borderaxespad": 0}
    legend = axes.legend(**place, **look, handlelength=1.6, columnspacing=1.2)
    legend.set_in_layout(False)
