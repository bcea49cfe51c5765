"""Draw why a part of a history was chosen: `robomme-interference retrieve … --out why.png`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from robomme_interference_data.buffer import Buffer
from robomme_interference_data.drawing import GREY, INK, Page, ink_on, open_page, tidy, tint
from robomme_interference_data.retrieval.grade import Grade
from robomme_interference_data.retrieval.report import Reasons, reasons
from robomme_interference_data.retrieval.segment import MIN_FRAMES
from robomme_interference_data.retrieval.select import Choice
from robomme_interference_data.strip import LESSON_COLOR, session_colors
from robomme_interference_data.tables import percent

__all__ = ["draw_retrieval"]

# Inches.
_WIDTH = 7.2
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
    buffer: Buffer, choice: Choice, grade: Grade, encoder: str, camera: str, out: Path
) -> None:
    """Draw a choice: film strip, true sessions, cuts, segments, and cosines with the query.

    The same choice gives the same bytes with the same version of matplotlib.

    Args:
        buffer: The buffer.
        choice: What was chosen of it; a span.
        grade: The same choice, graded.
        encoder: Name of the encoder.
        camera: Camera whose frames were compared.
        out: File to write, `.png` or `.svg`.

    Raises:
        InvalidOptionError: `out` has another suffix or cannot be written.
        MissingExtraError: matplotlib is not installed.
        MissingFileError, FormatError, TruncatedVideoError: A video cannot be read.
    """
    found = reasons(buffer, choice, grade, camera)
    colors = session_colors(buffer.sessions)
    with open_page(out, _WIDTH) as page:
        page.height = 6.1
        page.figure.set_size_inches(_WIDTH, page.height)
        top = _head(page, buffer, found, encoder)
        top = _strip(page, buffer, choice, colors, camera, top)
        top = _sessions(page, buffer, colors, top + 0.05)
        axes = _axes(page, top + 0.14, buffer)
        _adjacent(axes, choice)
        top = _segments(page, choice, top + 0.14 + _CURVE + 0.07)
        axes = _axes(page, top + 0.14, buffer)
        _alike(axes, choice, found)
        top += 0.14 + _CURVE + 0.36
        page.text((_LEFT + _RIGHT) / 2, top - 0.19, "frame in the buffer", 6.5, color=GREY)
        _compared(page, buffer, found, colors, camera, top)


def _head(page: Page, buffer: Buffer, found: Reasons, encoder: str) -> float:
    grade = found.grade
    title = f"{buffer.episode_id}   k = {buffer.k}"
    page.text(0.1, 0.06, title, 10, align="left", bold=True, width=0.55 * _WIDTH)
    how = f"{encoder}, {found.camera} camera, rule {grade.rule}"
    page.text(_RIGHT, 0.1, how, 6.5, align="right", color=GREY, width=0.4 * _WIDTH)
    text = f"Goal: {buffer.goal}"
    page.text(0.1, 0.27, text, 7.5, align="left", width=_WIDTH - 0.2)
    result = (
        f"chosen: frames {grade.start} to {grade.stop - 1} of {grade.history_frames};  purity "
        f"{percent(grade.purity)}, coverage {percent(grade.coverage)}, false sessions "
        f"{grade.false_sessions}"
    )
    page.text(0.1, 0.43, result, 7.5, align="left", bold=True, color=_CHOSEN)
    return 0.64


def _strip(
    page: Page,
    buffer: Buffer,
    choice: Choice,
    colors: Sequence[str],
    camera: str,
    top: float,
) -> float:
    """Draw pictures in the places of their frames on the axis; those chosen are marked."""
    pitch = _SPAN / _SHOWN
    size = pitch - 0.05
    start, stop = choice.span
    for place in range(_SHOWN):
        frame = (2 * place + 1) * len(buffer) // (2 * _SHOWN)
        x = _LEFT + place * pitch + 0.025
        color = colors[int(buffer.session_index[frame])]
        tall = page.picture(buffer.frame(frame, camera), x, top, size)
        page.box(x, top + tall + 0.012, size, 0.035, fill=color, edge=color, line=0)
        if start <= frame < stop:
            page.box(x, top, size, tall, fill="none", edge=_CHOSEN, line=2)
        page.text(x + size / 2, top + tall + 0.055, str(frame), 5.5, color=GREY)
    return top + tall + 0.2


def _sessions(page: Page, buffer: Buffer, colors: Sequence[str], top: float) -> float:
    """Draw the true sessions to scale."""
    scale = _SPAN / len(buffer)
    page.text(_LEFT - 0.05, top, "true", 6, align="right", color=GREY)
    page.text(_LEFT - 0.05, top + 0.09, "sessions", 6, align="right", color=GREY)
    for number, (session, color) in enumerate(zip(buffer.sessions, colors, strict=True)):
        x, width = _LEFT + session.start * scale, (session.stop - session.start) * scale
        page.box(x, top, width, _BAR, fill=color, edge="white", line=0.6)
        lesson = session.role == "lesson"
        names = [f"LESSON {session.family}", "LESSON"] if lesson else [session.family]
        room = width - 0.04
        # Text may shrink by a quarter.
        fitting = (n for n in [*names, str(number)] if page.text_width(n, 4.2, bold=True) < room)
        if name := next(fitting, None):
            ink = ink_on(color)
            page.text(x + width / 2, top + 0.055, name, 5.5, width=room, bold=True, color=ink)
    return top + _BAR


def _segments(page: Page, choice: Choice, top: float) -> float:
    """Draw the segments to scale; the chosen one stands out, those too short are hollow."""
    scale = _SPAN / len(choice.query_cosines)
    page.text(_LEFT - 0.05, top, "found", 6, align="right", color=GREY)
    page.text(_LEFT - 0.05, top + 0.09, "segments", 6, align="right", color=GREY)
    for start, stop in choice.segments:
        chosen = (start, stop) == choice.span
        short = stop - start < MIN_FRAMES
        fill = _CHOSEN if chosen else "white" if short else _SEGMENT
        x, width = _LEFT + start * scale, (stop - start) * scale
        page.box(x, top, width, _BAR, fill=fill, edge="white" if not short else GREY, line=0.6)
    start, stop = choice.span
    x, width = _LEFT + start * scale, (stop - start) * scale
    if (start, stop) not in choice.segments:  # the oracle's choice is no segment
        page.box(x, top, width, _BAR, fill=_CHOSEN, edge="white", line=0.6)
    if page.text_width("chosen", 6, bold=True) < width:
        page.text(x + width / 2, top + 0.05, "chosen", 6, bold=True, color="white")
    return top + _BAR


def _axes(page: Page, top: float, buffer: Buffer) -> Any:
    """Add axes in the place of the curve, with the lesson in the background."""
    height = page.height
    place = (_LEFT / _WIDTH, 1 - (top + _CURVE) / height, _SPAN / _WIDTH, _CURVE / height)
    axes = page.figure.add_axes(place)
    for session in buffer.sessions:
        if session.role == "lesson":
            shade = tint(LESSON_COLOR, 0.13)
            axes.axvspan(session.start, session.stop, color=shade, linewidth=0, zorder=0)
    axes.set_xlim(0, len(buffer))
    tidy(axes)
    axes.tick_params(labelsize=6, length=2)
    return axes


def _adjacent(axes: Any, choice: Choice) -> None:
    """Draw the cosine of each frame with the next, the threshold, and the cuts."""
    places = np.arange(1, len(choice.adjacent) + 1)  # a cut lies before this frame
    axes.plot(places, choice.adjacent, color=_CURVE_INK, linewidth=0.9)
    threshold = choice.threshold
    label = f"threshold {threshold:.3f}"
    axes.axhline(threshold, color="black", linewidth=0.9, linestyle="--", label=label)
    cut = choice.adjacent < threshold
    label = f"{int(cut.sum())} cuts"
    axes.plot(
        places[cut], choice.adjacent[cut], "v", color="black", markersize=4, label=label, ls=""
    )
    axes.tick_params(labelbottom=False)
    _name(axes, "cosine of each frame with the next; shaded: the true lesson")


def _alike(axes: Any, choice: Choice, found: Reasons) -> None:
    """Draw the cosine of each frame with what the robot sees, and each segment's highest."""
    alike = choice.query_cosines
    axes.plot(np.arange(len(alike)) + 0.5, alike, color=_CURVE_INK, linewidth=0.9)
    start, stop = choice.span
    axes.axvspan(start, stop, facecolor="none", edgecolor=_CHOSEN, linewidth=1.2, zorder=3)
    for (first, last), score in zip(choice.segments, choice.scores, strict=True):
        if score is not None:
            color = _CHOSEN if (first, last) == (start, stop) else GREY
            axes.plot((first, last), (score, score), color=color, linewidth=1.2)
    axes.plot(
        found.closest + 0.5,
        found.cosine,
        "*",
        color=_CHOSEN,
        markersize=9,
        label=f"closest frame, {found.closest}",
        zorder=4,
    )
    if found.other is not None:
        axes.plot(
            found.other + 0.5,
            found.other_cosine,
            "o",
            color=GREY,
            markersize=4.5,
            label=f"closest outside, {found.other}",
            zorder=4,
        )
    _name(axes, "cosine of each frame with what the robot sees now; bars: score of each segment")


