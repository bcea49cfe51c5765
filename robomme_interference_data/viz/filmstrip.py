"""Draw a history buffer as a labeled film strip: `robomme-interference show … --out strip.png`."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import SAMPLE_FRAMES, UNIT_FRAMES
from robomme_interference_data.schema.manifest import Session
from robomme_interference_data.schema.sampling import even_sample, spread

from .figure import INK, Hue, Page, ink_on, open_page, tint

if TYPE_CHECKING:
    from robomme_interference_data.data.buffer import Buffer

LESSON_COLOR = Hue.VERMILION
COLORS = (Hue.SKY, Hue.ORANGE, Hue.GREEN, Hue.PINK, Hue.BLUE, Hue.YELLOW, "#999999", "#000000")
"""Of the other sessions."""

CONTRADICTION_COLOR = "#7F3300"
"""A dark one of the lesson's: both show the query's scene, and distractors may have its family."""

_BY_ROLE = {"lesson": LESSON_COLOR, "contradiction": CONTRADICTION_COLOR, "transition": "#dddddd"}
"""Colors of roles; sessions of others have one of their family."""

_KEY = {"contradiction": "contradicting lesson"}
"""Words for roles in the key of colors, where they differ."""

# Inches.
_WIDTH = 7.2  # text width of a two-column page
_MARGIN = 0.1
_INNER = _WIDTH - 2 * _MARGIN
_GAP = 0.15  # between sessions
_EDGE = 0.03  # border of a session around its frames
_FRAME_GAP = 0.03  # minimum between frames of a session
_BAND = 0.18  # colored title of a session
_FOOT = 0.46  # frame numbers, family and episode id below the frames
_LIVE = 0.95  # live observation
_BAR = 0.28  # timeline
_MARK = 0.045  # dark line below evidence

_GRAY = "#555555"
_MANY = 12
"""Sessions on a page from which each gets less room."""
_COLUMNS = 12
"""Frames in a row of the page."""

# Sizes of letters, in points. Pages show the picture smaller than it is: nothing below 7.
_TITLE, _GOAL, _TEXT, _NUMBER = 10.5, 8.5, 7.5, 7


@dataclass(frozen=True)
class Block:
    """Where a session is drawn: its row, first slot and number of slots, and its frames."""

    row: int
    slot: int
    slots: int
    frames: int


def arrange(frames: Sequence[int]) -> tuple[int, list[Block]]:
    """Lay out sessions of these lengths; return the slots in a row, and each session's block.

    A unit takes one slot, a longer session as many as its frames fill, up to a row.
    """
    # More sessions on a page, each with fewer frames.
    slots = 4 if len(frames) <= _MANY else 6
    blocks, row, slot = [], 0, 0
    for count in frames:
        width = slots if len(frames) == 1 else min(slots, max(1, count // UNIT_FRAMES))
        if slot + width > slots:
            row, slot = row + 1, 0
        blocks.append(Block(row, slot, width, min(width * _COLUMNS // slots, count)))
        slot += width
    return slots, blocks


def session_colors(sessions: Sequence[Session]) -> list[str]:
    """Return a color for each session: of the lesson, of a contradicting one, of each other family.

    Families get colors in order of appearance, so they keep them when k grows. The transitions of a
    day are pale, so that its tasks stand out.
    """
    families = dict.fromkeys(s.family for s in sessions if s.role not in _BY_ROLE)
    by_family = {family: COLORS[n % len(COLORS)] for n, family in enumerate(families)}
    return [_BY_ROLE.get(s.role) or by_family[s.family] for s in sessions]


def round_step(frames: int, most: int) -> int:
    """Return the distance of labels on a timeline, such as 50, for at most so many of them."""
    # Round numbers: 1, 2, 5, 10, 20, 50, …
    steps = (digit * 10**power for power in range(9) for digit in (1, 2, 5))
    return next(step for step in steps if step * most >= frames)


def mark_evidence(page: Page, buffer: "Buffer", left: float, scale: float, bottom: float) -> None:
    """Draw a dark line at the bottom of a bar where the buffer's frames show the answer."""
    for entry in buffer.evidence or ():
        x, width = left + entry.start * scale, (entry.stop - entry.start) * scale
        page.box(x, bottom - _MARK, width, _MARK, fill=INK, edge="white", line=0.3)


