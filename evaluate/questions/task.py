"""Questions as an executor's task: one at a time, each a row."""

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from robomme_interference_data.constants import FRONT
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.loading import load_buffer_set
from robomme_interference_data.data.questions import Question, digest_questions, read_questions
from robomme_interference_data.evaluate.rollout.rollout import retrieval_columns
from robomme_interference_data.evaluate.run.config import AskConfig
from robomme_interference_data.evaluate.run.identity import make_selector, package_versions
from robomme_interference_data.evaluate.run.kind import Job, Run, stored_count
from robomme_interference_data.evaluate.run.log import transcript_file
from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.runtime.executor import Worker
from robomme_interference_data.schema.evidence import known_parts
from robomme_interference_data.schema.rollouts import Rollout, Status
from robomme_interference_data.schema.sampling import (
    MEMORIES,
    evidence_kept,
    lesson_frames,
    lesson_share,
)

from .responders import OWN, Answer, ModelResponder, Prompted

if TYPE_CHECKING:
    from robomme_interference_data.retrieval.selector import Selector


class AskTask:
    """Asks questions, as an executor's task; buffer set, questions and model are made at the first.

    What breaks is raised, and the model is made anew for the next question.
    """

    def __init__(self, run: Run[AskConfig]):
        self._run = run
        self._buffer_set: BufferSet | None = None
        self._questions: dict[EpisodeId, Question] = {}
        self._selector: Selector | None = None
        self._responder: ModelResponder | None = None

    def __call__(self, task: Job, worker: Worker) -> tuple[Rollout, None]:
        """Ask a question, and send its transcript; return its row."""
        try:
            return self._ask(task.item, worker), None
        except Exception:
            self.close()
            raise

    def describe(self) -> dict[str, str]:
        """Return the buffer set's revision, its questions' digest and versions, where it would run."""
        buffer_set = load_buffer_set(self._run.config.buffer_set)
        questions = digest_questions(read_questions(buffer_set).values())
        told = {
            "the buffer set's revision": buffer_set.revision,
            "the questions' digest": questions,
        }
        return package_versions(self._run.config) | told

    def close(self) -> None:
        """Release who answers."""
        if self._responder is not None:
            self._responder.close()
        self._responder = None

    def _ask(self, item: WorkItem, worker: Worker) -> Rollout:
        config, began = self._run.config, time.perf_counter()
        if self._buffer_set is None:
            self._buffer_set = load_buffer_set(config.buffer_set, cache=config.cache, threads=1)
            self._questions = read_questions(self._buffer_set)
            self._selector = make_selector(config)
        if self._responder is None and config.model not in OWN:
            self._responder = ModelResponder(config)
        buffer, question = (
            self._buffer_set.load(item.episode, item.condition),
            self._questions[item.episode],
        )
        given: Sequence[int] = range(len(buffer))
        if self._selector is not None and len(buffer):
            view = buffer.query.frame(self._selector.camera)
            given = self._selector.select(buffer, view).tolist()
        kept = [given[place] for place in MEMORIES[config.sampling](len(given), config.frames)]
        evidence, camera = buffer.evidence, FRONT.rpartition(".")[2]

        def frames() -> Any:
            if not kept:
                return np.empty((0, 1, 1, 3), np.uint8)
            [chunk] = buffer.stream(len(kept), (camera,), kept)
            return chunk.frames[camera]

        known = None if evidence is None else known_parts(evidence, kept)
        prompted = Prompted(question, buffer.query, config.model_seed, known, frames)
        if self._responder is None:
            answer = Answer(OWN[config.model](prompted))
        else:
            answer = self._responder.answer(prompted)
        right = answer.letter == question.letters[question.right]
        own = answer.calls is not None
        tokens = stored_count(answer.tokens)
        faults = (answer.letter is None) + (tokens != answer.tokens)
        row = self._run.row(
            item,
            seed=buffer.query.seed,
            difficulty=buffer.query.difficulty,
            goal=buffer.query.goal,
            status=str(Status.SUCCESS if right else Status.FAIL),
            success=right,
            steps=0,
            history_frames=len(given),
            lesson_frames=lesson_frames(buffer.sessions, given),
            lesson_share=lesson_share(buffer.sessions, given) if given else None,
            evidence_kept=None if evidence is None else evidence_kept(evidence, kept),
            **retrieval_columns(self._selector, buffer, given),
            answer=answer.letter,
            chance=question.chance,
            model_calls=answer.calls,
            model_tokens=tokens,
            model_faults=faults if own else None,
            model_s=round(answer.seconds, 4) if answer.seconds is not None else None,
            wall_s=round(time.perf_counter() - began, 4),
        )
        if own:
            line = {
                **{"question": question.text, "prompt": answer.prompt, "text": answer.text},
                **{"answer": answer.letter, "right": question.letters[question.right]},
            }
            worker.send_file(*transcript_file("answers", item, [line]))
        return row