def _name(axes: Any, title: str) -> None:
    axes.set_title(title, loc="left", size=6.5, color=INK, pad=2)
    legend = axes.legend(
        loc="lower right",
        bbox_to_anchor=(1.005, 0.985),
        ncols=2,
        frameon=False,
        fontsize=6,
        borderpad=0,
        borderaxespad=0,
        handlelength=1.6,
        columnspacing=1.2,
    )
    legend.set_in_layout(False)


def _compared(
    page: Page,
    buffer: Buffer,
    found: Reasons,
    colors: Sequence[str],
    camera: str,
    top: float,
) -> None:
    """Draw what the robot sees beside the closest frames, inside the choice and outside."""
    now = "the first live observation"
    pictures = [("what the robot sees now", buffer.query_frame(camera), "black", (now, ""))]
    session = buffer.session_index

    def add(title: str, frame: int, cosine: float) -> None:
        one = buffer.sessions[int(session[frame])]
        below = f"frame {frame}, cosine {cosine:.3f}", f"{one.role} {one.source}"
        image = buffer.frame(frame, camera)
        pictures.append((title, image, colors[int(session[frame])], below))

    add("closest frame that was chosen", found.closest, found.cosine)
    if found.other is not None and found.other_cosine is not None:
        add("closest frame outside", found.other, found.other_cosine)
    step = _SPAN / 3
    for place, (title, image, color, below) in enumerate(pictures):
        x = _LEFT + place * step + (step - _LARGE) / 2
        page.text(x + _LARGE / 2, top, title, 6.5, bold=True, width=step - 0.05)
        tall = page.picture(image, x, top + 0.14, _LARGE)
        page.box(x, top + 0.14, _LARGE, tall, fill="none", edge=color, line=2)
        for line, text in enumerate(below):
            y = top + 0.18 + tall + 0.11 * line
            page.text(x + _LARGE / 2, y, text, 6, width=step - 0.05, color=GREY)
