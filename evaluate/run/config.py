"""The settings of a run: the Python API, and the options of `evaluate`, `ask` and `ceiling`."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from robomme_interference_data.constants import DEMONSTRATIONS, QUESTIONS, SPLITS
from robomme_interference_data.errors import InvalidOptionError, named
from robomme_interference_data.runtime.executor import WorkersConfig
from robomme_interference_data.schema.sampling import MEMORY_FORM
from robomme_interference_data.schema.settings import (
    PYTHON_HELP,
    PYTHON_SHOWN,
    SIMULATOR_OPTION_HELP,
    setting,
)
from robomme_interference_data.schema.shifts import NO_SHIFT, SHIFT_HELP

if TYPE_CHECKING:
    from robomme_interference_data.data.buffer_set import BufferSet

_EPISODES, _POLICY, _MODEL, _SUBGOALS = "Episodes", "Policy", "Model", "Subgoals"
_RETRIEVAL, _SIMULATOR, _EXECUTION = "Retrieval", "Simulator", "Execution"


@dataclass(frozen=True, kw_only=True)
class RetrievalConfig:
    """The retrieval step in front of a policy, or of a memory."""

    retrieval: str | None = setting(
        None, group=_RETRIEVAL, help="Encoder of a retrieval step: thumbnail, siglip or siglip:ID."
    )
    retrieval_rule: str = setting(
        "max", group=_RETRIEVAL, help="METHOD or METHOD/NUMBER, as for retrieval-score."
    )
    retrieval_camera: str | None = setting(
        None,
        group=_RETRIEVAL,
        help="Camera whose frames are compared.",
        shown="the first",
        rare=True,
    )


@dataclass(frozen=True, kw_only=True)
class WorkConfig(WorkersConfig, RetrievalConfig):
    """Which episodes and conditions to run, under which name, and how to execute the run."""

    conditions: tuple[str, ...] = setting(
        (), group=_EPISODES, help="no-history, k0, k1, …; default: all that apply."
    )
    families: tuple[str, ...] = setting((), group=_EPISODES, help="Task families; default: all.")
    episodes: str | None = setting(
        None, group=_EPISODES, help="Episode numbers, such as 0-49 or 0,3,10-12; default: all."
    )
    split: str = setting("test", group=_EPISODES, help="train, val, test or heldout.", rare=True)
    shard: str = setting(
        "1/1", group=_EPISODES, help="Part of the plan to run, such as 2/8; see merge."
    )
    system: str | None = setting(
        None, group=_EPISODES, help="Label of the rows; see docs/reference/policies.md."
    )
    model_seed: int = setting(0, group=_EXECUTION, help="Seed for all random draws.")
    training_seed: int | None = setting(
        None,
        group=_EXECUTION,
        help="Seed of the training run that made the weights, for rows.",
        shown="the one that the policy reports",
        rare=True,
    )
    rollout_timeout_s: float = setting(
        3600.0,
        group=_EXECUTION,
        help="Maximum seconds of a rollout or question; then it is an error.",
        rare=True,
    )
    cache: bool = setting(
        False, group=_EXECUTION, help="Keep decoded frames on disk for later runs.", rare=True
    )
    max_errors: int = setting(
        10, group=_EXECUTION, metavar="N", help="Stop after N errors in a row.", rare=True
    )
    track: str | None = setting(
        None,
        group=_EXECUTION,
        metavar="TRACKER",
        help="Send success rates to wandb, trackio or csv (OUT/metrics.csv) as rollouts end.",
        rare=True,
    )
    no_resume: bool = setting(
        False, group=_EXECUTION, help="Fail if the folder already holds a run.", rare=True
    )


@dataclass(frozen=True)
class RunConfig(WorkConfig):
    """The settings of an evaluation: what to roll out, and how."""

    policy: str = setting(
        group=_POLICY,
        help="Policy, such as replay:framesamp:32, oracle, websocket://HOST:PORT, lerobot:REPO or "
        "python:module:factory; all kinds: docs/reference/policies.md.",
    )
    buffer_set: str = setting(
        name="-", metavar="BUFFER_SET", help="Folder of the buffer set, or NAMESPACE/NAME."
    )
    out: Path = setting(help="Folder of the run; an existing run resumes.")
    policy_options: tuple[str, ...] = setting(
        (),
        name="--policy-option",
        whole=True,
        metavar="NAME=VALUE",
        group=_POLICY,
        help="Options of the policy, such as device=cpu; see docs/reference/policies.md.",
    )
    offline: bool = setting(
        False,
        group=_SIMULATOR,
        help="Compare actions with those of the buffer set's executions, without a simulator.",
    )
    simulator: str = setting(
        "tabletop", group=_SIMULATOR, help="tabletop, tabletop-day, robomme or module:name."
    )
    simulator_python: str | None = setting(
        None, group=_SIMULATOR, metavar="PATH", help=PYTHON_HELP, shown=PYTHON_SHOWN
    )
    simulator_options: tuple[str, ...] = setting(
        (),
        name="--simulator-option",
        whole=True,
        metavar="NAME=VALUE",
        group=_SIMULATOR,
        help=SIMULATOR_OPTION_HELP,
    )
    shift: str = setting(NO_SHIFT, group=_SIMULATOR, help=SHIFT_HELP)
    policies: int | None = setting(
        None,
        metavar="N",
        group=_EXECUTION,
        help="Processes with one policy each that the workers share; default: one per worker, in "
        "its process.",
    )
    max_batch_size: int = setting(
        8,
        metavar="N",
        group=_EXECUTION,
        help="Maximum rollouts for which a shared policy acts at once.",
        rare=True,
    )
    batch_wait_timeout_s: float = setting(
        0.01,
        group=_EXECUTION,
        help="Maximum seconds that an idle shared policy waits for a larger batch.",
        rare=True,
    )
    policy_resources: tuple[str, ...] = setting(
        (),
        metavar="cpus=N,gpus=N",
        group=_EXECUTION,
        help="What Ray reserves for each shared policy.",
        shown="cpus=1,gpus=0",
        rare=True,
    )
    subgoals: str | None = setting(
        None,
        group=_SUBGOALS,
        help="Writer of subgoals: openai:URL#MODEL, transformers:ID or oracle.",
    )
    subgoal_prompt: str | None = setting(
        None,
        metavar="NAME|FILE",
        group=_SUBGOALS,
        help="Prompt of a model: simple, grounded, memer or a file; see docs/reference/prompts.md.",
        shown="grounded",
        rare=True,
    )
    subgoal_options: tuple[str, ...] = setting(
        (),
        name="--subgoal-option",
        whole=True,
        metavar="NAME=VALUE",
        group=_SUBGOALS,
        help="Options of the writer, such as frames=32 or response_s=60.",
    )
    no_probe: bool = setting(
        False, group=_EXECUTION, help="Do not test before the run whether a state survives a reset."
    )
    videos: bool = setting(False, group=_EXECUTION, help="Write a video of each rollout.")
    check_lesson: bool = setting(
        False,
        group=_SIMULATOR,
        help="Compare each lesson with the simulator's playback, bit for bit.",
        rare=True,
    )
    simulator_timeout_s: float = setting(
        1800.0, group=_SIMULATOR, help="Maximum seconds of a reset, or of 16 steps.", rare=True
    )
    history_chunk: int = setting(
        64,
        group=_EXECUTION,
        metavar="N",
        help="History frames that the policy gets at a time.",
        rare=True,
    )


@dataclass(frozen=True)
class AskConfig(WorkConfig):
    """The settings of a run of questions: the model, and what it sees of the past."""

    model: str = setting(
        group=_MODEL,
        help="openai:URL#MODEL, transformers:ID or transformers:FOLDER; recall (the ideal "
        "observer), guess, or in days abstain (it was not shown).",
    )
    buffer_set: str = setting(
        name="-",
        metavar="BUFFER_SET",
        help="Folder of the buffer set, or NAMESPACE/NAME, with its questions.",
    )
    out: Path = setting(help="Folder of the run; an existing run resumes.")
    memory: str = setting(
        "framesamp:32", group=_MODEL, help=f"Frames in memory, with the current one: {MEMORY_FORM}."
    )
    control: str = setting(
        "none", group=_MODEL, help="blank: history frames are gray; text: no images at all."
    )
    prompt: str = setting("choice", group=_MODEL, metavar="NAME|FILE", help="Prompt of the model.")
    model_options: tuple[str, ...] = setting(
        (),
        name="--model-option",
        whole=True,
        metavar="NAME=VALUE",
        group=_MODEL,
        help="Options of the model, such as max_tokens=64 or response_s=60.",
    )

    simulator: ClassVar[str] = QUESTIONS
    """The simulator in their rows: they are not rollouts."""

    shift: ClassVar[str] = NO_SHIFT


@dataclass(frozen=True)
class CeilingConfig(RetrievalConfig):
    """The settings of a ceiling: which memory, and which buffers."""

    memory: str = setting("framesamp:32", help=f"{MEMORY_FORM}.")
    frames: int = setting(1, help="Kept frames of a part of the answer that make it known.")
    conditions: tuple[str, ...] = setting((), help="Conditions; default: all of the buffer set.")
    shift: str = setting(NO_SHIFT, help=SHIFT_HELP)


def check_shared(config: WorkConfig) -> None:
    """Check the settings that rollouts and questions share."""
    positive = ("workers", "max_errors", "rollout_timeout_s")
    for name in (*positive, "history_chunk", "simulator_timeout_s"):
        value = getattr(config, name, 1)  # questions have no simulator
        if not 0 < value < math.inf:
            raise InvalidOptionError.expected(
                name, value, "a number above 0", "Leave it out for the default."
            )
    if config.split not in SPLITS:
        raise InvalidOptionError.one_of("split", config.split, SPLITS)
    check_retrieval(config)


def check_retrieval(config: RetrievalConfig) -> None:
    """Check the names of encoder and rule, without the encoder's library."""
    # Here, because every command imports this module, for its options.
    from robomme_interference_data.retrieval.encoders import encoder_name
    from robomme_interference_data.retrieval.select import Rule

    if config.retrieval is not None:
        encoder_name(config.retrieval)
    Rule.parse(config.retrieval_rule)
    non_default_retrieval(config)


