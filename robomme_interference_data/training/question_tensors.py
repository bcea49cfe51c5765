"""The questions about the past as arrays, for models that choose an option."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.questions import read_questions
from robomme_interference_data.ids import EpisodeId


class QuestionTensors:
    """The questions of episodes, padded to the most options (O) and points (P) of the buffer set.

    Entries of several episodes, given by their numbers, are those of a batch; see `HistoryDataset`.
    """

    def __init__(self, buffer_set: BufferSet, episodes: Sequence[EpisodeId]):
        questions = read_questions(buffer_set)
        options = max(len(question.options) for question in questions.values())
        most = max(
            1, *(len(points) for question in questions.values() for points in question.pixels)
        )
        shape = buffer_set.query(episodes[0]).dataset.shape()
        self._questions = [questions[episode] for episode in episodes]
        points = np.zeros((len(episodes), options, most, 2), np.float32)
        point_is_pad = np.ones(points.shape[:3], bool)
        for number, question in enumerate(self._questions):
            for option, values in enumerate(question.pixels):
                pixels = np.reshape(np.array(values, np.float32), (-1, 2))
                # The center of pixel 0 lies at 0.5.
                points[number, option, : len(pixels)] = (pixels + 0.5) / np.array(
                    shape[:2], np.float32
                )
                point_is_pad[number, option, : len(pixels)] = False
        counts = np.array([len(question.options) for question in self._questions])
        self._arrays = {
            "question.option_is_pad": np.arange(options) >= counts[:, None],
            "question.points": points,
            "question.point_is_pad": point_is_pad,
            "question.answer": np.array([question.right for question in self._questions]),
        }
        self._texts = [
            [*question.options, *[""] * (options - len(question.options))]
            for question in self._questions
        ]

    def arrays(self, numbers: list[int]) -> dict[str, NDArray[Any]]:
        """Return the entries of a batch that are arrays."""
        return {name: values[numbers] for name, values in self._arrays.items()}

    def texts(self, numbers: list[int]) -> dict[str, Any]:
        """Return the others: B questions, and O lists of the texts of B options."""
        options = zip(*(self._texts[number] for number in numbers), strict=True)
        return {
            "question": [self._questions[number].text for number in numbers],
            "question.options": [list(texts) for texts in options],
        }
