"""Draw a history buffer as a labelled film strip: `robomme-interference show … --out strip.png`."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import CAMERA_PREFIX, SAMPLE_FRAMES, UNIT_FRAMES
from robomme_interference_data.schema.manifest import Session
from robomme_interference_data.schema.sampling import even_sample, spread

from .figure import INK, Hue, Page, ink_on, open_page, tint

if TYPE_CHECKING:
    from robomme_interference_data.data.buffer import Buffer

LESSON_COLOR = Hue.VERMILION
COLORS = (Hue.SKY, Hue.ORANGE, Hue.GREEN, Hue.PINK, Hue.BLUE, Hue.YELLOW, "#999999", "#000000")
"""Of the other sessions."""

# Inches.
_WIDTH = 7.2  # text width of a two-column page
_MARGIN = 0.1
_INNER = _WIDTH - 2 * _MARGIN
_GAP = 0.15  # between the frames of one session and of the next
_EDGE = 0.03  # of a session around its frames
_FRAME_GAP = 0.03  # between frames of a session, at least
_BAND = 0.16  # coloured head of a session
_FOOT = 0.42  # indices, family and episode id under the frames of a session
_LIVE = 0.95  # live observation
_BAR = 0.28  # timeline
_MARK = 0.045  # dark line under what shows the answer

_GREY = "#555555"
_COLUMNS = 12
"""Frames in a row of the page."""


@dataclass(frozen=True)
class Block:
    """Place of a session on the page.

    Attributes:
        row: Row, from 0.
        slot: Its first slot in the row.
        slots: Slots that it takes.
        frames: Frames that it shows.
    """

    row: int
    slot: int
    slots: int
    frames: int


def arrange(frames: Sequence[int]) -> tuple[int, list[Block]]:
    """Lay sessions out in rows of 3, 4 or 6 slots, in order, in as few rows as possible.

    A unit takes one slot. A longer session takes as many as its frames would fill, up to a whole
    row; fewer, down to two, where that saves a row.

    Args:
        frames: Frames of each session.

    Returns:
        Slots in a row, and the place of each session.
    """
    if len(frames) == 1:
        return 3, [Block(0, 0, 3, min(_COLUMNS, frames[0]))]
    wanted = [max(1, n // UNIT_FRAMES) for n in frames]
    layouts = [
        (slots, _wrap([min(n, most) for n in wanted], slots))
        for slots in ((3, 4) if len(frames) <= 12 else (6,))
        for most in range(slots, 1, -1)
    ]
    slots, places = min(layouts, key=lambda layout: max([row for row, *_ in layout[1]], default=0))
    per_slot = _COLUMNS // slots
    return slots, [
        Block(row, slot, width, min(width * per_slot, n))
        for (row, slot, width), n in zip(places, frames, strict=True)
    ]


def _wrap(widths: Iterable[int], slots: int) -> list[tuple[int, int, int]]:
    """Fill rows from the left; returns `(row, first slot, width)` of each."""
    places, row, slot = [], 0, 0
    for width in widths:
        if slot + width > slots:
            row, slot = row + 1, 0
        places.append((row, slot, width))
        slot += width
    return places


def session_colors(sessions: Sequence[Session]) -> list[str]:
    """Return a colour for each session, `#rrggbb`: the lesson's own, the others' by family.

    Families get colours in order of appearance, so that they keep them when k grows.
    """
    families = dict.fromkeys(s.family for s in sessions if s.role != "lesson")
    by_family = {family: COLORS[n % len(COLORS)] for n, family in enumerate(families)}
    return [LESSON_COLOR if s.role == "lesson" else by_family[s.family] for s in sessions]


def mark_evidence(page: Page, buffer: "Buffer", left: float, scale: float, bottom: float) -> None:
    """Draw a dark line along the foot of a bar wherever the buffer's frames show the answer.

    Args:
        page: The page.
        buffer: The buffer that the bar stands for.
        left: Left edge of the bar, in inches.
        scale: Inches of a frame.
        bottom: The bar's foot, in inches.
    """
    for one in buffer.evidence or ():
        width = (one.stop - one.start) * scale
        place = left + one.start * scale, bottom - _MARK, width, _MARK
        page.box(*place, fill=INK, edge="white", line=0.3)


def draw_strip(
    buffer: "Buffer", out: Path, *, camera: str = "front", live: NDArray[np.uint8] | None = None
) -> None:
    """Draw a buffer: its sessions, a timeline to scale, and the first live observation.

    Decodes only the frames that are shown. The same buffer gives the same bytes with the same
    version of matplotlib.

    Args:
        buffer: The buffer.
        out: File to write, `.png` or `.svg`.
        camera: Name of the camera.
        live: Picture of the first live observation, such as one under a shift; None for the stored
            one.
    """
    with open_page(out, _WIDTH) as page:
        colors = session_colors(buffer.sessions)
        top = _draw_head(page, buffer, camera)
        top = _draw_sessions(page, buffer, camera, colors, top + 0.1)
        _draw_timeline(page, buffer, colors, top)
        right = _WIDTH - _MARGIN
        page.text(right, top, "what the robot sees now", 6.5, align="right", bold=True)
        bottom = top + 0.15
        seen = buffer.query.frame(camera) if live is None else live
        bottom += page.picture(seen, right - _LIVE, bottom, _LIVE, line=1.5)
        middle = right - _LIVE / 2
        page.text(middle, bottom + 0.03, str(len(buffer)), 5.5, color=_GREY)
        page.text(middle, bottom + 0.13, "first live observation", 6, width=_LIVE)
        page.height = bottom + 0.28


def shown_camera(buffer: "Buffer") -> str:
    """Return the camera of a strip for which none is chosen: the front one if there is one."""
    return "front" if "front" in buffer.cameras else buffer.cameras[0]


def strip_png(buffer: "Buffer") -> bytes:
    """Return what `draw_strip` draws of the camera that `shown_camera` names, as PNG."""
    with TemporaryDirectory() as folder:
        out = Path(folder) / "strip.png"
        draw_strip(buffer, out, camera=shown_camera(buffer))
        return out.read_bytes()


def _draw_head(page: Page, buffer: "Buffer", camera: str) -> float:
    """Write the title and return the y under it."""
    manifest = buffer.manifest
    title = f"{buffer.episode_id}   {buffer.condition}"
    page.text(_MARGIN, 0.06, title, 10, width=0.63 * _INNER, align="left", bold=True)
    view = camera.removeprefix(CAMERA_PREFIX)
    simulator = manifest.simulator and f"simulator {manifest.simulator}"
    facts = ", ".join(filter(None, (f"{view} camera", simulator, manifest.difficulty)))
    right = _WIDTH - _MARGIN
    page.text(right, 0.1, facts, 6.5, width=0.35 * _INNER, align="right", color=_GREY)
    y = 0.28
    for line in page.wrap(f"Goal: {buffer.goal}", 8, _INNER, most=4):
        page.text(_MARGIN, y, line, 8, width=_INNER, align="left")
        y += 0.15
    frames: Counter[str] = Counter()
    for session in buffer.sessions:
        frames[session.role] += len(session)
    parts = " + ".join(f"{count} {role}" for role, count in frames.items())
    counts = f"{len(buffer)} history frames" + (f" = {parts}" if parts else "")
    share = f"an even {SAMPLE_FRAMES}-frame sample holds {manifest.lesson_share:.0%} lesson"
    page.text(_MARGIN, y + 0.03, f"{counts};  {share}", 7, align="left", color=_GREY)
    return y + 0.17


def _draw_sessions(
    page: Page, buffer: "Buffer", camera: str, colors: Sequence[str], top: float
) -> float:
    """Draw all sessions and return the y under them."""
    slots, blocks = arrange([len(s) for s in buffer.sessions])
    per_slot = _COLUMNS // slots
    pitch = (_INNER + _GAP) / slots
    size = (pitch - _GAP - (per_slot - 1) * _FRAME_GAP) / per_slot
    for number, (session, block) in enumerate(zip(buffer.sessions, blocks, strict=True)):
        width = block.slots * pitch - _GAP
        # A session of several slots spreads its frames over the gaps between the slots.
        step = (width - size) / (block.slots * per_slot - 1)
        indices = spread(session.start, session.stop, block.frames)
        images = [buffer.frame(index, camera) for index in indices]
        tall = size * images[0].shape[0] / images[0].shape[1]
        height = _BAND + tall + _FOOT
        x, y = _MARGIN + block.slot * pitch, top + block.row * (height + _GAP)
        _draw_card(page, session, number, colors[number], (x, y, width, height))
        for index, image in zip(indices, images, strict=True):
            page.picture(image, x, y + _BAND, size)
            if any(one.seen([index]) for one in buffer.evidence or ()):
                foot = y + _BAND + tall - _MARK
                page.box(x, foot, size, _MARK, fill=INK, edge="white", line=0.3)
            page.text(x + size / 2, y + _BAND + tall + 0.015, str(index), 5.5, color=_GREY)
            x += step
    return y + height + _GAP if blocks else top


def _draw_card(
    page: Page, session: Session, number: int, color: str, place: tuple[float, ...]
) -> None:
    """Draw all of a session but its frames; `place` is x, y, width and height."""
    left, y, inner, height = place
    right, lesson = left + inner, session.role == "lesson"
    edge, line = (color, 1.8) if lesson else (_GREY, 0.5)
    for tall, fill in ((height, tint(color, 0.13)), (_BAND, color)):
        page.box(left - _EDGE, y, inner + 2 * _EDGE, tall, fill=fill, edge=edge, line=line)
    role = f"{number}  {session.role.upper() if lesson else session.role}"
    frames = len(session)
    count = f"{frames} frame{'s' if frames > 1 else ''}"
    ink = ink_on(color)
    page.text(left, y + 0.03, role, 6.5, width=0.54 * inner, align="left", bold=lesson, color=ink)
    page.text(right, y + 0.03, count, 6.5, width=0.4 * inner, align="right", color=ink)
    under = y + height - 0.27
    page.text(left, under, session.family, 7, width=inner, align="left", bold=True)
    page.text(left, under + 0.13, str(session.source), 6, width=inner, align="left")


def _draw_timeline(page: Page, buffer: "Buffer", colors: Sequence[str], top: float) -> None:
    """Draw the history to scale, the live observation at its end, and the even sample's ticks."""
    width = _INNER - _LIVE - 0.42
    scale = width / (len(buffer) + 1)
    caption = "history to scale; ticks: the even sample, and how many of it fall in each session"
    if buffer.evidence:
        caption += "; dark line: shows the answer"
    page.text(_MARGIN, top, caption, 6.5, align="left", color=_GREY)
    bar = top + 0.44
    sample = even_sample(len(buffer))
    for index in sample:
        page.tick(_MARGIN + (index + 0.5) * scale, bar - 0.1, bar - 0.02)
    spans = [(len(s)) * scale for s in buffer.sessions]
    numbers = [page.text_width(str(n), 6, bold=True) for n in range(len(spans))]
    turned = any(n > 0.9 * span for n, span in zip(numbers, spans, strict=True))
    for number, (session, color) in enumerate(zip(buffer.sessions, colors, strict=True)):
        x, span = _MARGIN + session.start * scale, spans[number]
        page.box(x, bar, span, _BAR, fill=color, edge="white", line=0.4)
        name, upright = str(number), not turned
        if session.role == "lesson" and page.text_width(f"{number} lesson", 6, bold=True) < span:
            name, upright = f"{number} lesson", True
        if upright or span > 0.07 or number % 5 == 0:
            y = bar + (0.09 if upright else (_BAR - numbers[number]) / 2)
            ink, size = ink_on(color), 6 if upright else 5
            page.text(x + span / 2, y, name, size, bold=True, color=ink, turned=not upright)
        inside = sum(session.start <= index < session.stop for index in sample)
        if inside or span > 0.1:  # noughts would run into each other
            page.text(x + span / 2, bar - 0.21, str(inside), 6, bold=True)
    mark_evidence(page, buffer, _MARGIN, scale, bar + _BAR)
    end = _MARGIN + width
    page.box(end - scale, bar, scale, _BAR, fill="black", edge="black", line=0.8)
    page.text(end + 0.02, bar - 0.21, "+1 live", 6, align="left", color=_GREY)
    page.arrow(end + 0.05, end + 0.37, bar + _BAR / 2)
    steps = (digit * 10**power for power in range(9) for digit in (1, 2, 5))
    step = next(n for n in steps if n * 10 >= len(buffer))
    for index in range(0, len(buffer) + 1, step):
        x = _MARGIN + (index + 0.5) * scale
        page.tick(x, bar + _BAR, bar + _BAR + 0.04)
        page.text(x, bar + _BAR + 0.06, str(index), 6, color=_GREY)
    page.text(_MARGIN + width / 2, bar + _BAR + 0.19, "frame in the buffer", 6.5, color=_GREY)
