"""Image encoders: the thumbnail by hand, names, and the folders that encoders are known by."""

from pathlib import Path

import numpy as np
import pytest
from support.messages import raises

from robomme_interference_data.constants import PAPER_ENCODER
from robomme_interference_data.data.index_layout import encoder_id, index_folder
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.retrieval.encoders import encoder_name, published_threshold
from robomme_interference_data.retrieval.encoders.thumbnail import Thumbnail


def test_thumbnail_by_hand() -> None:
    # 16 × 16 pixels, 2 × 2 a cell: upper half black, lower half red.
    image = np.zeros((16, 16, 3), np.uint8)
    image[8:, :, 0] = 255
    encoder = Thumbnail()
    (row,) = encoder.features(encoder.prepare(image[None]))
    colours, right, below = row[:192], row[192:360], row[360:]
    # The image's mean colour is (0.5, 0, 0).
    assert colours.reshape(8, 8, 3)[:, 0].tolist() == [[-0.5, 0, 0]] * 4 + [[0.5, 0, 0]] * 4
    assert not right.any()
    steps = below.reshape(7, 8, 3)
    assert steps[3].tolist() == [[1, 0, 0]] * 8 and steps.sum() == 8
    with raises(InvalidOptionError):
        encoder.prepare(np.zeros((1, 4, 9, 3), np.uint8))


def test_cells_of_uneven_size_are_means() -> None:
    image = np.random.default_rng(0).integers(0, 256, (21, 11, 3), np.uint8)
    (row,) = Thumbnail().prepare(image[None])
    # Cell (2, 7): rows 5 to 6 (42 // 8, 63 // 8 = 7 excluded), columns 9 and 10.
    expected = (image[5:7, 9:11].mean(axis=(0, 1)) - image.mean(axis=(0, 1))) / 255
    assert row[:192].reshape(8, 8, 3)[2, 7] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("encoder", "folder"),
    [
        ("thumbnail", "index/thumbnail"),
        ("siglip", "index/siglip"),
        ("siglip:google/siglip2-base@abc", "index/siglip-siglip2-base"),
        ("siglip:google/siglip-so400m-patch14-384@main", "index/siglip"),
    ],
)
def test_folders(encoder: str, folder: str) -> None:
    assert index_folder(encoder, "front") == folder
    assert index_folder(encoder, "wrist") == f"{folder}@wrist"


def test_a_model_in_a_folder_is_called_by_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "tiny"
    folder.mkdir()
    monkeypatch.chdir(folder)
    for model in (".", "../tiny", str(folder)):
        assert encoder_id(f"siglip:{model}") == "siglip:tiny"
        assert index_folder(f"siglip:{model}", "front") == "index/siglip-tiny"
    assert index_folder("siglip:/", "front") == "index/siglip-"  # not the paper's model
    with raises(InvalidOptionError):
        encoder_id("")


def test_names_of_encoders() -> None:
    assert encoder_name(f"siglip:{PAPER_ENCODER}") == encoder_name("siglip") == "siglip"
    assert published_threshold(f"siglip:{PAPER_ENCODER}") == 0.923
    # At a revision it is the same model, and the revision is kept for loading it.
    assert published_threshold(f"siglip:{PAPER_ENCODER}@main") == 0.923
    assert encoder_name(f"siglip:{PAPER_ENCODER}@main") == f"siglip:{PAPER_ENCODER}@main"
    assert published_threshold("siglip:google/siglip2-base-patch16-224") is None
    assert published_threshold("thumbnail") is None
