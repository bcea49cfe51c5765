"""What a system is, as columns of its rows; and the systems that are known by name.

A system is a policy together with its memory mechanism. Its name is only the label of its rows:
`SystemFacts` are columns of the rows, and scores are paired by them. Rows of others may have a name
alone: `SYSTEMS` is the one table that maps names to facts.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Annotated

from robomme_interference_data.constants import MAX_STEPS, ORACLE, POSITION_LIMIT
from robomme_interference_data.errors import InvalidIdError, InvalidOptionError
from robomme_interference_data.schema.conditions import NO_HISTORY

_FREE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


@dataclass(frozen=True, kw_only=True)
class SystemFacts:
    """What a system is. Systems that agree in all facts but one differ in that one alone."""

    policy: Annotated[
        str | None,
        "Kind of the policy, such as `replay` or `websocket`; for questions, of the model. None if "
        "unknown.",
    ] = None
    policy_id: Annotated[
        str | None,
        "What identifies the policy among those of its kind: a digest of its options, metadata and "
        "files, without where it runs. Of published rows a name. None if unknown.",
    ] = None
    training_step: Annotated[
        int | None, "Step of the training run that the weights are of, or None if unknown."
    ] = None
    memory: Annotated[
        str | None,
        "Rule by which the memory keeps frames, such as `full`, `framesamp:32` or `window:60@2`; "
        "None if unknown, or if it keeps no frames.",
    ] = None
    retrieval: Annotated[
        str | None,
        "Encoder, camera if it is not `front`, and rule of the retrieval step, such as "
        "`siglip@wrist/max/0.923`; None without one.",
    ] = None
    subgoals: Annotated[
        str | None,
        "What writes the policy's subgoals: `oracle`, `oracle in words`, or kind of the model and "
        "digest of model, prompt and options; None without subgoals.",
    ] = None
    reads_history: Annotated[
        bool, "Whether it reads the history; if not, only `no-history` applies."
    ] = True
    reference: Annotated[
        bool,
        "Whether it is only a reference, which is never ranked: with the answer, with what a "
        "memory shows of it, by chance, or without motion.",
    ] = False

    def applies(self, condition: str) -> bool:
        """Whether a condition applies: a retrieval step needs a history."""
        return self.retrieval is None if condition == NO_HISTORY else self.reads_history


FACT_COLUMNS = tuple(field.name for field in fields(SystemFacts))
"""Names of the columns of `SystemFacts`."""


@dataclass(frozen=True)
class System:
    """A system that is known by name, or one with a new name.

    Attributes:
        name: Name in rows, options and file names.
        display: Name in tables and figures.
        representation: Content of the memory, such as `frames` or `tokens`; `none` without memory.
        integration: How the memory enters the policy: `modulator`, `context`, `expert`,
            `subgoals`, or None.
        facts: The facts of rows that have nothing but this name.
        base: Name of the published system without the retrieval step; None without one.
        position_limit: Maximum history and live frames together in memory; None: no limit.
        paper: Whether the paper reports it.
        elsewhere: Whether others published it, with the memory in its facts.
    """

    name: str
    display: str
    representation: str
    integration: str | None = None
    facts: SystemFacts = SystemFacts()
    base: str | None = None
    position_limit: int | None = None
    paper: bool = False
    elsewhere: bool = False

    @property
    def keeps_frames(self) -> bool | None:
        """Whether its released server keeps frames; None if no server was released."""
        return self.position_limit is not None if self.paper else None


def _released(
    name: str,
    display: str,
    representation: str,
    integration: str,
    *,
    base: str | None = None,
    retrieval: str | None = None,
) -> System:
    """A system whose server keeps frames, with an embedding for each of 4096 positions."""
    return System(
        name,
        display,
        representation,
        integration,
        facts=SystemFacts(
            policy="websocket",
            policy_id=base or name,
            memory="framesamp:32" if representation == "frames" else None,
            retrieval=retrieval,
        ),
        base=base,
        position_limit=POSITION_LIMIT,
        paper=True,
    )


def _symbolic(name: str, display: str, representation: str, subgoals: str) -> System:
    """A system whose server has no memory: the model in front of it reads the history."""
    facts = SystemFacts(policy="websocket", policy_id=name, subgoals=subgoals)
    return System(name, display, representation, "subgoals", facts=facts, paper=True)


PAPER_SYSTEMS: tuple[System, ...] = (
    System(
        "pi05_baseline",
        "π0.5 (baseline)",
        "none",
        facts=SystemFacts(policy="websocket", policy_id="pi05_baseline", reads_history=False),
        paper=True,
    ),
    _released("perceptual-framesamp-modul", "FrameSamp-Modul", "frames", "modulator"),
    _released("perceptual-tokendrop-modul", "TokenDrop-Modul", "tokens", "modulator"),
    _released("perceptual-framesamp-context", "FrameSamp-Context", "frames", "context"),
    _released("perceptual-framesamp-expert", "FrameSamp-Expert", "frames", "expert"),
    _released("perceptual-tokendrop-context", "TokenDrop-Context", "tokens", "context"),
    _released("perceptual-tokendrop-expert", "TokenDrop-Expert", "tokens", "expert"),
    _released("recurrent-ttt-expert", "Recurrent-TTT-Expert", "hidden state", "expert"),
    _released("recurrent-ttt-context", "Recurrent-TTT-Context", "hidden state", "context"),
    _symbolic("symbolic-simplesg", "SimpleSG", "text", "simple_subgoal"),
    _symbolic("symbolic-groundsg", "GroundSG", "text with points", "grounded_subgoal"),
    _symbolic("memer", "MemER", "text with points and key frames", "grounded_subgoal"),
    _released(
        "retrieval-framesamp-modul",
        "Retrieval-FrameSamp-Modul",
        "frames",
        "modulator",
        base="perceptual-framesamp-modul",
        retrieval="siglip-so400m/visual-episodic-absthr",
    ),
)
"""The twelve systems of the paper's main table in its order, then the one with retrieval."""


