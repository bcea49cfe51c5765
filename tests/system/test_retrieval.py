"""Retrieval for real: worker processes that embed, and `thumbnail` on RoboMME's own lessons."""

import shutil
from pathlib import Path

import av
import numpy as np
import pytest
from numpy.typing import NDArray
from support.retrieval import QUIET, embedded, files_of

from robomme_interference_data.data.embeddings import normalized
from robomme_interference_data.retrieval.encoders.thumbnail import Thumbnail
from robomme_interference_data.retrieval.index import build_index
from robomme_interference_data.retrieval.segment import typical_cosine
from robomme_interference_data.retrieval.select import Rule, choose
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.runtime.process import Processes

pytestmark = pytest.mark.slow

Features = dict[str, NDArray[np.float32]]


def test_worker_processes_give_the_same_bytes(tiny_buffers: Path, tmp_path: Path) -> None:
    for name, executor in (("a", Serial()), ("b", Processes(2))):
        units = shutil.copytree(tiny_buffers / "distractors", tmp_path / name / "distractors")
        build_index([units], Thumbnail(), QUIET, executor=executor)
    assert files_of(tmp_path / "a") == files_of(tmp_path / "b")


@pytest.fixture(scope="module")
def episodes(shared_data: Path) -> Features:
    """Features of the nine episodes by family; the last of each is the first live observation."""
    features = {}
    for path in sorted((shared_data / "lessons").glob("*_front.mkv")):
        parts = []
        with av.open(str(path)) as container:
            for frame in container.decode(video=0):
                parts.append(Thumbnail().prepare(frame.to_ndarray(format="rgb24")[None]))
        features[path.name.partition("_")[0]] = np.concatenate(parts)
    assert len(features) == 9
    return features


def test_the_lesson_is_chosen_among_eight_sessions(episodes: Features) -> None:
    # Without true boundaries; center and adaptive cut come from the other families' units.
    purities, coverages = [], []
    for family, own in episodes.items():
        # What a distractor unit keeps of a lesson; each weighs the same in the mean.
        pool = [other[:-1][:256:8] for name, other in episodes.items() if name != family]
        means = [one.mean(axis=0, dtype=np.float64) for one in pool]
        center = np.mean(means, axis=0).astype(np.float32)
        units = [normalized(one, center) for one in pool]
        typical = typical_cosine(len(units), units.__getitem__)
        rows = normalized(own, center)
        lesson, units = rows[:-1], units[:7]
        history = np.concatenate([lesson, *units])
        rule = Rule("max", Rule("max").cosine(typical))
        ((start, stop),) = choose(embedded(history, rows[-1]), rule).spans
        shared = max(0, min(stop, len(lesson)) - start)
        purities.append(shared / (stop - start))
        coverages.append(shared / len(lesson))
        assert purities[-1] > 0.5, family
    # The pass mark of the released reference is 0.9 for both means.
    assert np.mean(purities) >= 0.9
    assert np.mean(coverages) >= 0.9
