"""What the files of a run say, without its rows: `run.json`, and which lines of the record count.

Scores read rows of their own, and so need no more of a run than this.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from robomme_interference_data.constants import MAX_ROW_BYTES, QUESTIONS
from robomme_interference_data.errors import FormatError
from robomme_interference_data.evaluate.probe.result import Probe, probe_text
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.storage.text import read_bytes

from .plan import RunPlan, WorkItem

_MAX_ROLLOUTS = 1 << 20
"""Maximum rollouts of all plans of a run: the paper's grid has 25,200."""


@dataclass(frozen=True)
class Invocation:
    """One invocation of the command: its settings, its plan, and where it ran.

    Attributes:
        command: The command line; empty from Python.
        versions: Of Python, this package, what it used, and the simulator.
        git: Commit of the source tree, with `-dirty` if it was changed; None if there is none.
        policy: Metadata of the policy.
        started: When, UTC, `2026-01-31T12:00:00Z`.
        ended: When; None while it runs, or if it was killed.
        stopped: Why it ended early, or None.
    """

    command: tuple[str, ...]
    settings: dict[str, Any]
    plan: RunPlan
    versions: dict[str, str]
    git: str | None
    machine: str
    policy: dict[str, Any]
    started: str
    ended: str | None = None
    stopped: str | None = None


@dataclass(frozen=True)
class RunHeader:
    """`run.json`.

    Attributes:
        identity: What can change a result: it identifies the run.
        buffer_set: Label of the buffer set in all rows.
        plans: The plans of all invocations, each once.
        status: `running`, `complete`, or, if something is missing or broke, `incomplete`.
        planned: Rollouts of all plans together.
        counts: Rows by status.
        invocations: One for each time that the command was started or resumed.
        merged: Names of the folders that a merged run is made of.
        probe: What the leak probe found; None if the run was not probed.
    """

    format_version: int
    identity: dict[str, Any]
    buffer_set: str
    plans: tuple[RunPlan, ...] = ()
    status: str = "running"
    planned: int = 0
    counts: dict[str, int] = field(default_factory=dict)
    invocations: tuple[Invocation, ...] = ()
    merged: tuple[str, ...] = ()
    probe: Probe | None = None

    def __post_init__(self) -> None:
        planned = sum(plan.most for plan in self.plans)
        if planned > _MAX_ROLLOUTS:
            raise FormatError(f"plans of {planned} rollouts; expected at most {_MAX_ROLLOUTS}")

    @property
    def items(self) -> tuple[WorkItem, ...]:
        """All planned rollouts, each once, in canonical order."""
        return tuple(sorted({item for plan in self.plans for item in plan.items()}))

    @property
    def probed(self) -> str | None:
        """What the probe found, in a sentence; None for questions, which are not probed."""
        return None if self.identity.get("simulator") == QUESTIONS else probe_text(self.probe)

    @property
    def probe_note(self) -> str | None:
        """A sentence for readers of scores, unless all was probed and no state survives a reset."""
        if self.probe is None or self.probe.all_independent:
            return None
        return f"Leak probe of {self.identity.get('system')}: {probe_text(self.probe)}."


def whole_lines(record: Path) -> bytes:
    """Return the bytes of `rollouts.jsonl`, without a last line that a crash cut short."""
    data = read_bytes(record, MAX_ROW_BYTES)
    return data[: data.rfind(b"\n") + 1]


def rows_that_count(rollouts: Sequence[Hashable], statuses: Sequence[str]) -> list[int]:
    """Return which rows of a record count: all finished ones, and of other rollouts the last row.

    A rollout that broke runs again, and its earlier rows stay in the record.
    """
    last = {rollout: place for place, rollout in enumerate(rollouts)}
    return [
        place
        for place, (rollout, status) in enumerate(zip(rollouts, statuses, strict=True))
        if status != Status.ERROR or last[rollout] == place
    ]
