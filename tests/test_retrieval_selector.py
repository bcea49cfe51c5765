"""The selector of rollouts: what it chooses of a buffer, and what identifies it."""

from pathlib import Path

import pytest
import retrieval_indexes
from retrieval_indexes import EPISODE, make_index

from robomme_interference_data import load_buffer, load_split
from robomme_interference_data.errors import InvalidOptionError, UnknownNameError
from robomme_interference_data.retrieval.encoders import make_encoder
from robomme_interference_data.retrieval.segment import adaptive_threshold
from robomme_interference_data.retrieval.select import Rule
from robomme_interference_data.retrieval.selector import Selector, select

split = retrieval_indexes.split  # the fixture


def test_the_selector(split: Path) -> None:
    make_index(split)
    selector = Selector("thumbnail")
    assert (selector.name, selector.camera) == ("thumbnail/max/adaptive", "front")
    assert Selector("thumbnail", rule="mean/0.9").name == "thumbnail/mean/0.9"
    for buffer in load_split(split).buffers(k=3):
        index = buffer.query_index("thumbnail")
        assert selector.rule.threshold(index.typical_cosine) == adaptive_threshold(
            index.typical_cosine
        )
        chosen = selector.select(buffer, buffer.query_frame())
        stored = select(buffer, "thumbnail", selector.rule)
        assert (chosen.start, chosen.stop) == (stored.start, stored.stop)
        # An even sample of the span with the live observation as the last of its frames.
        roles = [*buffer.session_index[chosen.start : chosen.stop], -1]
        count = min(len(roles), 32)
        sample = [roles[j * (len(roles) - 1) // (count - 1)] for j in range(count)]
        assert chosen.lesson_fraction == sample.count(0) / count
        assert chosen.filler_fraction == sum(role > 0 for role in sample) / count
        assert chosen.query_fraction == 1 / count
    whole = select(load_buffer(EPISODE, 1, split), "thumbnail", Rule(cut=-1.0))
    # One segment of 52 frames; j · 52 // 31 is below 20 for j = 0 … 11, 52 for j = 31.
    assert (whole.start, whole.stop) == (0, 52)
    assert whole.lesson_fraction == 12 / 32
    assert (whole.filler_fraction, whole.query_fraction) == (19 / 32, 1 / 32)


def test_what_identifies_a_selector(split: Path) -> None:
    make_index(split)
    buffer = load_buffer(EPISODE, 1, split)
    index = buffer.query_index("thumbnail")
    assert Selector("thumbnail").identity(buffer) == {
        "encoder": "thumbnail",
        "fingerprint": index.fingerprint,
        "camera": "front",
        "method": "max",
        "cut": "adaptive",
        "threshold": (1 + index.typical_cosine) / 2,
    }
    fixed = Selector("thumbnail", rule="mean/0.5").identity(buffer)
    assert (fixed["method"], fixed["cut"], fixed["threshold"]) == ("mean", 0.5, 0.5)


def test_the_selector_refuses() -> None:
    for rule, error in (
        ("top32", InvalidOptionError),
        ("best", UnknownNameError),
        ("max/2.0", InvalidOptionError),
    ):
        with pytest.raises(error):
            Selector("thumbnail", rule=rule)
    with pytest.raises(UnknownNameError, match="'thumbnial'"):
        Selector("thumbnial")
    with pytest.raises(InvalidOptionError, match="no models"):
        make_encoder("thumbnail:x")
