"""Runs of questions: what happens before the first one, and what their workers do."""

import dataclasses
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import closing, contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any

from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.loading import load_buffer_set
from robomme_interference_data.data.questions import Question, digest_questions, read_questions
from robomme_interference_data.errors import InvalidOptionError, UnknownNameError, named, nearest
from robomme_interference_data.evaluate.run.config import AskConfig, check_unused, with_retrieval
from robomme_interference_data.evaluate.run.history import history_columns
from robomme_interference_data.evaluate.run.identity import retrieval_text, short_digest
from robomme_interference_data.evaluate.run.log import unfinished
from robomme_interference_data.evaluate.run.plan import WorkItem, plan_run
from robomme_interference_data.evaluate.run.row import Rollout, model_columns
from robomme_interference_data.evaluate.run.worker import (
    Job,
    PlannedRun,
    RunContext,
    RunFunction,
    reported_number,
)
from robomme_interference_data.evaluate.systems import SYSTEMS, SystemFacts, name_system
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.runtime.executor import Executor, Worker, WorkerPool
from robomme_interference_data.schema.evidence import known_parts
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.schema.sampling import Memory
from robomme_interference_data.simulators.registry import recorded_scene

from .images import HistoryFrames
from .models import MODELS
from .prompt_files import prompted_identity
from .questions import CONTROLS, WITHOUT_MODEL, ModelResponder, Prompted


@contextmanager
def open_questions(
    config: AskConfig, buffer_set: BufferSet, executor: Executor
) -> Iterator[tuple[PlannedRun[AskConfig], WorkerPool | None]]:
    """Plan a run, and keep its workers in the block; None if there is nothing to do for them."""
    config, system = _complete_settings(config)
    questions = read_questions(buffer_set)
    # Made once here, so that a model that is missing is one error, before workers start.
    metadata, images = _describe_model(config)
    run = _describe_run(config, system, buffer_set, questions.values(), metadata)
    plan = plan_run(config, run.facts, buffer_set)
    items = plan.items()
    responder = WITHOUT_MODEL.get(config.model)
    if responder is not None and responder.needs_scene:
        _check_scenes(config.model, buffer_set, items)
    if images is not None:
        _check_images(config, buffer_set, items, images)
    planned = PlannedRun(run, plan, items)
    if not unfinished(Path(config.out), items):
        yield planned, None
        return
    with executor.pool(AskFunction(config)) as pool:
        yield planned, pool


def _complete_settings(config: AskConfig) -> tuple[AskConfig, str]:
    """Return the settings in their one spelling, models with their commit, and the rows' label."""
    _check_settings(config)
    config = dataclasses.replace(config, memory=str(Memory.parse(config.memory)))
    if config.model not in WITHOUT_MODEL:
        config = dataclasses.replace(config, model=MODELS.pin(config.model))
    return config, _name(config)


def _describe_model(config: AskConfig) -> tuple[dict[str, Any], int | None]:
    """Return what the model reports of itself, and its maximum of images; None without a limit."""
    if config.model in WITHOUT_MODEL:
        return {"model": config.model}, None
    with closing(ModelResponder(config)) as responder:
        return responder.metadata(), responder.images


def _describe_run(
    config: AskConfig,
    system: str,
    buffer_set: BufferSet,
    questions: Collection[Question],
    metadata: dict[str, Any],
) -> RunContext[AskConfig]:
    """Return what is known of a run from its settings, and from what its model reports."""
    responder, model = WITHOUT_MODEL.get(config.model), metadata
    if responder is None:
        model = prompted_identity(config.model, config.model_options, metadata)
    facts = SystemFacts(
        policy=MODELS.parse(config.model).kind if responder is None else config.model,
        policy_id=short_digest({"model": model, "control": config.control}),
        training_step=reported_number(metadata, "training_step"),
        # A guess sees no frame: a memory would pair it with systems that have one.
        memory=config.memory if responder is None or responder.reads_history else None,
        retrieval=retrieval_text(config, buffer_set),
        reference=responder is not None,
    )
    identity = {
        "memory": config.memory,
        "control": config.control,
        "model": model,
        "questions": digest_questions(questions),
    }
    return RunContext(
        config,
        system,
        facts,
        buffer_set.name,
        buffer_set.revision,
        metadata=metadata,
        identity=identity,
    )


def _check_scenes(model: str, buffer_set: BufferSet, items: Sequence[WorkItem]) -> None:
    """Check that a responder can know all answers that the scenes allow."""
    for episode in dict.fromkeys(item.episode for item in items):
        if recorded_scene(buffer_set.query(episode)) is None:
            raise InvalidOptionError(
                f"{model} does not know the possible answers in {episode}", "Ask a model, or guess."
            )