def check_unused(config: WorkConfig, names: Iterable[str], on: str, hint: str) -> None:
    """Raise an error if one of some settings, which have no effect on a run, is set."""
    defaults = {field.name: field.default for field in fields(config)}
    for name in names:
        if getattr(config, name) != defaults[name]:
            raise InvalidOptionError(f"{named(name)} has no effect on {on}", hint)


def with_camera[C: RetrievalConfig](config: C, buffer_set: "BufferSet") -> C:
    """Return the settings with the name of the retrieval step's camera, by default the first."""
    if config.retrieval is None:
        return config
    dataset = buffer_set.datasets[DEMONSTRATIONS]
    camera = dataset.camera(config.retrieval_camera, "retrieval_camera")
    return replace(config, retrieval_camera=camera)


def non_default_retrieval(config: RetrievalConfig) -> dict[str, str]:
    """Return the settings of the retrieval step that are not the paper's."""
    changed = {}
    if config.retrieval_rule != RetrievalConfig.retrieval_rule:
        changed["retrieval_rule"] = config.retrieval_rule
    if config.retrieval_camera not in (None, "front"):
        changed["retrieval_camera"] = config.retrieval_camera
    if changed and config.retrieval is None:
        raise InvalidOptionError(
            f"{named(next(iter(changed)))} has no effect without a retrieval step",
            f"Set {named('retrieval')}, such as siglip, or leave it out.",
        )
    return changed


def with_retrieval(name: str, config: RetrievalConfig) -> str:
    """Return a system's default name with the retrieval step: `retrieval-…`, then its changes."""
    if config.retrieval is None:
        return name
    return "-".join(("retrieval", name, *non_default_retrieval(config).values())).replace("/", "-")
