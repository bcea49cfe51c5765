"""Ask the questions of a split: check everything, then ask what is not answered yet."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from robomme_interference_data.constants import PROTOCOL_VERSION
from robomme_interference_data.data.buffer_set import Split
from robomme_interference_data.data.loading import load_split
from robomme_interference_data.data.questions import digest_questions, read_questions
from robomme_interference_data.errors import InvalidOptionError, UnknownNameError, nearest
from robomme_interference_data.evaluate.models.registry import (
    model_identity,
    parse_model,
    pin_model,
)
from robomme_interference_data.evaluate.run.checks import check_positive
from robomme_interference_data.evaluate.run.config import AskConfig, Run, unusual_retrieval
from robomme_interference_data.evaluate.run.evaluation import Listener, RunResult, run_items
from robomme_interference_data.evaluate.run.identity import retrieval_index, start_of
from robomme_interference_data.evaluate.run.log import open_log
from robomme_interference_data.evaluate.run.plan import Plan, plan_work
from robomme_interference_data.evaluate.systems import known_system, name_system
from robomme_interference_data.retrieval.select import Rule
from robomme_interference_data.runtime.executor import Executor, end_if_starting, make_executor
from robomme_interference_data.schema.conditions import NO_HISTORY
from robomme_interference_data.schema.sampling import MEMORIES
from robomme_interference_data.simulators.registry import recorded_scene

from .answers import (
    CONTROLS,
    OWN,
    make_answerer,
)
from .task import AskTask


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
        executor: Who asks; by default what `config` says.
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
        model=config.model if config.model in OWN else pin_model(config.model),
        split=split.location,
    )
    name = _name(config)
    answerer = make_answerer(config)
    try:
        said, shown = answerer.metadata(), answerer.images
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
    # How much of a history a retrieval step chooses is not known before.
    if shown is not None and (config.retrieval is None or config.sampling != "full"):
        _check_shown(config, split, plan, shown)
    identity = _identity(config, name, split, said) | {
        "questions": digest_questions(questions.values()),
        "retrieval_index": retrieval_index(config, split, plan),
    }
    with open_log(folder, identity, split.name, resume=not config.no_resume) as log:
        run = Run(config, name, log.header.split, split.revision)
        log.begin(start_of(config, plan, said, {}, command))
        executor = executor or make_executor(config)
        return run_items(run, AskTask(run), items, split, log, executor, listener)


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
    if config.model in OWN:
        unused = {"model_options": "--model-option", "control": "--control", "prompt": "--prompt"}
        if config.model == "guess":
            unused |= {one: f"--{one}" for one in ("frames", "sampling", "retrieval")}
        for name, option in unused.items():
            if getattr(config, name) != type(config).__dataclass_fields__[name].default:
                raise InvalidOptionError(
                    f"{option} says nothing of {config.model}", "Leave it out, or ask a model."
                )
    elif ":" not in config.model:
        raise UnknownNameError(
            f"there is no model {config.model!r}; expected recall, guess, openai:URL#MODEL, "
            "transformers:ID or transformers:FOLDER",
            nearest(config.model, OWN, more=""),
        )
    else:
        parse_model(config.model)


def _check_known(split: Split, plan: Plan) -> None:
    """Refuse queries whose possible answers the ideal observer does not know."""
    for episode in {item.episode for item in plan.items()}:
        if recorded_scene(split.query(episode)) is None:
            raise InvalidOptionError(
                f"recall does not know what may have been the answer in {episode}",
                "Ask a model, or guess.",
            )


def _check_shown(config: AskConfig, split: Split, plan: Plan, images: int) -> None:
    """Refuse frames that are kept and could not be shown, as a model takes fewer images."""
    for item in plan.items():
        history = split.manifest(item.episode, item.condition).history_frames
        kept = len(MEMORIES[config.sampling](history, config.frames))
        if kept + 1 > images:
            raise InvalidOptionError(
                f"{item.episode}, {item.condition}: {kept} frames are kept, and shown with the "
                f"picture; the model takes {images} images at most",
                f"Give --model-option images={kept + 1}, or fewer --frames.",
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
    own = _default_system(config) if config.model in OWN else None
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


def _identity(config: AskConfig, system: str, split: Split, said: dict[str, Any]) -> dict[str, Any]:
    """Return what makes the run the one that it is, as plain values."""
    model = said
    if config.model not in OWN:
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
