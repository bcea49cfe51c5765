"""Check the frames of an episode: what is stored, every reader must accept. Pure rules."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.build_dataset.alike import Look, differences
from robomme_interference_data.build_dataset.sources.base import CAMERA_NAMES, is_camera_name
from robomme_interference_data.constants import CAMERA_PREFIX, STATE
from robomme_interference_data.errors import InvalidOptionError, SourceError, named
from robomme_interference_data.storage.limits import MAX_PIXELS, MAX_VECTOR


def check_image(feature: str, image: NDArray[np.uint8]) -> None:
    """Check that the image of a camera is an RGB image.

    Raises:
        SourceError: It is not.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise SourceError(
            f"{feature} holds images {image.shape} {image.dtype}; expected (H, W, 3) uint8",
            "Convert the images to RGB with 8 bits a channel.",
        )


def check_shapes(
    images: Mapping[str, NDArray[np.uint8]], vectors: Mapping[str, NDArray[np.float32]]
) -> None:
    """Check names and shapes of an episode's first frame, which the others must have, too.

    Args:
        images: Features of cameras to their images.
        vectors: State and action; the state has no values if none are recorded.

    Raises:
        SourceError: A camera's name, or the shape of a value, cannot be stored.
        InvalidOptionError: There is nothing to store.
    """
    for feature, image in images.items():
        _check_camera(feature.removeprefix(CAMERA_PREFIX))
        check_image(feature, image)
        height, width, _ = image.shape
        if height * width > MAX_PIXELS:
            raise SourceError(
                f"{feature} has images of {width} × {height} pixels; expected at most "
                f"{MAX_PIXELS:,} pixels",
                "Scale the images down.",
            )
    for feature, vector in vectors.items():
        least = 0 if feature == STATE else 1
        if vector.ndim != 1 or not least <= vector.size <= MAX_VECTOR:
            raise SourceError(
                f"{feature} has the shape {vector.shape}; expected one row of 1 to "
                f"{MAX_VECTOR:,} values",
                "Flatten it, or record fewer values.",
            )
    if not images and not any(vector.size for vector in vectors.values()):
        raise InvalidOptionError(
            "there is nothing to store: the recording has no states, and no camera is chosen",
            f"Choose {named('cameras')}.",
            option="cameras",
        )


def check_same_shapes(
    shapes: Mapping[str, tuple[int, ...]], first: Mapping[str, tuple[int, ...]], frame: str
) -> None:
    """Check that a frame has the shapes of the first one.

    Args:
        shapes: Features to the shapes of their values.
        first: Those of the first frame.
        frame: The frame for messages, such as `stored frame 7`.

    Raises:
        SourceError: It has others.
    """
    if shapes != first:
        # Only of episodes, rates differ.
        found = differences(("the first", Look(first, 1.0)), (frame, Look(shapes, 1.0)))
        raise SourceError(
            f"frames of different sizes: {'; '.join(found)}",
            "All frames of an episode must have the same cameras and sizes.",
        )


def check_numbers(feature: str, value: NDArray[np.float32], frame: str) -> None:
    """Check that the values of a vector are finite; `frame` is the frame for messages.

    Raises:
        SourceError: They are not, or of another type.
    """
    if value.dtype != np.float32 or not np.isfinite(value).all():
        raise SourceError(
            f"{feature} of {frame} is {value.tolist()}; expected finite float32 numbers",
            "Correct the recording, or leave it out of the source. "
            f"{named('episodes')} chooses indices in all families alike.",
        )


def _check_camera(name: str) -> None:
    if not is_camera_name(name):
        raise SourceError(
            f"the camera {name[:300]!r}; expected a name of {CAMERA_NAMES}",
            "Rename the camera in the recordings.",
        )