def draw_strip(
    buffer: "Buffer", out: Path, *, camera: str | None = None, live: NDArray[np.uint8] | None = None
) -> None:
    """Draw a buffer: its sessions, a timeline to scale, and the first live observation.

    Decodes only the frames that are shown. The same buffer gives the same bytes with the same
    version of matplotlib.

    Args:
        buffer: The buffer.
        out: File to write, `.png` or `.svg`.
        camera: Name of the camera; None for the first.
        live: Image of the first live observation, for example under a shift; None for the stored
            one.
    """
    camera = buffer.query.dataset.camera(camera)
    with open_page(out, _WIDTH) as page:
        top = _draw_head(page, buffer, camera)
        top = _draw_sessions(page, buffer, camera, top + 0.1)
        _draw_timeline(page, buffer, top)
        right = _WIDTH - _MARGIN
        page.text(right, top, "what the robot sees now", _TEXT, align="right", bold=True)
        bottom = top + 0.15
        image = buffer.query.frame(camera) if live is None else live
        bottom += page.picture(image, right - _LIVE, bottom, _LIVE, line=1.5)
        middle = right - _LIVE / 2
        page.text(middle, bottom + 0.03, str(len(buffer)), _NUMBER, color=_GRAY)
        page.text(middle, bottom + 0.14, "first live observation", _NUMBER, width=_LIVE)
        page.height = bottom + 0.3


def strip_png(buffer: "Buffer") -> bytes:
    """Return the strip of the first camera as PNG."""
    with TemporaryDirectory() as folder:
        out = Path(folder) / "strip.png"
        draw_strip(buffer, out)
        return out.read_bytes()


def _draw_head(page: Page, buffer: "Buffer", camera: str) -> float:
    """Write the title and return the y below it."""
    manifest = buffer.manifest
    ability = buffer.query.record.ability
    title = "   ".join(filter(None, (str(buffer.episode_id), buffer.condition, ability)))
    page.text(_MARGIN, 0.06, title, _TITLE, width=0.63 * _INNER, align="left", bold=True)
    simulator = manifest.simulator and f"simulator {manifest.simulator}"
    facts = ", ".join(filter(None, (f"{camera} camera", simulator, manifest.difficulty)))
    right = _WIDTH - _MARGIN
    page.text(right, 0.1, facts, _TEXT, width=0.35 * _INNER, align="right", color=_GRAY)
    y = 0.28
    for line in page.wrap(f"Goal: {buffer.goal}", _GOAL, _INNER, most=4):
        page.text(_MARGIN, y, line, _GOAL, width=_INNER, align="left")
        y += 0.15
    frames: Counter[str] = Counter()
    for session in buffer.sessions:
        frames[session.role] += len(session)
    parts = " + ".join(f"{count} {role}" for role, count in frames.items())
    counts = f"{len(buffer)} history frames" + (f" = {parts}" if parts else "")
    share = f"an even {SAMPLE_FRAMES}-frame sample holds {manifest.lesson_share:.0%} lesson"
    text = f"{counts};  {share}"
    page.text(_MARGIN, y + 0.03, text, _TEXT, width=_INNER, align="left", color=_GRAY)
    return y + 0.17


def _draw_sessions(page: Page, buffer: "Buffer", camera: str, top: float) -> float:
    """Draw all sessions and return the y below them."""
    colors = session_colors(buffer.sessions)
    drawn = [(n, s) for n, s in enumerate(buffer.sessions) if s.role != "transition"]
    slots, blocks = arrange([_drawn_frames(s, among=len(drawn)) for _, s in drawn])
    per_slot = _COLUMNS // slots
    pitch = (_INNER + _GAP) / slots
    size = (pitch - _GAP - (per_slot - 1) * _FRAME_GAP) / per_slot
    for (number, session), block in zip(drawn, blocks, strict=True):
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
            if any(entry.seen([index]) for entry in buffer.evidence or ()):
                foot = y + _BAND + tall - _MARK
                page.box(x, foot, size, _MARK, fill=INK, edge="white", line=0.3)
            page.text(x + size / 2, y + _BAND + tall + 0.015, str(index), _NUMBER, color=_GRAY)
            x += step
    return y + height + _GAP if blocks else top


def _drawn_frames(session: Session, among: int) -> int:
    """Return the frames for which a session gets room: among many only the lesson's all count."""
    if session.role == "lesson" or among <= _MANY:
        return len(session)
    return min(len(session), 2 * UNIT_FRAMES)


