"""Runs of questions: the checks before one, what identifies it, and what its workers do."""

import dataclasses
import time
from collections.abc import Sequence
from contextlib import closing
from functools import cached_property
from typing import Any

from robomme_interference_data.data.loading import load_buffer_set
from robomme_interference_data.data.questions import Question, digest_questions, read_questions
from robomme_interference_data.errors import InvalidOptionError, UnknownNameError, named, nearest
from robomme_interference_data.evaluate.run.config import AskConfig, check_unused, with_retrieval
from robomme_interference_data.evaluate.run.plan import RunPlan, WorkItem
from robomme_interference_data.evaluate.run.row import Rollout
from robomme_interference_data.evaluate.run.runner import (
    Job,
    RunContext,
    RunFunction,
    Runner,
    history_columns,
    retrieval_text,
    short_digest,
)
from robomme_interference_data.evaluate.systems import SYSTEMS, SystemFacts, name_system
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.runtime.executor import Worker
from robomme_interference_data.schema.evidence import known_parts
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.schema.sampling import Memory
from robomme_interference_data.simulators.registry import recorded_scene

from .columns import model_columns
from .images import HistoryFrames
from .models import MODELS, model_identity
from .responders import CONTROLS, WITHOUT_MODEL, ModelResponder, Prompted


class QuestionRunner(Runner[AskConfig]):
    """Multiple-choice questions about what history buffers show."""

    def prepare(self) -> None:
        """Check the settings, and identify the model."""
        config = self.config
        _check_settings(config)
        self.memory = Memory.parse(config.memory)
        self.config = config = dataclasses.replace(config, memory=str(self.memory))
        self._questions = read_questions(self.buffer_set)
        self.metadata, self._images = {"model": config.model}, None
        if config.model not in WITHOUT_MODEL:
            self.config = config = dataclasses.replace(config, model=MODELS.pin(config.model))
        self.system = _name(config)
        if config.model not in WITHOUT_MODEL:
            with closing(ModelResponder(config)) as responder:
                self.metadata, self._images = responder.metadata(), responder.images

    def facts(self) -> SystemFacts:
        """Return what the system is: the model, and what it sees of the past."""
        config, has_model = self.config, self.config.model not in WITHOUT_MODEL
        return SystemFacts(
            policy=MODELS.parse(config.model).kind if has_model else config.model,
            policy_id=short_digest({"model": self._model_identity(), "control": config.control}),
            memory=None if config.model == "guess" else config.memory,
            retrieval=retrieval_text(config, self.buffer_set),
            reference=not has_model,
        )

    def check(self, plan: RunPlan, items: Sequence[WorkItem]) -> None:
        """Check that the images fit, and that the ideal observer knows the possible answers."""
        config = self.config
        if config.model == "recall":
            for episode in dict.fromkeys(item.episode for item in items):
                if recorded_scene(self.buffer_set.query(episode)) is None:
                    raise InvalidOptionError(
                        f"recall does not know the possible answers in {episode}",
                        "Ask a model, or guess.",
                    )
        # How many frames a retrieval step selects is unknown before; a memory of N bounds them.
        if self._images is None or (config.retrieval is not None and self.memory.rule == "full"):
            return
        for item in items:
            history = self.buffer_set.manifest(item.episode, item.condition).history_frames
            kept = len(self.memory.earlier(history))
            if kept + 1 > self._images:
                raise InvalidOptionError(
                    f"{item.episode}, {item.condition}: {kept} history frames and the picture; "
                    f"the model takes {self._images} images at most",
                    f"Set {named('model_options', f'images={kept + 1}')}, or a smaller "
                    f"{named('memory')}.",
                )

    def function(self, run: RunContext[AskConfig]) -> "AskFunction":
        """Return the function that asks questions."""
        return AskFunction(run)

    def identity(self) -> dict[str, Any]:
        """Return what of questions and model can change an answer."""
        config = self.config
        return {
            "memory": str(self.memory),
            "control": config.control,
            "model": self._model_identity(),
            "questions": digest_questions(self._questions.values()),
        }

    def _model_identity(self) -> dict[str, Any]:
        config = self.config
        if config.model in WITHOUT_MODEL:
            return self.metadata
        model = model_identity(config.model, config.model_options, self.metadata["model"])
        return model | {"prompt_sha256": self.metadata["prompt_sha256"]}


