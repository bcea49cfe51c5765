"""The settings of a run, each declared once: what Python gives, and the options of `evaluate`."""

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import ClassVar

from robomme_interference_data.constants import SAMPLE_FRAMES, SPLITS
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.runtime.executor import WorkersConfig
from robomme_interference_data.schema.settings import setting
from robomme_interference_data.schema.shifts import NO_SHIFT, SHIFT_HELP


@dataclass(frozen=True, kw_only=True)
class RetrievalConfig:
    """The retrieval step in front of a policy, or of a memory."""

    retrieval: str | None = setting(None, help="Put a retrieval step with this encoder in front.")
    retrieval_rule: str = setting("max", help="METHOD or METHOD/CUT, as for retrieval-score.")
    retrieval_camera: str = setting(
        "front", help="Camera whose frames the retrieval step compares."
    )


@dataclass(frozen=True, kw_only=True)
class WorkConfig(WorkersConfig, RetrievalConfig):
    """Which episodes and conditions, under which name, and how the work is done."""

    conditions: tuple[str, ...] = setting(
        (), help="no-history, k0, k1, …; by default all that apply."
    )
    families: tuple[str, ...] = setting((), help="Families; by default all.")
    episodes: str | None = setting(None, help="Numbers, such as 0-49 or 0,3,10-12; default: all.")
    split: str = setting("test", help="train, val or test.")
    shard: str = setting("1/1", help="Part of the plan to run, such as 2/8; see merge.")
    system: str | None = setting(None, help="Name for the rows; see docs/systems.md.")
    model_seed: int = setting(0, help="Seed for what is drawn at random.")
    rollout_timeout: float = setting(
        3600.0, help="Seconds that a rollout, or a question, may take."
    )
    cache: bool = setting(False, help="Keep decoded history frames on disk: later runs are faster.")
    max_errors: int = setting(10, help="Errors in a row after which the run stops.", metavar="N")
    no_resume: bool = setting(False, help="Refuse a folder that holds a run already.")


@dataclass(frozen=True)
class RunConfig(WorkConfig):
    """What to roll out, and how."""

    policy: str = setting(
        help="replay, recall (both also with :framesamp or :window), oracle, guess, follow-subgoals, noop, "
        "websocket://HOST:PORT (several with commas), websocket with --serve, "
        "lerobot:REPO[@REVISION], lerobot:FOLDER or python:module:factory."
    )
    buffer_set: str = setting(
        name="-", metavar="BUFFER_SET", help="Folder of the buffer set, or its NAMESPACE/NAME."
    )
    out: Path = setting(help="Folder of the run; an earlier run is gone on with.")
    simulator: str = setting("tabletop", help="tabletop, robomme or module:function of your own.")
    shift: str = setting(NO_SHIFT, help=SHIFT_HELP)
    policy_options: tuple[str, ...] = setting(
        (),
        name="--policy-option",
        whole=True,
        metavar="NAME=VALUE",
        help="Options of the policy, such as device=cpu or response_s=60.",
    )
    serve: str | None = setting(
        None,
        metavar="COMMAND",
        help="Starts the server of --policy websocket, beside each worker: a command with {port}.",
    )
    subgoals: str | None = setting(
        None,
        help="What writes subgoals for the policy: openai:URL#MODEL, transformers:ID or oracle.",
    )
    subgoal_prompt: str | None = setting(
        None,
        metavar="NAME|FILE",
        help="How a model is asked: simple, grounded, memer or a file; see docs/subgoals.md.",
        shown="as the system's",
    )
    subgoal_options: tuple[str, ...] = setting(
        (),
        name="--subgoal-option",
        whole=True,
        metavar="NAME=VALUE",
        help="Options of what writes subgoals, such as frames=32 or response_s=60.",
    )
    robomme_python: str | None = setting(
        None, help="Interpreter that has RoboMME.", env="ROBOMME_PYTHON"
    )
    videos: bool = setting(False, help="Write a video of each rollout.")
    check_lesson: bool = setting(
        False, help="Compare each lesson with what the simulator plays, bit for bit."
    )
    simulator_timeout: float = setting(
        1800.0, help="Seconds that a reset, or 16 steps, may take before the simulator hung."
    )
    history_chunk: int = setting(64, help="Frames of history handed over at a time.", metavar="N")


@dataclass(frozen=True)
class AskConfig(WorkConfig):
    """Which questions are asked, of whom, and what is shown of the past."""

    model: str = setting(
        help="openai:URL#MODEL, transformers:ID or transformers:FOLDER; recall, the ideal "
        "observer, or guess."
    )
    buffer_set: str = setting(
        name="-", metavar="BUFFER_SET", help="Folder of the buffer set, with its questions."
    )
    out: Path = setting(help="Folder of the run; an earlier run is gone on with.")
    frames: int = setting(
        SAMPLE_FRAMES, help="Frames that are kept, that of now among them.", metavar="N"
    )
    sampling: str = setting("framesamp", help="Which are kept: full, framesamp or window.")
    control: str = setting(
        "none", help="blank: the history's frames are grey; text: no images at all."
    )
    prompt: str = setting("choice", metavar="NAME|FILE", help="How a model is asked.")
    model_options: tuple[str, ...] = setting(
        (),
        name="--model-option",
        whole=True,
        metavar="NAME=VALUE",
        help="Options of the model, such as max_tokens=64 or response_s=60.",
    )

    simulator: ClassVar[str] = "questions"
    """What their rows have for a simulator: they are not rollouts."""

    shift: ClassVar[str] = NO_SHIFT
    videos: ClassVar[bool] = False


@dataclass(frozen=True)
class CeilingConfig(RetrievalConfig):
    """Of which memory a ceiling is, and of which buffers."""

    memory: str = setting("framesamp", help="full, framesamp or window.")
    conditions: tuple[str, ...] = setting((), help="Conditions; by default all that are planned.")
    shift: str = setting(NO_SHIFT, help=SHIFT_HELP)


def check_shared(config: WorkConfig) -> None:
    """Check the settings that both kinds of work share, by themselves."""
    from robomme_interference_data.retrieval.select import Rule

    for name in ("workers", "history_chunk", "max_errors", "rollout_timeout", "simulator_timeout"):
        value = getattr(config, name, 1)
        if not 0 < value < math.inf:
            raise InvalidOptionError.expected(
                name, value, "more than 0", "Leave it out for the default."
            )
    if config.split not in SPLITS:
        raise InvalidOptionError.one_of("split", config.split, SPLITS)
    Rule.parse(config.retrieval_rule)
    non_default_retrieval(config)


def non_default_retrieval(config: RetrievalConfig) -> dict[str, str]:
    """Return the settings of the retrieval step that are not the paper's."""
    defaults = {one.name: one.default for one in fields(RetrievalConfig) if one.name != "retrieval"}
    found = {name: value for name in defaults if (value := getattr(config, name)) != defaults[name]}
    for name in found if config.retrieval is None else ():
        raise InvalidOptionError(
            f"`{name}` has no effect without a retrieval step",
            'Set `retrieval`, such as retrieval="siglip", or leave it out.',
        )
    return found
