"""Ask the questions of a split: check everything, then ask what is not answered yet."""

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from robomme_interference_data.conditions import NO_HISTORY
from robomme_interference_data.constants import FRONT, PROTOCOL_VERSION
from robomme_interference_data.errors import InvalidOptionError, UnknownNameError, nearest
from robomme_interference_data.evaluate.checks import check_positive
from robomme_interference_data.evaluate.config import AskConfig, Run, unusual_retrieval
from robomme_interference_data.evaluate.log import open_log
from robomme_interference_data.evaluate.models.registry import (
    make_model,
    model_identity,
    parse_model,
    pin_model,
)
from robomme_interference_data.evaluate.plan import Plan, WorkItem, plan_work
from robomme_interference_data.evaluate.questions.answers import (
    CONTROLS,
    Answerer,
    Asked,
    Guesser,
    ModelAnswerer,
    Recaller,
)
from robomme_interference_data.evaluate.record import write_record
from robomme_interference_data.evaluate.rollout import retrieval_columns
from robomme_interference_data.evaluate.run import Listener, RunResult, run_items
from robomme_interference_data.evaluate.start import retrieval_index, start_of
from robomme_interference_data.evaluate.systems import known_system, name_system
from robomme_interference_data.evaluate.worker import make_selector
from robomme_interference_data.evidence import known_parts
from robomme_interference_data.execution import Executor, Processes, Worker, end_if_starting
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.loading import load_split
from robomme_interference_data.questions import Question, digest_questions, read_questions
from robomme_interference_data.retrieval.select import Rule
from robomme_interference_data.rollouts import Rollout, Status
from robomme_interference_data.sampling import (
    MEMORIES,
    evidence_kept,
    lesson_frames,
    lesson_share,
)
from robomme_interference_data.simulators.tabletop.families import recorded_scene
from robomme_interference_data.split import Split

if TYPE_CHECKING:
    from robomme_interference_data.retrieval.selector import Selector

_OWN = {"recall": Recaller, "guess": Guesser}
"""Who answers without a model."""


def run_examination(
    config: AskConfig,
    *,
    executor: Executor | None = None,
    listener: Listener | None = None,
    command: Sequence[str] = (),
) -> RunResult:
    """Ask questions about what history buffers show, and write one row per question.

    Rows are those of rollouts (`simulator` is `questions`, `success` whether the answer is right),
    and are on the disk as answers come. Run again with the same `out`, it skips what is answered,
    repeats errors, and adds what is newly asked for.

    Args:
        config: What is asked, and of whom.
        executor: Who asks; `config.workers` processes by default.
        listener: Hears how it goes.
        command: The command line, for the record.

    Raises:
        UnknownNameError, InvalidOptionError, InvalidIdError: A setting is not what it may be.
        MissingFileError: The split is not there, or has no questions.
        ModelError: The model cannot be reached, or is not there.
        RunFolderError: `out` holds another run, or something else.
        MissingExtraError, HubError, FormatError: See `make_model` and `read_questions`.
    """
    end_if_starting()
    _check_settings(config)
    split, folder = load_split(config.split), Path(config.out)
    questions = read_questions(split)
    config = dataclasses.replace(
        config,
        model=config.model if config.model in _OWN else pin_model(config.model),
        split=Path(split.location),
    )
    name = _name(config)
    answerer = make_answerer(config)
    try:
        said = answerer.metadata()
    finally:
        answerer.close()
    plan = plan_work(
        split.episode_ids,
        conditions=config.conditions or [one for one in split.conditions if _applies(config, one)],
        families=config.families,
        episodes=config.episodes,
        episode_split=config.episode_split,
        shard=config.shard,
    )
    items = plan.items()
    for condition in plan.conditions:
        split.manifest(items[0].episode, condition)  # is refused with what there is
        if not _applies(config, condition):
            raise InvalidOptionError(
                f"a retrieval step has nothing to retrieve from under {NO_HISTORY}",
                f"Leave {NO_HISTORY} out of --conditions.",
            )
    if config.model == "recall":
        _check_known(split, plan)
    identity = _identity(config, name, split, said) | {
        "questions": digest_questions(questions.values()),
        "retrieval_index": retrieval_index(config, split, plan),
    }
    with open_log(folder, identity, split.name, resume=not config.no_resume) as log:
        run = Run(config, name, log.header.split, split.revision)
        log.begin(start_of(config, plan, said, {}, command))
        executor = executor or Processes(config.workers)
        return run_items(run, AskTask(run, log.folder), items, split, log, executor, listener)