def _check_images(
    config: AskConfig, buffer_set: BufferSet, items: Sequence[WorkItem], images: int
) -> None:
    """Check that the model takes as many images as a question has."""
    memory = Memory.parse(config.memory)
    # How many frames a retrieval step selects is unknown before; a memory of N bounds them.
    if config.retrieval is not None and memory.rule == "full":
        return
    for item in items:
        history = buffer_set.manifest(item.episode, item.condition).history_frames
        kept = len(memory.earlier(history))
        if kept + 1 > images:
            raise InvalidOptionError(
                f"{item.episode}, {item.condition}: {kept} history frames and the picture; "
                f"the model takes {images} images at most",
                f"Set {named('model_options', f'images={kept + 1}')}, or a smaller "
                f"{named('memory')}.",
            )


def _check_settings(config: AskConfig) -> None:
    """Check the settings by themselves and against each other."""
    if config.control not in CONTROLS:
        raise InvalidOptionError.one_of("control", config.control, CONTROLS)
    responder = WITHOUT_MODEL.get(config.model)
    if responder is not None:
        unused = ["model_options", "control", "prompt"]
        if not responder.reads_history:
            unused += ["memory", "retrieval"]
        check_unused(config, unused, config.model, "Leave it out, or ask a model.")
    elif ":" not in config.model:
        raise UnknownNameError(
            f"there is no model {config.model!r}; expected recall, abstain, guess, "
            "openai:URL#MODEL, transformers:ID or transformers:FOLDER",
            nearest(config.model, WITHOUT_MODEL, more=""),
        )
    else:
        MODELS.parse(config.model)


def _name(config: AskConfig) -> str:
    """Return the label of the rows: a name of the table only for the responder that it names."""
    default, responder = None, WITHOUT_MODEL.get(config.model)
    if responder is not None:
        default = f"questions-{config.model}"
        if responder.reads_history:
            default += f"-{Memory.parse(config.memory).label}"
        default = with_retrieval(default, config)
    name = config.system or default
    if name is None:
        raise InvalidOptionError(
            f"the rows of {config.model} need a name",
            f"Set {named('system')}, such as qwen3-vl-4b, or qwen3-vl-4b-blank for a control.",
        )
    name_system(name)
    # Its rows would be pooled with those of the system that has the name.
    if name != default and name in SYSTEMS:
        raise InvalidOptionError(
            f"{name} is the name of another system than {config.model}",
            f"Set {named('system')} to a name of your own.",
        )
    return name


class AskFunction(RunFunction[AskConfig]):
    """Asks questions; makes the model at the first one, and again after an error."""

    def __init__(self, config: AskConfig):
        super().__init__(config)
        self._responder: ModelResponder | None = None

    @cached_property
    def questions(self) -> dict[EpisodeId, Question]:
        """The questions of the buffer set."""
        return read_questions(self.buffer_set)

    def describe(self) -> dict[str, str]:
        """Return the buffer set's revision, its questions' digest, and versions."""
        buffer_set = load_buffer_set(self.config.buffer_set)
        digest = digest_questions(read_questions(buffer_set).values())
        return super().describe() | {"the questions' digest": digest}

    def close(self) -> None:
        """Close the model."""
        if self._responder is not None:
            self._responder.close()
        self._responder = None

    def work(self, task: Job[AskConfig], worker: Worker) -> tuple[Rollout, None]:
        """Ask a question, and send its transcript; return its row."""
        item, config, began = task.item, self.config, time.perf_counter()
        if self._responder is None and config.model not in WITHOUT_MODEL:
            self._responder = ModelResponder(config)
        buffer = self.buffer_set.load(item.episode, item.condition)
        question, query = self.questions[item.episode], buffer.query
        received: Sequence[int] = range(len(buffer))
        if self.selector is not None and len(buffer):
            received = self.selector.select(buffer, query.frame(self.selector.camera)).tolist()
        memory = Memory.parse(config.memory)
        kept = memory.kept(received)
        known = None
        if buffer.evidence is not None:
            known = known_parts(buffer.evidence, kept, first_counts=query.first_counts)
        history = HistoryFrames(buffer, kept, self.history)  # decoded only for a model
        prompted = Prompted(question, query, config.model_seed, known, history)
        right = question.letters[question.right]
        columns: dict[str, Any] = {}
        if self._responder is None:
            letter: str | None = WITHOUT_MODEL[config.model].answer(prompted)
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
        row = task.run.row(
            item,
            Status.SUCCESS if letter == right else Status.FAIL,
            seed=query.seed,
            difficulty=query.difficulty,
            ability=query.record.ability,
            goal=query.goal,
            steps=0,  # nothing is executed
            **history_columns(buffer, received, memory, retrieved=self.selector is not None),
            answer=letter,
            chance=question.chance,
            **columns,
            wall_s=round(time.perf_counter() - began, 4),
        )
        return row, None
