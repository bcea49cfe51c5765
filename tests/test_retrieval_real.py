"""`thumbnail` on RoboMME's own lessons: the first test episode of each of the nine families."""

from pathlib import Path

import av
import numpy as np
import pytest
from numpy.typing import NDArray

from robomme_interference_data.embeddings import normalised
from robomme_interference_data.retrieval.encoders.thumbnail import Thumbnail
from robomme_interference_data.retrieval.segment import adaptive_threshold, typical_cosine
from robomme_interference_data.retrieval.select import choose

Episodes = dict[str, NDArray[np.float16]]


@pytest.fixture(scope="module")
def episodes(shared_data: Path) -> Episodes:
    """Embeddings of the nine episodes by family; the last of each is the first live observation."""
    features = {}
    for path in sorted((shared_data / "lessons").glob("*_front.mkv")):
        parts = []
        with av.open(str(path)) as container:
            for frame in container.decode(video=0):
                parts.append(Thumbnail().prepare(frame.to_ndarray(format="rgb24")[None]))
        features[path.name.partition("_")[0]] = np.concatenate(parts)
    assert len(features) == 9
    centre = np.concatenate(list(features.values())).mean(axis=0, dtype=np.float64)
    return {name: normalised(rows, centre.astype(np.float32)) for name, rows in features.items()}


def test_the_right_lessons_nearest_frame_is_nearest(episodes: Episodes) -> None:
    for family, rows in episodes.items():
        query = rows[-1].astype(np.float32)
        nearest = {n: float((r[:-1].astype(np.float32) @ query).max()) for n, r in episodes.items()}
        assert max(nearest, key=lambda name: nearest[name]) == family, nearest


def test_the_lesson_is_chosen_among_eight_sessions(episodes: Episodes) -> None:
    # Without true boundaries: the cut is halfway between any two frames and equal ones.
    typical = typical_cosine(np.concatenate(list(episodes.values())))
    purities, coverages = [], []
    for family, rows in episodes.items():
        lesson = rows[:-1]
        units = [other[:-1][:256:8] for name, other in episodes.items() if name != family][:7]
        history = np.concatenate([lesson, *units])
        start, stop = choose(history, rows[-1], threshold=adaptive_threshold(typical)).span
        shared = max(0, min(stop, len(lesson)) - start)
        purities.append(shared / (stop - start))
        coverages.append(shared / len(lesson))
        assert purities[-1] > 0.5, family
    # The pass mark of the released reference is 0.9 for both means.
    assert np.mean(purities) >= 0.9
    assert np.mean(coverages) >= 0.9
