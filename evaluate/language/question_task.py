"""What a worker of a run of questions does: one question after the other."""

import time
from collections.abc import Sequence
from functools import cached_property
from typing import Any

from robomme_interference_data.data.loading import load_buffer_set
from robomme_interference_data.data.questions import Question, digest_questions, read_questions
from robomme_interference_data.evaluate.run.config import AskConfig
from robomme_interference_data.evaluate.run.kind import Job, Run, RunTask, history_columns
from robomme_interference_data.evaluate.run.row import Rollout
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.runtime.executor import Worker
from robomme_interference_data.schema.evidence import known_parts
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.schema.sampling import Memory

from .columns import model_columns
from .responders import OWN, ModelResponder, Prompted
from .subgoal_writer import History


class AskTask(RunTask[AskConfig]):
    """Asks questions; makes the model at the first one, and again after an error."""

    def __init__(self, run: Run[AskConfig]):
        super().__init__(run)
        self._responder: ModelResponder | None = None

    @cached_property
    def questions(self) -> dict[EpisodeId, Question]:
        """The questions of the buffer set."""
        return read_questions(self.buffer_set)

    def describe(self) -> dict[str, str]:
        """Return the buffer set's revision, its questions' digest, and versions."""
        buffer_set = load_buffer_set(self.run.config.buffer_set)
        digest = digest_questions(read_questions(buffer_set).values())
        return super().describe() | {"the questions' digest": digest}

    def close(self) -> None:
        """Close the model."""
        if self._responder is not None:
            self._responder.close()
        self._responder = None

    def work(self, task: Job, worker: Worker) -> tuple[Rollout, None]:
        """Ask a question, and send its transcript; return its row."""
        item, config, began = task.item, self.run.config, time.perf_counter()
        if self._responder is None and config.model not in OWN:
            self._responder = ModelResponder(config)
        buffer = self.buffer_set.load(item.episode, item.condition)
        question, query = self.questions[item.episode], buffer.query
        given: Sequence[int] = range(len(buffer))
        if self.selector is not None and len(buffer):
            given = self.selector.select(buffer, query.frame(self.selector.camera)).tolist()
        memory = Memory.parse(config.memory)
        kept = memory.kept(given)
        known = None if buffer.evidence is None else known_parts(buffer.evidence, kept)
        history = History(buffer, kept, self.history)
        prompted = Prompted(question, query, config.model_seed, known, history)
        right = question.letters[question.right]
        columns: dict[str, Any] = {}
        if self._responder is None:
            letter: str | None = OWN[config.model](prompted)
        else:
            letter, prompt, reply = self._responder.answer(prompted)
            columns = model_columns(reply.calls, [reply.tokens], letter is None)
            columns["model_s"] = round(reply.seconds, 4)
            line = {
                **{"question": question.text, "prompt": prompt, "text": reply.text},
                **{"answer": letter, "right": right},
            }
            worker.send_file(*item.transcript("answers", [line]))
        row = self.run.row(
            item,
            Status.SUCCESS if letter == right else Status.FAIL,
            seed=query.seed,
            difficulty=query.difficulty,
            goal=query.goal,
            steps=0,
            **history_columns(buffer, given, memory, retrieved=self.selector is not None),
            answer=letter,
            chance=question.chance,
            **columns,
            wall_s=round(time.perf_counter() - began, 4),
        )
        return row, None
