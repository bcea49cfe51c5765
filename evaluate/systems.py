"""The systems of the paper, and the benchmark's own controls, as data.

A system is a policy together with its memory mechanism. Its name labels the rows of a run; a name
of this table implies the conditions and limits in it.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

from robomme_interference_data.constants import MAX_STEPS, POSITION_LIMIT
from robomme_interference_data.errors import InvalidIdError, InvalidOptionError
from robomme_interference_data.schema.conditions import NO_HISTORY
from robomme_interference_data.schema.sampling import Memory

_FREE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


@dataclass(frozen=True)
class System:
    """One system.

    Attributes:
        name: Name in rows, options and file names.
        display: Name in tables and figures.
        representation: Content of the memory, such as `frames` or `tokens`; `none` without memory.
        integration: How the memory enters the policy: `modulator`, `context`, `expert`,
            `subgoals`, or None.
        with_history: Whether conditions other than `no-history` apply.
        subgoals: Output of a vision-language model in front of the policy: `simple_subgoal`,
            `grounded_subgoal`, or None without a model.
        retrieval: Whether a retrieval step selects what the memory gets.
        step: Changes of that step from the paper's, in the name of a control, such as `joined`.
        sampling: Spelling of the `Memory` by which it keeps frames; None if unknown, or if it
            keeps none.
        position_limit: Maximum history and live frames together in memory; None: no limit.
        paper: Whether the paper reports it.
        reference: Whether it is a reference only: with the answer, with what a memory shows of it,
            by chance, or without motion. Such a system is never ranked.
    """

    name: str
    display: str
    representation: str
    integration: str | None = None
    with_history: bool = True
    subgoals: str | None = None
    retrieval: bool = False
    step: str = ""
    sampling: str | None = None
    position_limit: int | None = None
    paper: bool = False
    reference: bool = False

    @property
    def keeps_frames(self) -> bool | None:
        """Whether its released server keeps frames; None if no server was released."""
        return self.position_limit is not None if self.paper else None

    def applies(self, condition: str) -> bool:
        """Whether a condition applies: retrieval needs a history, a system without memory none."""
        return not self.retrieval if condition == NO_HISTORY else self.with_history


def _released(
    name: str, display: str, memory: str, integration: str, *, retrieval: bool = False
) -> System:
    """A system whose server keeps frames, with an embedding for each of 4096 positions."""
    return System(
        *(name, display, memory, integration),
        retrieval=retrieval,
        position_limit=POSITION_LIMIT,
        paper=True,
        sampling="framesamp" if memory == "frames" else None,
    )


def _symbolic(name: str, display: str, memory: str, subgoals: str) -> System:
    """A system whose server has no memory: the model in front of it reads the history."""
    return System(name, display, memory, "subgoals", subgoals=subgoals, paper=True)


PAPER_SYSTEMS: tuple[System, ...] = (
    System("pi05_baseline", "π0.5 (baseline)", "none", with_history=False, paper=True),
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
        *("retrieval-framesamp-modul", "Retrieval-FrameSamp-Modul"),
        *("frames", "modulator"),
        retrieval=True,
    ),
)
"""The twelve systems of the paper's main table in its order, then the one with retrieval."""

_KEPT = {"Full": "all frames", "FrameSamp": "frames", "Window": "last frames"}


def _control(kind: str, *, retrieval: bool, reference: bool = False) -> tuple[System, ...]:
    """A control with each memory rule."""
    name = f"Retrieval-{kind}" if retrieval else kind
    return tuple(
        System(
            *(f"{name}-{rule}".lower(), f"{name}-{rule}", frames),
            retrieval=retrieval,
            sampling=rule.lower(),
            reference=reference,
        )
        for rule, frames in _KEPT.items()
    )


_CONTROLS = (
    *(
        System(name.lower(), name, "none", reference=True)
        for name in (
            *("Oracle", "Guess", "Noop"),
            *("Follow-Subgoals", "Follow-Subgoals-Oracle", "Follow-Subgoals-Oracle-Simple"),
        )
    ),
    *_control("Replay", retrieval=False),
    *_control("Replay", retrieval=True),
    *_control("Recall", retrieval=False, reference=True),
    *_control("Recall", retrieval=True, reference=True),
    System("questions-guess", "Questions-Guess", "none", reference=True),
    System(
        *("retrieval-questions-guess", "Retrieval-Questions-Guess", "none"),
        retrieval=True,
        reference=True,
    ),
    *_control("Questions-Recall", retrieval=False, reference=True),
    *_control("Questions-Recall", retrieval=True, reference=True),
    # Baselines along recordings.
    System("hold", "Hold", "none", with_history=False, reference=True),
    System("mean", "Mean", "none", with_history=False, reference=True),
)

_SIZE = re.compile(r"(?:(?<=-framesamp)|(?<=-window))[0-9]+")
"""The size of a memory in the name of a control, as in `replay-window8`; see `Memory.label`."""

SYSTEMS: dict[str, System] = {system.name: system for system in (*PAPER_SYSTEMS, *_CONTROLS)}
"""Name to system: the paper's, then the built-in policies. The order is that of tables."""


def known_system(name: str) -> System | None:
    """Return a system of the table, or a control with another memory or retrieval step; else None.

    The change follows the control's name, as in `retrieval-replay-window8-joined`.
    """
    size = _SIZE.search(name)
    if size is not None:
        usual = known_system(_SIZE.sub("", name, count=1))
        if usual is None or usual.sampling is None or usual.paper:
            return None
        display = f"{usual.display} ({size.group()} frames)"
        sampling = f"{usual.sampling}:{size.group()}"
        return replace(usual, name=name, display=display, sampling=sampling)
    for control in _CONTROLS:
        step = name.removeprefix(f"{control.name}-")
        if control.retrieval and step != name:
            return replace(control, name=name, display=f"{control.display} ({step})", step=step)
    return SYSTEMS.get(name)


def name_system(name: str) -> System:
    """Return a system of the table, or one with a new name, without conditions and limits."""
    if not _FREE_NAME.fullmatch(name):
        raise InvalidIdError(
            f"{name!r} is not the name of a system",
            "Expected up to 64 letters, digits, '.', '_' and '-', such as my-memory.",
        )
    return known_system(name) or System(name, name, "own")


def display_name(name: str) -> str:
    """Return the name for tables and figures; a new name stays unchanged."""
    known = known_system(name)
    return name if known is None else known.display


def base_of(name: str) -> str | None:
    """Return the system without the retrieval step; None for one that has none."""
    known = known_system(name)
    if known is None or not known.retrieval:
        return None
    if _SIZE.search(name) and known.sampling is not None:
        usual, memory = base_of(_SIZE.sub("", name, count=1)), Memory.parse(known.sampling)
        return usual and usual.replace(memory.rule, memory.label)
    plain = name.removeprefix("retrieval-")
    base = next((one for one in SYSTEMS if plain.startswith(one)), f"perceptual-{plain}")
    # An option of the policy, which it has without retrieval too.
    option = "-extrapolate"
    return base + option * plain.startswith(base + option)


def is_reference(name: str) -> bool:
    """Whether a system is only a reference, see `System.reference`; a new one never is."""
    known = known_system(name)
    return known is not None and known.reference


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