def _draw_card(
    page: Page, session: Session, number: int, color: str, place: tuple[float, ...]
) -> None:
    """Draw a session without its frames; `place` is x, y, width and height."""
    left, y, inner, height = place
    right, lesson = left + inner, session.role == "lesson"
    edge, line = (color, 1.8) if lesson else (_GRAY, 0.5)
    for tall, fill in ((height, tint(color, 0.13)), (_BAND, color)):
        page.box(left - _EDGE, y, inner + 2 * _EDGE, tall, fill=fill, edge=edge, line=line)
    role = f"{number}  {session.role.upper() if lesson else session.role}"
    frames = len(session)
    count = f"{frames} frame{'s' if frames > 1 else ''}"
    ink = ink_on(color)
    page.text(left, y + 0.03, role, _TEXT, width=0.54 * inner, align="left", bold=lesson, color=ink)
    page.text(right, y + 0.03, count, _TEXT, width=0.4 * inner, align="right", color=ink)
    under = y + height - 0.3
    page.text(left, under, session.family, _TEXT, width=inner, align="left", bold=True)
    page.text(left, under + 0.14, str(session.source), _NUMBER, width=inner, align="left")


def _draw_timeline(page: Page, buffer: "Buffer", top: float) -> None:
    """Draw the history to scale, the live observation after it, and the frames of the sample."""
    width = _INNER - _LIVE - 0.42
    # One frame more, for the live observation, which alone would fill the line.
    scale = width / (len(buffer) + 1) if len(buffer) else _MARK
    end = _MARGIN + width
    left = end - (len(buffer) + 1) * scale
    caption = "history to scale; ticks: the even sample, and its frames in each session"
    if buffer.evidence:
        caption += "; dark line: shows the answer"
    page.text(_MARGIN, top, caption, _TEXT, width=_INNER - _LIVE - 0.6, align="left", color=_GRAY)
    bar, sample = top + 0.44, even_sample(len(buffer))
    for number, color in enumerate(session_colors(buffer.sessions)):
        session = buffer.sessions[number]
        x, wide = left + session.start * scale, len(session) * scale
        page.box(x, bar, wide, _BAR, fill=color, edge="white", line=0.5)
        for name in (f"{number} {session.role}", str(number)):  # the first that fits
            if page.text_width(name, _NUMBER, bold=True) < wide:
                y = bar + _BAR / 2 - 0.05
                page.text(x + wide / 2, y, name, _NUMBER, bold=True, color=ink_on(color))
                break
    mark_evidence(page, buffer, left, scale, bar + _BAR)
    for index in sample:
        page.tick(left + (index + 0.5) * scale, bar - 0.1, bar - 0.02)
    for session in buffer.sessions:
        inside = str(sum(session.start <= index < session.stop for index in sample))
        if page.text_width(inside, _NUMBER, bold=True) < len(session) * scale:
            x = left + (session.start + session.stop) / 2 * scale
            page.text(x, bar - 0.22, inside, _NUMBER, bold=True)
    page.box(end - scale, bar, scale, _BAR, fill="black", edge="black", line=0.8)
    page.text(end + 0.02, bar - 0.21, "+1 live", _NUMBER, align="left", color=_GRAY)
    page.arrow(end + 0.05, end + 0.37, bar + _BAR / 2)
    for index in range(0, len(buffer) + 1, round_step(len(buffer), 10)):
        x = left + (index + 0.5) * scale
        page.tick(x, bar + _BAR, bar + _BAR + 0.04)
        page.text(x, bar + _BAR + 0.06, str(index), _NUMBER, color=_GRAY)
    if len(buffer):
        middle = _MARGIN + width / 2
        page.text(middle, bar + _BAR + 0.19, "frame in the buffer", _TEXT, color=_GRAY)
    _draw_key(page, buffer, bar + _BAR + 0.36)


def _draw_key(page: Page, buffer: "Buffer", top: float) -> None:
    """Name the colors of roles, if there are others than the lesson's, which stands out."""
    found = {session.role for session in buffer.sessions}
    roles = [role for role in _BY_ROLE if role in found]
    if not {*roles} - {"lesson"}:
        return
    left = _MARGIN
    for role in roles:
        name = _KEY.get(role, role)
        page.box(left, top, 0.12, 0.1, fill=_BY_ROLE[role], edge=_GRAY, line=0.5)
        page.text(left + 0.17, top - 0.01, name, _NUMBER, align="left")
        left += 0.35 + page.text_width(name, _NUMBER)
