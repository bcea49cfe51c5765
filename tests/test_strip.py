"""The film strip: pictures read back, their bytes, and what cannot be drawn."""

import base64
import io
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import factories
import numpy as np
import pytest
from numpy.typing import NDArray
from sample_buffers import QUERY, load, reshaped

from robomme_interference_data.dataset import Dataset
from robomme_interference_data.errors import InvalidOptionError, MissingExtraError, UnknownNameError
from robomme_interference_data.drawing import open_page
from robomme_interference_data.strip import arrange, draw_strip

pytest.importorskip("matplotlib")


def labels(svg: Path) -> list[str]:
    """All texts of the picture; matplotlib notes each in a comment beside its outline."""
    return re.findall(r"<!-- (.*?) -->", svg.read_text(encoding="utf-8"))


def pictures(svg: Path) -> list[NDArray[np.uint8]]:
    from PIL import Image

    found = re.findall(r'href="data:image/png;base64,([^"]*)"', svg.read_text(encoding="utf-8"))
    return [np.asarray(Image.open(io.BytesIO(base64.b64decode(png))))[..., :3] for png in found]


def coarse(image: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Means of 4 × 4 fields: the same for a picture and a smaller one of it."""
    rows = np.array_split(image.astype(float), 4, axis=0)
    return np.array([[f.mean((0, 1)) for f in np.array_split(r, 4, axis=1)] for r in rows])


@pytest.fixture(scope="module")
def strip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("strip") / "strip.svg"
    draw_strip(load(3), out)
    return out


class TestPicture:
    def test_says_what_the_buffer_is(self, strip: Path) -> None:
        found = labels(strip)
        buffer = load(3)
        assert f"{QUERY}   k = 3" in found
        assert f"Goal: {buffer.goal}" in found
        # 36 lesson frames of 132: 36 / (132 / 31) = 8.45, so samples 0 to 8 of 32, 28%.
        share = "an even 32-frame sample holds 28% lesson"
        assert f"132 history frames = 36 lesson + 96 distractor;  {share}" in found
        assert "0  LESSON" in found
        assert "what the robot sees now" in found
        assert found[-2:] == ["132", "first live observation"]
        for number, session in enumerate(buffer.sessions):
            assert session.family in found
            assert str(session.source) in found
            assert number == 0 or f"{number}  distractor" in found

    def test_counts_the_sample_in_each_session(self, strip: Path) -> None:
        found = labels(strip)
        # Of j · 132 // 31 with j = 0 … 31, below 36: j ≤ 8; below 68: j ≤ 15; below 100: j ≤ 23;
        # below 132: j ≤ 30. So 9, 7, 8 and 7 fall into the sessions, and one is live.
        counts = [found[found.index(name) + 1] for name in ("0 lesson", "1", "2", "3")]
        assert counts == ["9", "7", "8", "7"]
        assert "+1 live" in found

    def test_shows_the_right_frames_in_order_and_the_live_one_last(self, strip: Path) -> None:
        buffer = load(3)
        shown = [0, 17, 35, 36, 51, 67, 68, 83, 99, 100, 115, 131]
        found = labels(strip)
        assert [int(text) for text in found if text in map(str, shown[1:])][:11] == shown[1:]
        expected = [buffer.frame(index) for index in shown] + [buffer.query_frame()]
        drawn = [image[::-1] for image in pictures(strip)]  # stored upside down
        assert len(drawn) == len(expected)
        for small, frame in zip(drawn, expected, strict=True):
            assert np.abs(coarse(small) - coarse(frame)).max() < 8

    def test_pixels_of_the_live_observation(self, tmp_path: Path) -> None:
        from PIL import Image

        out = tmp_path / "strip.png"
        draw_strip(load(3), out)
        page = np.asarray(Image.open(out))[..., :3]
        assert page.shape[1] == 7.2 * 180
        # 0.95 inches wide, its right edge 0.1 and its lower edge 0.28 inches from the page's.
        corner = np.array([page.shape[0] - 0.28 * 180, page.shape[1] - 0.1 * 180]).astype(int)
        live = page[corner[0] - 171 : corner[0], corner[1] - 171 : corner[1]]
        frame = load(3).query_frame()
        inner = np.abs(coarse(live) - coarse(frame))[1:3, 1:3]  # the outline covers the rest
        assert inner.max() < 12

    def test_decodes_only_what_it_shows(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        decoded = []
        read_frames = Dataset.read_frames

        def counting(
            self: Dataset, episode: int, camera: str, start: int, out: NDArray[np.uint8]
        ) -> None:
            decoded.append((camera, len(out)))
            read_frames(self, episode, camera, start, out)

        monkeypatch.setattr(Dataset, "read_frames", counting)
        monkeypatch.delattr(Dataset, "iter_frames")
        draw_strip(load(3), tmp_path / "strip.svg", camera="wrist")
        assert decoded == [("observation.images.wrist", 1)] * 13
        assert "wrist camera" in labels(tmp_path / "strip.svg")[1]

    @pytest.mark.parametrize(
        "frames",
        [[36], [1, 1], [1100, *[32] * 7], [25, *[32] * 63], [1100, *[32] * 63]],
        ids=["k0", "tiny", "long", "k63", "long-k63"],
    )
    def test_any_number_of_sessions(self, tmp_path: Path, frames: list[int]) -> None:
        out = tmp_path / "strip.svg"
        buffer = reshaped(load(3), frames)
        draw_strip(buffer, out)
        lengths = [session.stop - session.start for session in buffer.sessions]
        found = labels(out)
        counts = [text for text in found if re.fullmatch(r"\d+ frames?", text)]
        assert counts == [f"{n} frame{'s' * (n > 1)}" for n in lengths]
        for number, session in enumerate(buffer.sessions[1:], 1):
            assert f"{number}  distractor" in found
            assert str(session.source) in found
        assert len(pictures(out)) == 1 + sum(block.frames for block in arrange(lengths)[1])
        view = ET.parse(out).getroot().attrib["viewBox"].split()
        assert float(view[2]) == pytest.approx(7.2 * 72)
        assert float(view[3]) < 16 * 72

    def test_an_empty_history(self, tmp_path: Path) -> None:
        buffer = reshaped(load(3), [], lesson_frames=0, lesson_share=0.0)
        draw_strip(buffer, tmp_path / "strip.svg")
        found = labels(tmp_path / "strip.svg")
        assert "0 history frames;  an even 32-frame sample holds 0% lesson" in found
        assert len(pictures(tmp_path / "strip.svg")) == 1

    @pytest.mark.parametrize(
        ("goal", "line"),
        [
            ("pay $5 and $6", "Goal: pay $5 and $6"),
            ("a\tb\x00\n c", "Goal: a b c"),
            ("拿起方块", "Goal: 拿起方块"),
        ],
    )
    def test_odd_goals(
        self, tmp_path: Path, goal: str, line: str, recwarn: pytest.WarningsRecorder
    ) -> None:
        draw_strip(reshaped(load(1), [36, 32], goals=(goal,)), tmp_path / "strip.svg")
        ET.parse(tmp_path / "strip.svg")
        assert line in labels(tmp_path / "strip.svg")
        assert not recwarn.list

    def test_a_long_goal_takes_four_lines_at_most(self, tmp_path: Path) -> None:
        goal = " ".join(f"word{n}" for n in range(200))
        draw_strip(reshaped(load(1), [36, 32], goals=(goal,)), tmp_path / "strip.svg")
        lines = [text for text in labels(tmp_path / "strip.svg") if "word" in text]
        assert len(lines) == 4
        assert lines[0].startswith("Goal: word0 word1 ")
        assert "…" in lines[3]
        assert lines[3].endswith(" word199")


class TestBytes:
    @pytest.mark.parametrize("suffix", [".png", ".svg"])
    def test_another_process_with_other_settings_writes_the_same(
        self, tmp_path: Path, suffix: str
    ) -> None:
        draw_strip(load(1), tmp_path / f"here{suffix}")
        settings = "font.size: 30\nfont.family: serif\nsvg.fonttype: none\nsavefig.dpi: 50\n"
        (tmp_path / "matplotlibrc").write_text(settings)
        code = (
            "import sys; from pathlib import Path\n"
            "from robomme_interference_data import load_buffer\n"
            "from robomme_interference_data.strip import draw_strip\n"
            f"draw_strip(load_buffer({QUERY!r}, 1, sys.argv[1]), Path(sys.argv[2]))"
        )
        out = tmp_path / f"there{suffix}"
        changed = {"MATPLOTLIBRC": str(tmp_path), "PYTHONHASHSEED": "7", "TZ": "Asia/Tokyo"}
        subprocess.run(
            [sys.executable, "-c", code, str(factories.split()), str(out)],
            check=True,
            env=os.environ | changed,
        )
        assert out.read_bytes() == (tmp_path / f"here{suffix}").read_bytes()

    def test_png_holds_no_date_or_version(self, tmp_path: Path) -> None:
        out = tmp_path / "strip.PNG"
        draw_strip(load(0), out)
        data = out.read_bytes()
        position, kinds = 8, []
        while position < len(data):
            kinds.append(data[position + 4 : position + 8])
            position += 12 + int.from_bytes(data[position : position + 4])
        assert set(kinds) == {b"IHDR", b"pHYs", b"IDAT", b"IEND"}

    def test_svg_holds_no_date_or_version(self, strip: Path) -> None:
        text = strip.read_text(encoding="utf-8")
        assert "<metadata" not in text
        assert "atplotlib" not in text

    def test_leaves_the_settings_of_matplotlib_alone(self, tmp_path: Path) -> None:
        import matplotlib

        with matplotlib.rc_context({"font.size": 31}):
            draw_strip(load(0), tmp_path / "strip.svg")
            assert matplotlib.rcParams["font.size"] == 31


class TestErrors:
    @pytest.mark.parametrize("name", ["strip.jpg", "strip", "strip.png.gz"])
    def test_other_suffixes(self, tmp_path: Path, name: str) -> None:
        with pytest.raises(InvalidOptionError, match=r"ends in \.png or \.svg") as caught:
            draw_strip(load(0), tmp_path / name)
        assert caught.value.hint is not None
        assert caught.value.hint.startswith("For example: ")
        assert list(tmp_path.iterdir()) == []

    def test_a_folder(self, tmp_path: Path) -> None:
        (tmp_path / "strip.png").mkdir()
        with pytest.raises(InvalidOptionError, match="is a folder"):
            draw_strip(load(0), tmp_path / "strip.png")

    def test_a_place_that_cannot_be_written(self, tmp_path: Path) -> None:
        (tmp_path / "file").touch()
        with pytest.raises(InvalidOptionError, match=r"strip\.png cannot be written: "):
            draw_strip(load(0), tmp_path / "file" / "strip.png")

    def test_without_matplotlib(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        for name in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
            monkeypatch.delitem(sys.modules, name)
        monkeypatch.setitem(sys.modules, "matplotlib", None)
        with pytest.raises(MissingExtraError) as caught:
            draw_strip(load(0), tmp_path / "strip.png")
        assert caught.value.hint == ('Install it: pip install "robomme-interference-data[score]"')
        assert list(tmp_path.iterdir()) == []

    def test_a_failure_keeps_the_old_picture(self, tmp_path: Path) -> None:
        out = tmp_path / "strip.png"
        out.write_bytes(b"old")
        with pytest.raises(UnknownNameError, match="camera 'fornt'"):
            draw_strip(load(0), out, camera="fornt")
        assert out.read_bytes() == b"old"
        assert [path.name for path in tmp_path.iterdir()] == ["strip.png"]


def test_text_that_is_too_wide_shrinks_and_then_loses_its_middle(tmp_path: Path) -> None:
    with open_page(tmp_path / "page.svg", 2) as page:
        page.height = 1
        page.text(0, 0, "fits", 8, width=1)
        wide = page.text_width("a little too wide", 8)
        page.text(0, 0.2, "a little too wide", 8, width=0.9 * wide)
        page.text(0, 0.4, "much too wide for this", 8, width=0.5)
        small = page.axes.texts[1]
        assert small.get_size() == pytest.approx(7.2)
        shortened = page.axes.texts[2].get_text()
        assert page.text_width(shortened, 6) <= 0.5
    assert labels(tmp_path / "page.svg") == ["fits", "a little too wide", shortened]
    start, end = shortened.split("…")
    assert start
    assert end
    assert "much too wide for this".startswith(start)
    assert "much too wide for this".endswith(end)
