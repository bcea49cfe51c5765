"""The layout of the film strip, worked out by hand: samples, frames, places and colours."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sample_buffers import QUERY, load, reshaped

from robomme_interference_data.draw import even_sample, lesson_share
from robomme_interference_data.errors import UnknownNameError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.drawing import ink_on, tint
from robomme_interference_data.sessions import Session
from robomme_interference_data.strip import (
    COLORS,
    LESSON_COLOR,
    Block,
    arrange,
    session_colors,
    shown_frames,
)

pytest.importorskip("matplotlib")


class TestEvenSample:
    def test_by_hand(self) -> None:
        # linspace(0, 62, 32) is 0, 2, 4, …, 62.
        assert even_sample(62) == list(range(0, 63, 2))
        # 5 frames and 3 samples: 0, floor(5 / 2), 5.
        assert even_sample(5, 3) == [0, 2, 5]

    def test_fewer_frames_than_samples_are_all_taken(self) -> None:
        assert even_sample(30) == list(range(31))
        assert even_sample(0) == [0]

    @given(st.integers(0, 2000), st.integers(0, 2000))
    def test_holds_the_lesson_share_of_the_manifest(self, lesson: int, others: int) -> None:
        sample = even_sample(lesson + others)
        inside = sum(index < lesson for index in sample)
        assert inside / len(sample) == lesson_share(lesson, lesson + others)


class TestShownFrames:
    @pytest.mark.parametrize(
        ("start", "stop", "count", "expected"),
        [
            (0, 48, 4, [0, 15, 31, 47]),
            (48, 80, 3, [48, 63, 79]),
            (5, 8, 4, [5, 6, 7]),
            (5, 6, 4, [5]),
            (5, 9, 1, [5]),
        ],
    )
    def test_by_hand(self, start: int, stop: int, count: int, expected: list[int]) -> None:
        assert shown_frames(start, stop, count) == expected

    @given(st.integers(0, 5000), st.integers(1, 2000), st.integers(2, 12))
    def test_even_and_from_the_first_to_the_last(self, start: int, n: int, count: int) -> None:
        shown = shown_frames(start, start + n, count)
        assert len(shown) == min(count, n)
        assert shown[0] == start
        assert shown[-1] == start + (n - 1 if len(shown) > 1 else 0)
        steps = np.diff(shown)
        assert len(steps) == 0 or 1 <= steps.min() >= steps.max() - 1


class TestArrange:
    def test_a_lone_lesson_takes_the_row(self) -> None:
        assert arrange([48]) == (3, [Block(0, 0, 3, 12)])
        assert arrange([5]) == (3, [Block(0, 0, 3, 5)])

    def test_four_short_sessions_share_a_row(self) -> None:
        assert arrange([48, 32, 32, 32]) == (4, [Block(0, n, 1, 3) for n in range(4)])

    def test_a_long_lesson_takes_a_row(self) -> None:
        units = [Block(1, n, 1, 4) for n in range(3)]
        assert arrange([257, 32, 32, 32]) == (3, [Block(0, 0, 3, 12), *units])

    def test_a_long_lesson_gives_way_where_that_saves_a_row(self) -> None:
        assert arrange([1077, 32]) == (3, [Block(0, 0, 2, 8), Block(0, 2, 1, 4)])

    def test_no_sessions(self) -> None:
        assert arrange([])[1] == []

    @given(st.lists(st.integers(1, 3000), min_size=1, max_size=64))
    def test_every_session_has_a_place_of_its_own(self, frames: list[int]) -> None:
        slots, blocks = arrange(frames)
        assert len(blocks) == len(frames)
        places = [(b.row, b.slot + n) for b in blocks for n in range(b.slots)]
        assert places == sorted(set(places))
        assert {row for row, _ in places} == set(range(blocks[-1].row + 1))
        assert max(slot for _, slot in places) < slots
        for block, count in zip(blocks, frames, strict=True):
            assert block.frames == min(count, block.slots * 12 // slots)


class TestColors:
    @staticmethod
    def sessions(*families: str) -> list[Session]:
        entry = load(0).sessions[0].entry
        roles = ["lesson"] + ["distractor"] * (len(families) - 1)
        return [
            Session(role, family, EpisodeId(family, "train", 0), 0, 1, entry)
            for role, family in zip(roles, families, strict=True)
        ]

    def test_by_family_in_order_of_appearance(self) -> None:
        sessions = self.sessions("MoveCube", "InsertPeg", "RouteStick", "InsertPeg")
        assert session_colors(sessions) == [LESSON_COLOR, COLORS[0], COLORS[1], COLORS[0]]

    def test_nine_families_differ_and_a_tenth_starts_over(self) -> None:
        colors = session_colors(self.sessions(*"ABCDEFGHIJ"))
        assert len(set(colors[:9])) == 9
        assert colors[9] == colors[1]

    @pytest.mark.parametrize("color", [LESSON_COLOR, *COLORS])
    def test_text_on_a_color_has_the_contrast_of_wcag_aa(self, color: str) -> None:
        def luminance(rgb: str) -> float:
            values = [int(rgb[i : i + 2], 16) / 255 for i in (1, 3, 5)]
            r, g, b = (v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in values)
            return 0.2126 * r + 0.7152 * g + 0.0722 * b

        ink = {"black": "#000000", "white": "#ffffff"}[ink_on(color)]
        dark, light = sorted((luminance(color), luminance(ink)))
        assert (light + 0.05) / (dark + 0.05) >= 4.5

    def test_tint(self) -> None:
        # 255 · (1 − 0.5 · (1 − 0)) = 127.5 and 255 · (1 − 0.5 · (1 − 1)) = 255.
        assert tint("#00ff00", 0.5) == "#80ff80"


class TestFrame:
    def test_is_that_of_the_whole_buffer(self) -> None:
        buffer = reshaped(load(3), [5, 32, 64, 7])  # the third session holds each frame twice
        frames = buffer.frames()
        for index in (0, 4, 5, 36, 37, 38, 39, 100, 101, 107):
            np.testing.assert_array_equal(buffer.frame(index), frames[index])

    @pytest.mark.parametrize("index", [-1, 132])
    def test_outside_the_buffer(self, index: int) -> None:
        message = f"frame {index} is not in the buffer of {QUERY} at k=3, which has 132 history"
        with pytest.raises(UnknownNameError, match=message):
            load(3).frame(index)
