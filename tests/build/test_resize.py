"""Frames that are resized while they are stored: exact values, aspect ratios, and the record."""

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from support.made_up import MadeUpSource, picture
from support.messages import raises

from robomme_interference_data.build_dataset.config import BuildConfig
from robomme_interference_data.build_dataset.dataset.build import build_dataset
from robomme_interference_data.build_dataset.dataset.plan import DatasetPlan, PlannedEpisode
from robomme_interference_data.build_dataset.dataset.resize import Resize
from robomme_interference_data.build_dataset.dataset.stage import StageTask
from robomme_interference_data.build_dataset.dataset.staged import staged_name
from robomme_interference_data.build_dataset.plan.datasets import plan_dataset
from robomme_interference_data.constants import DISTRACTORS, FRONT, Unit
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.errors import BuildError, InvalidOptionError, SourceError
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.storage.files import LocalFiles
from robomme_interference_data.storage.resize import resize_image

SIDES = st.integers(1, 12)
IMAGES = st.tuples(SIDES, SIDES).flatmap(lambda sides: arrays(np.uint8, (*sides, 3)))


def gray(rows: list[list[int]]) -> NDArray[np.uint8]:
    return np.array(rows, np.uint8)[..., None].repeat(3, 2)


def test_means_of_areas_by_hand() -> None:
    # 4 columns to 3: (3 · 0 + 10) / 4 = 2.5, (2 · 10 + 2 · 20) / 4 = 15, (20 + 3 · 30) / 4 = 27.5;
    # halves go to the even neighbor.
    assert resize_image(gray([[0, 10, 20, 30]]), 3, 1)[..., 0].tolist() == [[2, 15, 28]]
    # Both axes: the mean of 2 × 2 pixels, (1 + 2 + 3 + 4) / 4 = 2.5, (255 · 3 + 254) / 4 = 254.75.
    image = gray([[1, 2, 255, 255], [3, 4, 255, 254]])
    assert resize_image(image, 2, 1)[..., 0].tolist() == [[2, 255]]
    # 2 columns to 3: the middle one is half of each.
    assert resize_image(gray([[10, 40]]), 3, 2)[..., 0].tolist() == [[10, 25, 40]] * 2


@given(IMAGES, SIDES, SIDES)
def test_each_pixel_is_the_exact_mean(image: NDArray[np.uint8], width: int, height: int) -> None:
    resized = resize_image(image, width, height)
    assert resized.shape == (height, width, 3) and resized.dtype == np.uint8

    def share(place: int, size: int, pixel: int, given_size: int) -> Fraction:
        """The part of an area that a pixel covers."""
        start, stop = Fraction(place * given_size, size), Fraction((place + 1) * given_size, size)
        inside = min(stop, Fraction(pixel + 1)) - max(start, Fraction(pixel))
        return max(inside, Fraction(0)) / (stop - start)

    rows, columns, _ = image.shape
    row, column = height // 2, width - 1
    mean = sum(
        (
            share(row, height, y, rows) * share(column, width, x, columns) * int(image[y, x, 1])
            for y in range(rows)
            for x in range(columns)
        ),
        Fraction(0),
    )
    assert resized[row, column, 1] == round(mean)  # Python rounds halves to even, too


@given(IMAGES, SIDES, SIDES, st.sampled_from(["crop", "pad"]))
def test_any_frame_fits(image: NDArray[np.uint8], width: int, height: int, mode: str) -> None:
    resize = Resize(width, height, mode)
    made = resize.apply(image)
    assert made.shape == (height, width, 3) and made.flags.c_contiguous
    assert Resize.parse(str(resize)) == resize
    np.testing.assert_array_equal(resize.apply(image.copy()), made)
    if image.shape[0] * width == image.shape[1] * height:
        np.testing.assert_array_equal(made, Resize(width, height).apply(image))
    if len({*image.ravel().tolist()}) == 1 and mode == "crop":
        assert (made == image.flat[0]).all()


def test_crop_and_pad_by_hand() -> None:
    image = gray([[10, 20, 30, 40], [10, 20, 30, 40]])  # 4x2
    # 2x2: at the height of 2 it stays 4 wide; of the columns 0 to 3 the middle ones remain.
    assert Resize(2, 2, "crop").apply(image)[..., 0].tolist() == [[20, 30]] * 2
    # At the width of 2 it is 1 high: (2 · 10 + 2 · 20) / 4 = 15 and 35, then a black row.
    assert Resize(2, 2, "pad").apply(image)[..., 0].tolist() == [[15, 35], [0, 0]]
    # 640x480 to 256x256: 256x192 between 32 black rows; or 341x256 without 42 and 43 columns.
    large = np.full((480, 640, 3), 7, np.uint8)
    large[:, 0] = large[:, -1] = 255
    padded = Resize(256, 256, "pad").apply(large)
    assert (padded[:32] == 0).all() and (padded[224:] == 0).all() and (padded[32:224] > 0).all()
    assert (Resize(256, 256, "crop").apply(large) == 7).all()
    assert Resize(320, 240).apply(large).shape == (240, 320, 3)
    tall = large.transpose(1, 0, 2)
    padded = Resize(256, 256, "pad").apply(tall)
    assert (padded[:, :32] == 0).all() and (padded[:, 32:224] > 0).all()
    same = gray([[1, 2]])
    assert Resize(2, 1).apply(same) is same