def _without_memory(
    policy: str, subgoals: str | None = None, *, label: str = "", reads_history: bool = True
) -> System:
    """A reference without a memory of its own."""
    facts = SystemFacts(
        policy=policy,
        policy_id=policy,
        subgoals=subgoals,
        reads_history=reads_history,
        reference=True,
    )
    label = label or policy
    return System(label, label.title(), "none", facts=facts)


_MEMORIES = {
    "Full": ("full", "all frames"),
    "FrameSamp": ("framesamp:32", "frames"),
    "Window": ("window:32", "last frames"),
}


def _with_memory(
    display: str, policy: str, rule: str, *, option: str = "", retrieval: bool = False
) -> System:
    """A built-in policy, or the ideal observer of questions, with a memory."""
    memory, representation = _MEMORIES[rule]
    display = "-".join(filter(None, (display, rule, option.title())))
    facts = SystemFacts(
        policy=policy,
        policy_id=f"{policy} {option}".strip(),
        memory=memory,
        retrieval="thumbnail/max/adaptive" if retrieval else None,
        reference=policy == "recall",
    )
    return System(display.lower(), display, representation, facts=facts)


def _with_memories(display: str, policy: str, *, retrieval: bool = False) -> list[System]:
    """The same with each memory."""
    return [_with_memory(display, policy, rule, retrieval=retrieval) for rule in _MEMORIES]


_CONTROLS = (
    _without_memory("oracle"),
    _without_memory("guess"),
    _without_memory("noop"),
    _without_memory("follow-subgoals"),
    _without_memory("follow-subgoals", ORACLE, label="follow-subgoals-oracle"),
    _without_memory("follow-subgoals", f"{ORACLE} in words", label="follow-subgoals-oracle-simple"),
    *_with_memories("Replay", "replay"),
    *_with_memories("Retrieval-Replay", "replay", retrieval=True),
    *_with_memories("Recall", "recall"),
    *_with_memories("Retrieval-Recall", "recall", retrieval=True),
    _without_memory("guess", label="questions-guess"),
    *_with_memories("Questions-Recall", "recall"),
    *_with_memories("Retrieval-Questions-Recall", "recall", retrieval=True),
    # Baselines along recordings.
    _without_memory("hold", reads_history=False),
    _without_memory("mean", reads_history=False),
    # Rows of these are published in docs/results, in the layout of the released ones.
    _with_memory("Replay", "replay", "FrameSamp", option="extrapolate"),
    _with_memory("Retrieval-Replay", "replay", "FrameSamp", option="extrapolate", retrieval=True),
)


def _elsewhere(name: str, display: str, memory: str, *, integration: str | None = None) -> System:
    """A system with a window of frames that the paper does not report."""
    facts = SystemFacts(policy_id=name, memory=memory)
    return System(name, display, "last frames", integration, facts=facts, elsewhere=True)


_OTHERS = (
    # The last 60 s at 2 frames per second, of frames that it counts as 20 per second.
    _elsewhere("simplememvla", "SimpleMemVLA", "window:120@1", integration="context"),
    # LeRobot's pi05 with six frames a second apart: memory_frames=6, memory_stride=10.
    _elsewhere("pi05-mem", "π0.5-MEM", "window:6@1"),
)

SYSTEMS: dict[str, System] = {
    system.name: system for system in (*PAPER_SYSTEMS, *_CONTROLS, *_OTHERS)
}
"""Name to system: the paper's, the built-in policies, others. The order is that of tables."""


def name_system(name: str) -> System:
    """Return a system of the table, or one with a new name, of which nothing else is known."""
    if not _FREE_NAME.fullmatch(name):
        raise InvalidIdError(
            f"{name!r} is not the name of a system",
            "Expected up to 64 letters, digits, '.', '_' and '-', such as my-memory.",
        )
    return SYSTEMS.get(name) or System(name, name, "own")


def display_name(name: str) -> str:
    """Return the name for tables and figures; a new name stays unchanged."""
    return SYSTEMS[name].display if name in SYSTEMS else name


def published_base(name: str) -> str | None:
    """Return the published system that a published system has a retrieval step in front of."""
    return SYSTEMS[name].base if name in SYSTEMS else None


def check_history(system: System, frames: Mapping[str, int]) -> None:
    """Check that the longest history of each condition and a rollout fit into the positions."""
    limit = system.position_limit
    over = [
        f"{count} frames under {name}"
        for name, count in frames.items()
        if limit is not None and count + MAX_STEPS > limit
    ]
    if over:
        raise InvalidOptionError(
            f"{system.name} has {limit} positions: {MAX_STEPS} steps leave no room for a history "
            f"of {', '.join(over)}",
            "Leave out those conditions or episodes, or run a system without such a limit.",
        )
