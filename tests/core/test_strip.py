"""The film strip: its layout by hand, pictures read back, their bytes, and what cannot be drawn."""

import base64
import html
import io
import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.buffer_sets import QUERIES
from support.messages import raises
from support.retrieval import remade

from robomme_interference_data import Buffer, load_buffer, load_buffer_set
from robomme_interference_data.errors import InvalidOptionError, UnknownNameError
from robomme_interference_data.schema.sampling import spread
from robomme_interference_data.viz.filmstrip import Block, arrange, draw_strip, session_colors

pytest.importorskip("matplotlib")


def labels(svg: Path) -> list[str]:
    """All texts of the picture."""
    found = re.findall(r"<text[^>]*>(.*?)</text>", svg.read_text(encoding="utf-8"))
    return [html.unescape(text) for text in found]


def pictures(svg: Path) -> list[NDArray[np.uint8]]:
    from PIL import Image

    found = re.findall(r'href="data:image/png;base64,([^"]*)"', svg.read_text(encoding="utf-8"))
    return [np.asarray(Image.open(io.BytesIO(base64.b64decode(png))))[..., :3] for png in found]


def coarse(image: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Means of 4 × 4 fields: the same for a picture and a smaller or larger one of it."""
    rows = np.array_split(image.astype(float), 4, axis=0)
    return np.array([[f.mean((0, 1)) for f in np.array_split(r, 4, axis=1)] for r in rows])


def of_lengths(buffer_set: Path, frames: Sequence[int], **changes: object) -> Buffer:
    """A lesson and then units in turn, of so many frames each: more are had by holding them."""
    lesson, *units = load_buffer_set(buffer_set).manifest(QUERIES[0], "k3").sessions
    entries = []
    for number, count in enumerate(frames):
        entry = units[number % 3] if number else lesson
        repeat = -(-count // entry.stop)
        entries.append(replace(entry, stop=count // repeat, repeat=repeat))
    return remade(buffer_set, entries, **changes)


@pytest.fixture(scope="module")
def buffer(tiny_buffers: Path) -> Buffer:
    """A lesson of 48 frames and three units of 32."""
    return load_buffer(QUERIES[0], "k3", buffer_set=tiny_buffers)


@pytest.fixture(scope="module")
def strip(buffer: Buffer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("strip") / "strip.svg"
    draw_strip(buffer, out)
    return out


# --- layout ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frames", "slots", "blocks"),
    [
        ([], 4, []),
        ([48], 4, [Block(0, 0, 4, 12)]),  # alone, it takes the row
        ([257, 32, 32, 32], 4, [Block(0, 0, 4, 12), *(Block(1, n, 1, 3) for n in range(3))]),
        ([32, 96, 32], 4, [Block(0, 0, 1, 3), Block(0, 1, 3, 9), Block(1, 0, 1, 3)]),
    ],
)
def test_layout(frames: list[int], slots: int, blocks: list[Block]) -> None:
    assert arrange(frames) == (slots, blocks)


@given(st.lists(st.integers(1, 3000), min_size=1, max_size=64))
def test_sessions_never_overlap(frames: list[int]) -> None:
    slots, blocks = arrange(frames)
    assert len(blocks) == len(frames)
    cells = [(b.row, b.slot + n) for b in blocks for n in range(b.slots)]
    assert cells == sorted(set(cells))
    assert {row for row, _ in cells} == set(range(blocks[-1].row + 1))
    assert max(slot for _, slot in cells) < slots


# --- pictures ----------------------------------------------------------------------------------


def test_texts_describe_the_buffer(strip: Path, buffer: Buffer) -> None:
    found = labels(strip)
    assert f"{QUERIES[0]}   k3" in found
    assert f"Goal: {buffer.goal}" in found
    # 48 lesson frames of 144: samples are j · 144 // 31, so 0 to 10 of 32, 34%.
    share = "an even 32-frame sample holds 34% lesson"
    assert f"144 history frames = 48 lesson + 96 distractor;  {share}" in found
    assert "lesson" not in found  # no key of colors: it stands out
    assert "0  LESSON" in found and "what the robot sees now" in found
    assert found[-2:] == ["144", "first live observation"]
    for number, session in enumerate(buffer.sessions):
        assert session.family in found and str(session.source) in found
        assert number == 0 or f"{number}  distractor" in found


def test_a_contradicting_lesson_and_a_unit_of_its_family(
    tiny_buffers: Path, tmp_path: Path
) -> None:
    lesson, old, unit, _ = load_buffer_set(tiny_buffers).manifest(QUERIES[0], "k3").sessions
    entries = [replace(old, role="contradiction"), replace(unit, family=old.family), lesson]
    buffer = remade(tiny_buffers, entries)
    assert len({*session_colors(buffer.sessions)}) == 3
    draw_strip(buffer, tmp_path / "strip.svg")
    found = labels(tmp_path / "strip.svg")
    assert found.index("lesson") + 1 == found.index("contradicting lesson")


def test_shows_the_right_frames_in_order_and_the_live_one_last(strip: Path, buffer: Buffer) -> None:
    shown = [n for s in buffer.sessions for n in spread(s.start, s.stop, 3)]
    assert shown == [0, 23, 47, 48, 63, 79, 80, 95, 111, 112, 127, 143]
    found = labels(strip)
    assert [int(text) for text in found if text in map(str, shown[1:])][:11] == shown[1:]
    expected = [buffer.frame(index) for index in shown] + [buffer.query.frame()]
    drawn = [image[::-1] for image in pictures(strip)]  # stored upside down
    assert len(drawn) == len(expected)
    for image, frame in zip(drawn, expected, strict=True):
        assert np.abs(coarse(image) - coarse(frame)).max() < 12


@pytest.mark.slow
@pytest.mark.parametrize(
    "frames", [[36], [1, 1], [1100, *[32] * 15]], ids=["k0", "tiny", "long-k15"]
)
def test_any_number_of_sessions(tiny_buffers: Path, tmp_path: Path, frames: list[int]) -> None:
    out = tmp_path / "strip.svg"
    made = of_lengths(tiny_buffers, frames)
    draw_strip(made, out, camera="wrist")
    lengths = [len(session) for session in made.sessions]
    found = labels(out)
    assert found[1].startswith("wrist camera")
    live = pictures(out)[-1][::-1]
    assert np.abs(coarse(live) - coarse(made.query.frame("wrist"))).max() < 12
    counts = [text for text in found if re.fullmatch(r"\d+ frames?", text)]
    assert counts == [f"{n} frame{'s' * (n > 1)}" for n in lengths]
    assert len(pictures(out)) == 1 + sum(block.frames for block in arrange(lengths)[1])
    view = ET.parse(out).getroot().attrib["viewBox"].split()
    assert float(view[2]) == pytest.approx(7.2 * 72)
    assert float(view[3]) < 16 * 72


@pytest.mark.slow
@pytest.mark.parametrize(
    ("goal", "line", "count"),
    [
        ("pay $5 and $6", "Goal: pay $5 and $6", 1),
        ("a\tb\x00\n c", "Goal: a b c", 1),
        ("拿起方块", "Goal: 拿起方块", 1),
        (" ".join(f"word{n}" for n in range(200)), "Goal: word0 word1 ", 4),
    ],
    ids=["dollars", "control characters", "Chinese", "long"],
)
def test_odd_goals(
    tiny_buffers: Path,
    tmp_path: Path,
    goal: str,
    line: str,
    count: int,
    recwarn: pytest.WarningsRecorder,
) -> None:
    draw_strip(of_lengths(tiny_buffers, [36, 32], goals=(goal,)), tmp_path / "strip.svg")
    ET.parse(tmp_path / "strip.svg")
    lines = labels(tmp_path / "strip.svg")[2 : 2 + count]
    assert lines[0].startswith(line) and (count == 1 or lines[3].endswith(" word199"))
    assert not recwarn.list


# --- bytes -------------------------------------------------------------------------------------


def test_the_users_settings_have_no_effect(buffer: Buffer, strip: Path, tmp_path: Path) -> None:
    import matplotlib

    user = {"font.size": 31, "font.family": "serif", "svg.fonttype": "none", "savefig.dpi": 50}
    with matplotlib.rc_context(user):
        draw_strip(buffer, tmp_path / "strip.svg")
        assert matplotlib.rcParams["font.size"] == 31  # nor are they touched
    assert (tmp_path / "strip.svg").read_bytes() == strip.read_bytes()


# --- refusals ----------------------------------------------------------------------------------


def test_files_that_cannot_be_written(buffer: Buffer, tmp_path: Path) -> None:
    for name in ("strip.gif", "strip", "strip.png.txt"):
        with raises(InvalidOptionError) as caught:
            draw_strip(buffer, tmp_path / name)
        assert str(caught.value.hint).startswith("For example: ")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "strip.png").mkdir()
    (tmp_path / "file").touch()
    for folder in (tmp_path, tmp_path / "file"):
        with raises(InvalidOptionError):
            draw_strip(buffer, folder / "strip.png")
    out = tmp_path / "strip.svg"
    out.write_bytes(b"old")
    with raises(UnknownNameError):
        draw_strip(buffer, out, camera="fornt")
    assert out.read_bytes() == b"old"  # a failure keeps the earlier picture
    assert len(list(tmp_path.iterdir())) == 3
