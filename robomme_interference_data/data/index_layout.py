"""What an index of embeddings is on disk: its folder, its files and its header.

Every episode has its own file (`docs/reference/file-layout.md`). `embeddings.py` reads them.
"""

import re
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

from robomme_interference_data.constants import (
    CAMERA_PREFIX,
    INDEX_DIR,
    INDEX_HEADER,
    PAPER_ENCODER,
)
from robomme_interference_data.errors import FormatError, InvalidOptionError
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.storage.text import digest_json, read_header

from .dataset import Dataset

CENTER_FILE = "center.npy"
INDEX_SUMS = "SHA256SUMS"

_MAX_SIZE = 1 << 14
"""Most values in an embedding, which a held frame repeats in a buffer; SigLIP has 1152."""


@dataclass(frozen=True)
class EncoderRecord:
    """What an index records about its encoder.

    Attributes:
        name: As `encoder_id` returns it.
        fingerprint: Everything that determines the features: model, weights, preprocessing, code.
        sha256: Digest of the fingerprint; only embeddings with the same digest are compared.
    """

    name: str
    fingerprint: dict[str, Any]
    sha256: str


@dataclass(frozen=True)
class IndexHeader:
    """`index.json`, written last: without it there is no index.

    Attributes:
        format_version: Version of the file format.
        encoder: The encoder.
        computed: Device, precision and batch size, which may change the last bits.
        camera: Name of the embedded camera.
        revision: Revision of the dataset.
        frames: Number of frames.
        size: Values per frame.
        typical_cosine: For distractor units, the median cosine of two frames of different units,
            centered if the encoder is; None for other datasets.
        sums: SHA-256 of `SHA256SUMS`, which lists the other files.
        sha256: SHA-256 of the canonical JSON of all other fields.
    """

    format_version: int
    encoder: EncoderRecord
    computed: dict[str, Any]
    camera: str
    revision: str
    frames: int
    size: int
    typical_cosine: float | None
    sums: str
    sha256: str = ""

    def __post_init__(self) -> None:
        if not 0 < self.size <= _MAX_SIZE:
            raise FormatError(f"size {self.size}; expected 1 to {_MAX_SIZE}")

    def digest(self) -> str:
        """Return the correct value of `sha256`."""
        return digest_json([{k: value for k, value in to_dict(self).items() if k != "sha256"}])


def episode_file(episode_index: int) -> str:
    """Return the path of an episode's features inside an index folder."""
    return f"chunk-{episode_index // 1000:03d}/episode-{episode_index:06d}.npy"


def encoder_id(encoder: str) -> str:
    """Return an encoder's name without the revision and the folder of its model.

    `siglip:google/siglip2-base-patch16-224@main` keeps its id, `siglip:/models/my-siglip` (an
    existing folder) becomes `siglip:my-siglip`, and the paper's model is `siglip`.
    """
    kind, _, model = encoder.partition(":")
    if not kind:
        raise InvalidOptionError.expected("encoder", encoder, "thumbnail, siglip or siglip:ID")
    if not model:
        return kind
    if Path(model).is_dir():
        return f"{kind}:{Path(model).resolve().name}"
    # A revision names a version of the weights, whose digest the header records.
    model = model.partition("@")[0]
    return kind if model == PAPER_ENCODER else f"{kind}:{model}"


def index_folder(encoder: str, camera: str) -> str:
    """Return the folder of an index inside a dataset, such as `index/thumbnail@wrist`.

    Of a model's id, only the last part is used: `index/siglip-siglip2-base-patch16-224`.
    """
    kind, colon, model = encoder_id(encoder).partition(":")
    name = f"{kind}-{PurePath(model).name}" if colon else kind
    camera = camera.removeprefix(CAMERA_PREFIX)
    # The benchmark's own camera needs no name.
    parts = [name] if camera == "front" else [name, camera]
    return f"{INDEX_DIR}/{'@'.join(re.sub(r'[^A-Za-z0-9._-]+', '-', part) for part in parts)}"


def indexed_encoders(dataset: Dataset, camera: str) -> list[str]:
    """Return the names of the encoders of which a dataset has embeddings of a camera, sorted."""
    names = []
    for path in dataset.files.list(INDEX_DIR, INDEX_HEADER):
        header = read_header(dataset.files.path(path), IndexHeader)
        # An index that is being made is in a hidden folder.
        if header.camera == camera and path.startswith(index_folder(header.encoder.name, camera)):
            names.append(header.encoder.name)
    return sorted(names)