def test_another_aspect_ratio_needs_a_mode() -> None:
    with raises(InvalidOptionError) as caught:
        Resize(256, 256).apply(np.zeros((480, 640, 3), np.uint8))
    assert caught.value.option == "resize"
    assert {"256x256:crop", "256x256:pad"} <= {*str(caught.value.hint).replace(",", "").split()}


@pytest.mark.parametrize(
    "text", ["256", "0x8", "256x256:fit", "256x-1", "256X256", "10000x1", "", "256x256:"]
)
def test_sizes_that_are_none(text: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidOptionError) as caught:
        plan_dataset(DISTRACTORS, BuildConfig(source=("sample",), buffer_set=tmp_path, resize=text))
    assert caught.value.option == "resize"


def test_no_cameras_have_no_size(tmp_path: Path) -> None:
    config = BuildConfig(source=("sample",), buffer_set=tmp_path, resize="8x8", cameras=("none",))
    with raises(InvalidOptionError) as caught:
        plan_dataset(DISTRACTORS, config)
    assert caught.value.option == "resize"


# --- a dataset; the frames of these sources have 24x16 pixels ---------------------------------

LENGTHS: dict[str, Any] = {f"{family}/train/0": (11, None) for family in ("Lift", "Stack")}


def plan(source: MadeUpSource, resize: str | None) -> DatasetPlan:
    return DatasetPlan(
        DISTRACTORS,
        (source,),
        tuple(PlannedEpisode(0, episode) for episode in source.episodes()),
        unit=Unit(4, 3),
        resize=None if resize is None else Resize.parse(resize),
    )


def build(root: Path, resize: str | None, lengths: dict[str, Any] = LENGTHS) -> Dataset:
    made = plan(MadeUpSource(lengths), resize)
    build_dataset(made, root, Serial(), WorkProgress(quiet=True))
    return Dataset(LocalFiles(root))


def test_a_resized_dataset_states_it(tmp_path: Path) -> None:
    dataset = build(tmp_path / "units", "8x8:pad")
    assert dataset.identity.sources == ({"kind": "made-up", "resize": "8x8:pad"},)
    assert not dataset.identity.exact
    assert [record.exact for record in dataset.records()] == [False, False]
    assert dataset.features[FRONT] == (8, 8, 3)
    stored = np.stack(list(dataset.iter_frames(0, None, 0, 4)))
    raw = [picture("Lift/train/0 front", number) for number in (0, 3, 6, 9)]
    expected = [Resize(8, 8, "pad").apply(image) for image in raw]
    np.testing.assert_array_equal(stored, expected)  # the codec itself is exact
    assert (stored[:, :1] == 0).all() and stored[:, 1:6].any()
    again = build(tmp_path / "again", "8x8:pad")
    assert again.revision == dataset.revision


def test_frames_of_that_size_are_exact(tmp_path: Path) -> None:
    dataset = build(tmp_path / "units", "24x16")
    assert dataset.identity.exact
    assert dataset.identity.sources == ({"kind": "made-up", "resize": "24x16"},)


def test_a_dataset_is_extended_with_the_same_size_only(tmp_path: Path) -> None:
    build(tmp_path, "8x8:pad")
    more = LENGTHS | {"Lift/train/1": (11, None)}
    for other in ("8x8:crop", None):
        with raises(BuildError) as caught:
            build(tmp_path, other, more)
        assert 'resize="8x8:pad"' in str(caught.value.hint)
    assert len(build(tmp_path, "8x8:pad", more)) == 3


def test_resized_frames_are_staged_apart() -> None:
    source = MadeUpSource(LENGTHS)
    names = {
        staged_name(made, made.episodes[0])
        for made in (plan(source, size) for size in (None, "8x8:pad", "8x8:crop", "24x16"))
    }
    assert len(names) == 4


def test_an_aspect_ratio_without_a_mode_ends_the_build(tmp_path: Path) -> None:
    with raises(InvalidOptionError) as caught:
        build(tmp_path / "units", "8x8")
    assert caught.value.option == "resize" and not (tmp_path / "units").exists()


def test_frames_that_change_their_size_are_an_error_in_any_size() -> None:
    [name] = lengths = {"Lift/train/0": (11, None)}
    source = MadeUpSource(lengths)
    frame = source.frame(name, 3, None)
    source.wrong = {
        name: {
            3: frame.__class__(
                {"front": frame.images["front"][::2, ::2]}, frame.state, frame.action, None
            )
        }
    }
    made = plan(source, "12x8")
    [outcome] = Serial().run(StageTask(made), made.episodes)
    assert isinstance(outcome.error, SourceError)