def _check_settings(config: AskConfig) -> None:
    """Check the settings by themselves and against each other."""
    if config.control not in CONTROLS:
        raise InvalidOptionError.one_of("control", config.control, CONTROLS)
    if config.model in WITHOUT_MODEL:
        unused = ["model_options", "control", "prompt"]
        if config.model == "guess":
            unused += ["memory", "retrieval"]
        check_unused(config, unused, config.model, "Leave it out, or ask a model.")
    elif ":" not in config.model:
        raise UnknownNameError(
            f"there is no model {config.model!r}; expected recall, guess, openai:URL#MODEL, "
            "transformers:ID or transformers:FOLDER",
            nearest(config.model, WITHOUT_MODEL, more=""),
        )
    else:
        MODELS.parse(config.model)


def _name(config: AskConfig) -> str:
    """Return the label of the rows: a name of the table only for the responder that it names."""
    default = None
    if config.model in WITHOUT_MODEL:
        default = f"questions-{config.model}"
        if config.model == "recall":
            default += f"-{Memory.parse(config.memory).label}"
        default = with_retrieval(default, config)
    name = config.system or default
    if name is None:
        raise InvalidOptionError(
            f"the rows of {config.model} need a name",
            f"Set {named('system')}, such as qwen3-vl-4b, or qwen3-vl-4b-blank for a control.",
        )
    name_system(name)
    if name != default and name in SYSTEMS:
        raise InvalidOptionError(
            f"{name} is the name of another system than {config.model}",
            f"Set {named('system')} to a name of your own.",
        )
    return name


class AskFunction(RunFunction[AskConfig]):
    """Asks questions; makes the model at the first one, and again after an error."""

    def __init__(self, run: RunContext[AskConfig]):
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
        if self._responder is None and config.model not in WITHOUT_MODEL:
            self._responder = ModelResponder(config)
        buffer = self.buffer_set.load(item.episode, item.condition)
        question, query = self.questions[item.episode], buffer.query
        received: Sequence[int] = range(len(buffer))
        if self.selector is not None and len(buffer):
            received = self.selector.select(buffer, query.frame(self.selector.camera)).tolist()
        memory = Memory.parse(config.memory)
        kept = memory.kept(received)
        known = None if buffer.evidence is None else known_parts(buffer.evidence, kept)
        history = HistoryFrames(buffer, kept, self.history)
        prompted = Prompted(question, query, config.model_seed, known, history)
        right = question.letters[question.right]
        columns: dict[str, Any] = {}
        if self._responder is None:
            letter: str | None = WITHOUT_MODEL[config.model](prompted)
        else:
            letter, prompt, reply = self._responder.answer(prompted)
            columns = model_columns(reply.calls, [reply.tokens], letter is None)
            columns["model_s"] = round(reply.seconds, 4)
            line = {
                "question": question.text,
                "prompt": prompt,
                "text": reply.text,
                "answer": letter,
                "right": right,
            }
            worker.send_file(*item.transcript("answers", [line]))
        row = self.run.row(
            item,
            Status.SUCCESS if letter == right else Status.FAIL,
            seed=query.seed,
            difficulty=query.difficulty,
            goal=query.goal,
            steps=0,
            **history_columns(buffer, received, memory, retrieved=self.selector is not None),
            answer=letter,
            chance=question.chance,
            **columns,
            wall_s=round(time.perf_counter() - began, 4),
        )
        return row, None