def _check_settings(config: AskConfig) -> None:
    """Check the settings by themselves and against each other; see `run_examination`."""
    if config.sampling not in MEMORIES:
        raise InvalidOptionError.one_of("--sampling", config.sampling, MEMORIES)
    Rule.parse(config.retrieval_rule)
    unusual_retrieval(config)
    if config.frames < 2:
        raise InvalidOptionError.expected("--frames", config.frames, "2 or more")
    check_positive(config)
    if config.control not in CONTROLS:
        raise InvalidOptionError.one_of("--control", config.control, CONTROLS)
    if config.model in _OWN:
        for name in ("model_options", "control", "prompt"):
            default = type(config).__dataclass_fields__[name].default
            if getattr(config, name) != default:
                option = "--" + name.replace("_", "-").removesuffix("s")
                raise InvalidOptionError(
                    f"{option} says nothing of {config.model}", "It is for models: leave it out."
                )
    elif ":" not in config.model:
        raise UnknownNameError(
            f"there is no model {config.model!r}; expected recall, guess, openai:URL#MODEL, "
            "transformers:ID or transformers:FOLDER",
            nearest(config.model, _OWN, more=""),
        )
    else:
        parse_model(config.model)


def _check_known(split: Split, plan: Plan) -> None:
    """Refuse queries whose possible answers the ideal observer does not know."""
    for episode in {item.episode for item in plan.items()}:
        if recorded_scene(split.query(episode)) is None:
            raise InvalidOptionError(
                f"recall knows what may have been the answer in tabletop alone, not in {episode}",
                "Ask a model, or guess.",
            )


def _applies(config: AskConfig, condition: str) -> bool:
    return config.retrieval is None or condition != NO_HISTORY


def _default_system(config: AskConfig) -> str:
    """Return the name of who answers without a model, that of a bound (see `is_bound`)."""
    parts = ["questions", config.model]
    parts += [config.sampling] if config.model == "recall" else []
    if config.retrieval is None:
        return "-".join(parts)
    return "-".join(["retrieval", *parts, *unusual_retrieval(config).values()]).replace("/", "-")


def _name(config: AskConfig) -> str:
    """Return the name under which rows stand: of the table only that of who answers."""
    own = _default_system(config) if config.model in _OWN else None
    name = config.system or own
    if name is None:
        raise InvalidOptionError(
            f"the rows of {config.model} need a name",
            "Give --system, such as qwen3-vl-4b, or qwen3-vl-4b-blank for a control.",
        )
    name_system(name)
    if name != own and known_system(name) is not None:
        raise InvalidOptionError(
            f"{name} is a system that acts, or answers, otherwise than {config.model}",
            "Give --system a name of your own.",
        )
    return name


def make_answerer(config: AskConfig) -> Answerer:
    """Make who answers, in this process; see `make_model` and `load_prompt` for errors."""
    if config.model in _OWN:
        return _OWN[config.model]()
    model = make_model(config.model, config.model_options)
    return ModelAnswerer(model, config.prompt, config.control)


def _identity(config: AskConfig, system: str, split: Split, said: dict[str, Any]) -> dict[str, Any]:
    """Return what makes the run the one that it is, as plain values."""
    model = said
    if config.model not in _OWN:
        model = model_identity(config.model, config.model_options, said["model"])
        model["prompt_sha256"] = said["prompt_sha256"]
    return {
        "system": system,
        "simulator": config.simulator,
        "revision": split.revision,
        "episode_split": config.episode_split,
        "shift": config.shift,
        "model_seed": config.model_seed,
        "frames": config.frames,
        "sampling": config.sampling,
        "control": config.control,
        "protocol_version": PROTOCOL_VERSION,
        "model": model,
    }


class AskTask:
    """Asks questions, as an executor's task; split, questions and model are made at the first.

    What breaks is raised, and the model is made anew for the next question.
    """

    def __init__(self, run: Run[AskConfig], folder: Path):
        self._run, self._folder = run, folder
        self._split: Split | None = None
        self._questions: dict[EpisodeId, Question] = {}
        self._selector: Selector | None = None
        self._answerer: Answerer | None = None

    def __call__(self, task: WorkItem, worker: Worker) -> tuple[Rollout, str | None]:
        """Ask a question; return its row, and what befell its record, or None."""
        try:
            return self._ask(task)
        except Exception:
            self.close()
            raise

    def close(self) -> None:
        """Release who answers."""
        if self._answerer is not None:
            self._answerer.close()
        self._answerer = None

    def _ask(self, item: WorkItem) -> tuple[Rollout, str | None]:
        config, began = self._run.config, time.perf_counter()
        if self._split is None:
            self._split = load_split(config.split, cache=config.cache, threads=1)
            self._questions = read_questions(self._split)
            self._selector = make_selector(config)
        if self._answerer is None:
            self._answerer = make_answerer(config)
        buffer, question = (
            self._split.load(item.episode, item.condition),
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
        asked = Asked(question, buffer.query, config.model_seed, known, frames)
        answered = self._answerer.answer(asked)
        right = answered.letter == question.letters[question.right]
        own = answered.calls is not None
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
            answer=answered.letter,
            chance=question.chance,
            model_calls=answered.calls,
            model_tokens=answered.tokens,
            model_faults=int(answered.letter is None) if own else None,
            model_s=round(answered.seconds, 4) if answered.seconds is not None else None,
            wall_s=round(time.perf_counter() - began, 4),
        )
        if not own:
            return row, None
        line = {
            **{"question": question.text, "prompt": answered.prompt, "text": answered.text},
            **{"answer": answered.letter, "right": question.letters[question.right]},
        }
        return row, write_record(self._folder, "answers", item, [line])
