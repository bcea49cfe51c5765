"""The selector of rollouts: what it chooses of a buffer, and what identifies it."""

from pathlib import Path

import numpy as np
import pytest
from support.buffer_sets import QUERIES
from support.messages import raises

from robomme_interference_data import load_buffer, load_buffer_set
from robomme_interference_data.errors import InvalidOptionError, MissingFileError
from robomme_interference_data.retrieval.measure import measure
from robomme_interference_data.retrieval.select import choose
from robomme_interference_data.retrieval.selector import Selector
from robomme_interference_data.retrieval.stored_selector import StoredSelector


def test_it_chooses_what_stored_embeddings_choose(indexed: Path) -> None:
    selector = Selector("thumbnail")
    for buffer in load_buffer_set(indexed).buffers(condition="k3"):
        assert selector.label(buffer.query.dataset) == "thumbnail/max/adaptive"
        for step in (Selector, StoredSelector):
            assert (
                step("thumbnail", rule="mean/0.9").label(buffer.query.dataset)
                == "thumbnail/mean/0.9"
            )
        stored = choose(measure(buffer, "thumbnail"), selector.rule)
        assert selector.select(buffer, buffer.query.frame()).tolist() == stored.frames.tolist()
        chosen = StoredSelector("thumbnail").select(load_buffer_set(indexed), buffer)
        assert chosen.tolist() == stored.frames.tolist()


def test_what_identifies_a_selector(indexed: Path) -> None:
    for condition in ("no-history", "k1"):  # any buffer of the buffer set will do
        buffer = load_buffer(QUERIES[0], condition, buffer_set=indexed)
        index = buffer.index("thumbnail")
        assert Selector("thumbnail").identity(buffer) == {
            "encoder": "thumbnail",
            "fingerprint": index.units.header.encoder.sha256,
            "camera": "front",
            "method": "max",
            "number": "adaptive",
            "cosine": (1 + index.units.typical_cosine) / 2,
        }
    fixed = Selector("thumbnail", rule="mean/0.5").identity(buffer)
    assert (fixed["method"], fixed["number"], fixed["cosine"]) == ("mean", 0.5, 0.5)


def test_what_it_cannot_choose_from(indexed: Path, tiny_buffers: Path) -> None:
    selector = Selector("thumbnail")
    buffer = load_buffer(QUERIES[0], "k0", buffer_set=indexed)
    for image in (np.zeros((3, 32, 32), np.uint8), np.zeros((32, 32, 3), np.float32)):
        with raises(InvalidOptionError):
            selector.select(buffer, image)  # type: ignore[arg-type]
    bare = load_buffer(QUERIES[0], "k0", buffer_set=tiny_buffers)
    with pytest.raises(MissingFileError):
        selector.select(bare, bare.query.frame())
