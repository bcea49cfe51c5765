"""The questions about the past as tensors, for models that choose an option."""

from typing import Any

import numpy as np
import torch

from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.questions import read_questions
from robomme_interference_data.ids import EpisodeId


class QuestionTensors:
    """The questions of a buffer set, padded to the most options (O) and points (P) of any."""

    def __init__(self, buffer_set: BufferSet):
        self._questions = read_questions(buffer_set)
        every = self._questions.values()
        self._options = max(len(one.options) for one in every)
        self._points = max(1, *(len(points) // 2 for one in every for points in one.points))
        shape = buffer_set.query(next(iter(self._questions))).dataset.shape("front")
        self._size = np.array(shape[:2], np.float32)

    def of(self, episode: EpisodeId) -> dict[str, Any]:
        """Return the entries of an item for an episode's question; see `HistoryDataset`."""
        question = self._questions[episode]
        points = np.zeros((self._options, self._points, 2), np.float32)
        point_is_pad = np.ones((self._options, self._points), bool)
        for option, values in enumerate(question.points):
            pixels = np.reshape(np.array(values, np.float32), (-1, 2))
            points[option, : len(pixels)] = (pixels + 0.5) / self._size
            point_is_pad[option, : len(pixels)] = False
        padding = self._options - len(question.options)
        return {
            "question": question.text,
            "question.options": [*question.options, *[""] * padding],
            "question.option_is_pad": torch.arange(self._options) >= len(question.options),
            "question.points": torch.from_numpy(points),
            "question.point_is_pad": torch.from_numpy(point_is_pad),
            "question.answer": torch.tensor(question.right),
        }
