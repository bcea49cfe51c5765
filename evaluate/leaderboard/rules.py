"""The twelve rules of a submission: what each checks, and what to do where it does not hold.

Rules 9, 10 and 12 need the entry alone; the others read the rows, and are left out if the rows
cannot be read. No rule stops another one, so that a submission learns of all problems at once.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from . import checks
from .published import Case


@dataclass(frozen=True)
class SubmissionRule:
    """A rule.

    Attributes:
        number: Its number, from 1.
        name: What it is about, in a few words.
        fix: What to do where it does not hold.
        problems: Yields what does not hold, a sentence each.
        reads_rows: Whether it needs the rows.
    """

    number: int
    name: str
    fix: str
    problems: Callable[[Case], Iterator[str]]
    reads_rows: bool = True


@dataclass(frozen=True)
class BrokenRule:
    """Why a submission is not accepted."""

    system: str
    rule: SubmissionRule
    what: str

    def __str__(self) -> str:
        return f"{self.system}: rule {self.rule.number}, {self.rule.name}: {self.what}"


def check(case: Case) -> list[BrokenRule]:
    """Return everything that does not hold of a submission."""
    return [
        BrokenRule(case.submission.system, rule, what)
        for rule in RULES
        if case.readable or not rule.reads_rows
        for what in rule.problems(case)
    ]


RULES = (
    SubmissionRule(
        1,
        "protocol version",
        "Run it again with this version of the package: see docs/how-to/your-own-policy.md.",
        checks.protocol,
    ),
    SubmissionRule(
        2,
        "buffer set",
        "Run it on the board's buffer set, in its simulator and without a shift.",
        checks.buffer_set,
    ),
    SubmissionRule(
        3,
        "complete cells",
        "Run the same evaluate command again without --conditions, --families and --episodes.",
        checks.complete_cells,
    ),
    SubmissionRule(
        4,
        "one row for a rollout",
        "Leave out one of the runs, or merge their shards.",
        checks.duplicates,
    ),
    SubmissionRule(
        5,
        "few errors",
        "Run the same evaluate command again: it repeats what broke.",
        checks.few_errors,
    ),
    SubmissionRule(
        6, "probed for leaks", "Run it without --no-probe in a new folder.", checks.probed
    ),
    SubmissionRule(
        7,
        "no leak was found",
        "Let the policy forget everything at a reset, and run it in a new folder.",
        checks.independent,
    ),
    SubmissionRule(
        8,
        "histories of the buffer set",
        "Evaluate on the buffer set as it was published: see verify.",
        checks.histories,
    ),
    SubmissionRule(
        9,
        "repository and commit",
        "Publish the run with publish-results, and name namespace/name@COMMIT, all 40 digits.",
        checks.repository,
        reads_rows=False,
    ),
    SubmissionRule(
        10,
        "checkpoint",
        "Name the weights, and their SHA-256: sha256sum FILE.",
        checks.checkpoint,
        reads_rows=False,
    ),
    SubmissionRule(
        11, "rows as published", "Publish the run again, with a higher --version.", checks.unchanged
    ),
    SubmissionRule(
        12,
        "one system, as stated",
        "Choose a name of your own (--system of evaluate) or remove your older entry, and state "
        "what its rows state.",
        checks.stated_system,
        reads_rows=False,
    ),
)
"""All rules, in order."""
