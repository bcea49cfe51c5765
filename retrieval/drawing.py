"""Draw why a part of a history was chosen."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.data.buffer import Buffer
from robomme_interference_data.viz.figure import GRAY, INK, Page, ink_on, open_page, tidy, tint
from robomme_interference_data.viz.filmstrip import LESSON_COLOR, mark_evidence, session_colors

from .explain import Explanation, frames_text
from .measure import Similarities
from .segment import FrameSpan
from .select import MIN_FRAMES, Choice

# Inches.
_WIDTH, _HEIGHT = 7.2, 6.1
_LEFT, _RIGHT = 0.55, 7.1  # of everything that shares the axis of frames
_SPAN = _RIGHT - _LEFT
_PICTURES = 14  # in the strip
_BAR, _CURVE, _LARGE = 0.19, 1.05, 1.15

_CHOSEN = "#6A1B9A"  # not the color of any session
_CURVE_INK = "#555555"


def draw_retrieval(
    buffer: Buffer,
    measured: Similarities,
    choice: Choice,
    explanation: Explanation,
    live: NDArray[np.uint8],
    out: Path,
) -> None:
    """Draw a choice: film strip, true sessions, segments, and cosines with the query.

    The same choice gives the same bytes with the same version of matplotlib.

    Args:
        buffer: The buffer.
        measured: Its similarities.
        choice: What was chosen.
        explanation: Why.
        live: The first live observation, `(H, W, 3) uint8` RGB.
        out: File to write, `.png` or `.svg`.
    """
    colors = session_colors(buffer.sessions)
    with open_page(out, _WIDTH) as page:
        page.height = _HEIGHT
        page.figure.set_size_inches(_WIDTH, _HEIGHT)
        _draw_head(page, buffer, choice, explanation)
        top = _draw_strip(page, buffer, choice, explanation.camera, 0.64)
        _draw_sessions(page, buffer, colors, top)
        top += _BAR
        _draw_adjacent(_axes(page, measured, top + 0.14), buffer, measured, choice)
        top += 0.14 + _CURVE + 0.07
        _draw_segments(page, buffer, choice, top)
        top += _BAR
        _draw_similarity(_axes(page, measured, top + 0.14), measured, choice, explanation)
        top += 0.14 + _CURVE + 0.36
        page.text((_LEFT + _RIGHT) / 2, top - 0.19, "frame in the buffer", 6.5, color=GRAY)
        _draw_compared(page, buffer, colors, explanation, live, top)


def _draw_head(page: Page, buffer: Buffer, choice: Choice, explanation: Explanation) -> None:
    grade = explanation.grade
    title = f"{grade.episode_id}   {grade.condition}"
    page.text(0.1, 0.06, title, 10, align="left", bold=True, width=0.55 * _WIDTH)
    settings = f"{explanation.encoder}, {explanation.camera} camera, rule {grade.rule}"
    page.text(_RIGHT, 0.1, settings, 6.5, align="right", color=GRAY, width=0.4 * _WIDTH)
    page.text(0.1, 0.27, f"Goal: {buffer.goal}", 7.5, align="left", width=_WIDTH - 0.2)
    frames = f"frames {frames_text(choice.spans)} of {grade.history_frames}"
    result = f"chosen: {frames};  {explanation.graded()}"
    page.text(0.1, 0.43, result, 7.5, align="left", bold=True, color=_CHOSEN)


def _draw_strip(page: Page, buffer: Buffer, choice: Choice, camera: str, top: float) -> float:
    """Draw evenly spaced frames, the chosen ones outlined; return the y below them."""
    pitch = _SPAN / _PICTURES
    size = pitch - 0.05
    for number in range(_PICTURES):
        frame = (2 * number + 1) * len(buffer) // (2 * _PICTURES)
        x = _LEFT + number * pitch + 0.025
        height = page.picture(buffer.frame(frame, camera), x, top, size)
        if frame in choice.frames:
            page.box(x, top, size, height, fill="none", edge=_CHOSEN, line=2)
        page.text(x + size / 2, top + height + 0.02, str(frame), 5.5, color=GRAY)
    return top + height + 0.17


def _draw_sessions(page: Page, buffer: Buffer, colors: list[str], top: float) -> None:
    _label(page, top, "true", "sessions")
    for number, (session, color) in enumerate(zip(buffer.sessions, colors, strict=True)):
        span = session.start, session.stop
        name = f"LESSON {session.family}" if session.role == "lesson" else session.family
        _draw_bar(page, buffer, span, top, color, [name, str(number)])
    mark_evidence(page, buffer, _LEFT, _SPAN / len(buffer), top + _BAR)


def _draw_segments(page: Page, buffer: Buffer, choice: Choice, top: float) -> None:
    """Draw the segments; those that are too short to be chosen are hollow."""
    _label(page, top, "found", "segments")
    for start, stop in choice.segments:
        fill = "white" if stop - start < MIN_FRAMES else "#d9d9d9"
        _draw_bar(page, buffer, (start, stop), top, fill, [])
    for span in choice.spans:
        _draw_bar(page, buffer, span, top, _CHOSEN, ["chosen"])


def _draw_bar(
    page: Page, buffer: Buffer, span: FrameSpan, top: float, fill: str, names: list[str]
) -> None:
    """Draw a span of frames to scale, with the first name that fits."""
    scale = _SPAN / len(buffer)
    x, width = _LEFT + span[0] * scale, (span[1] - span[0]) * scale
    edge = GRAY if fill == "white" else "white"
    page.box(x, top, width, _BAR, fill=fill, edge=edge, line=0.6)
    if name := next((n for n in names if page.text_width(n, 5.5, bold=True) < width - 0.05), None):
        page.text(x + width / 2, top + 0.045, name, 5.5, bold=True, color=ink_on(fill))


def _label(page: Page, top: float, *lines: str) -> None:
    for number, line in enumerate(lines):
        page.text(_LEFT - 0.05, top + 0.09 * number, line, 6, align="right", color=GRAY)


def _axes(page: Page, measured: Similarities, top: float) -> Any:
    """Add axes of frames, with the lesson shaded."""
    rectangle = (_LEFT / _WIDTH, 1 - (top + _CURVE) / _HEIGHT, _SPAN / _WIDTH, _CURVE / _HEIGHT)
    axes = page.figure.add_axes(rectangle)
    for span in measured.lesson:
        axes.axvspan(*span, color=tint(LESSON_COLOR, 0.13), linewidth=0, zorder=0)
    axes.set_xlim(0, len(measured.alike))
    tidy(axes)
    axes.tick_params(labelsize=6, length=2)
    return axes


def _draw_adjacent(axes: Any, buffer: Buffer, measured: Similarities, choice: Choice) -> None:
    """Draw the cosine of both sides of each border, the threshold, and the cuts."""
    sides = choice.rule.method.sides or 1
    values = measured.borders(sides)
    axes.plot(np.arange(1, len(values) + 1), values, color=_CURVE_INK, linewidth=0.9)
    if choice.threshold is not None:
        label = f"threshold {choice.threshold:.3f}"
        axes.axhline(choice.threshold, color="black", linewidth=0.9, linestyle="--", label=label)
        cuts = np.array([start for start, _ in choice.segments[1:]], int)
        label = f"{len(cuts)} cuts"
        axes.plot(cuts, values[cuts - 1], "v", color="black", markersize=4, label=label)
    axes.tick_params(labelbottom=False)
    compared = "each frame with the next"
    if sides > 1:
        compared = f"the means of the {sides} frames before and after"
    evidence = "; dark line above: evidence" if buffer.evidence else ""
    _title(axes, f"cosine of {compared}; shaded: the true lesson{evidence}")


def _draw_similarity(
    axes: Any, measured: Similarities, choice: Choice, explanation: Explanation
) -> None:
    """Draw the cosine of each frame with the live image, and the score of each segment."""
    axes.plot(np.arange(len(measured.alike)) + 0.5, measured.alike, color=_CURVE_INK, linewidth=0.9)
    for span in choice.spans:
        axes.axvspan(*span, facecolor="none", edgecolor=_CHOSEN, linewidth=1.2, zorder=3)
    for segment, score in choice.scores.items():
        color = _CHOSEN if segment[0] in choice.frames else GRAY
        axes.plot(segment, (score, score), color=color, linewidth=1.2)
    for name, frame, cosine, color, marker in (
        ("closest frame", explanation.closest, explanation.cosine, _CHOSEN, "*"),
        ("closest outside", explanation.other, explanation.other_cosine, GRAY, "o"),
    ):
        if frame is not None:
            style = {"color": color, "markersize": 7, "label": f"{name}, {frame}"}
            axes.plot(frame + 0.5, cosine, marker, zorder=4, **style)
    _title(
        axes, "cosine of each frame with the first live observation; bars: score of each segment"
    )


def _draw_compared(
    page: Page,
    buffer: Buffer,
    colors: list[str],
    explanation: Explanation,
    live: NDArray[np.uint8],
    top: float,
) -> None:
    """Draw the live image beside the closest frames, inside the choice and outside."""
    shown = [("live image", live, "black", ["the first live observation"])]
    for title, frame, cosine in (
        ("closest chosen frame", explanation.closest, explanation.cosine),
        ("closest frame outside", explanation.other, explanation.other_cosine),
    ):
        if frame is not None:
            number = int(buffer.session_index[frame])
            session = buffer.sessions[number]
            lines = [f"frame {frame}, cosine {cosine:.3f}", f"{session.role} {session.source}"]
            image = buffer.frame(frame, explanation.camera)
            shown.append((title, image, colors[number], lines))
    step = _SPAN / 3
    for number, (title, image, color, lines) in enumerate(shown):
        x = _LEFT + (number + 0.5) * step
        page.text(x, top, title, 6.5, bold=True, width=step - 0.05)
        height = page.picture(image, x - _LARGE / 2, top + 0.14, _LARGE)
        page.box(x - _LARGE / 2, top + 0.14, _LARGE, height, fill="none", edge=color, line=2)
        for row, line in enumerate(lines):
            y = top + 0.18 + height + 0.11 * row
            page.text(x, y, line, 6, width=step - 0.05, color=GRAY)


def _title(axes: Any, title: str) -> None:
    axes.set_title(title, loc="left", size=6.5, color=INK, pad=2)
    if not axes.get_legend_handles_labels()[0]:  # a rule without cuts has no threshold
        return
    legend = axes.legend(
        loc="lower right", bbox_to_anchor=(1.005, 0.985), ncols=2, frameon=False, fontsize=6,
        borderpad=0, borderaxespad=0, handlelength=1.6, columnspacing=1.2,
    )  # fmt: skip
    legend.set_in_layout(False)
