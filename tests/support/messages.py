"""Errors in tests: the class stands in the test, the text in one golden file.

A test says `with raises(FormatError):` and holds the class and its fields. What the error says is
compared with `golden/messages.json`, so that a sentence is changed in one place and its change is
read in one diff: `pytest --write-messages` writes the sentences of the tests that it runs.
"""

import hashlib
import json
import os
import re
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock

from robomme_interference_data.errors import InterferenceError

GOLDEN_MESSAGES = Path(__file__).parents[1] / "golden" / "messages.json"

_LONGEST_ID = 200

_PROJECT = Path(__file__).parents[2]

_NAME = r"[^\s\"',;:()`]*"
"""A part of a path."""

# What differs from run to run, or from machine to machine.
_VARYING = (
    # A folder of a test, or of a fixture: their number depends on the tests that ran before.
    (
        re.compile(r"/[^\s'\",;:()`]*/pytest-\d+/(?:popen-gw\d+/)?[^\s/'\",;:()`]+?\d+(?![\w.-])"),
        "TMP",
    ),
    (re.compile(re.escape(str(_PROJECT))), "PROJECT"),
    (re.compile(r"(127\.0\.0\.1|localhost|\[::1\]):\d+"), r"\1:PORT"),
    (re.compile(r"\bprocess \d+\b"), "process ID"),
    # How a connection ends depends on which side is faster.
    (re.compile(r"(closed the connection: ).*", re.DOTALL), r"\1REASON"),
    (re.compile(r"(cannot be reached: )(\[Errno|Server disconnected|it does not).*"), r"\1REASON"),
    (re.compile(r"\b0x[0-9a-f]{6,}\b"), "ADDRESS"),
    (re.compile(r"\b[0-9a-f]{12,64}\b"), "DIGEST"),
)


@dataclass
class _Run:
    """A run of pytest: whether it writes the golden file, and the messages of each test."""

    writes: bool = False
    seen: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))


_run = _Run()


def configure(config: pytest.Config) -> None:
    """Take the option of this run of pytest."""
    _run.writes = config.getoption("--write-messages")


def write_messages() -> None:
    """Write what was seen, if `--write-messages` was given; tests that did not run keep theirs."""
    if not _run.writes or not _run.seen:
        return
    with FileLock(f"{GOLDEN_MESSAGES}.lock"):
        golden = _golden() | _run.seen
        text = json.dumps(dict(sorted(golden.items())), indent=1, ensure_ascii=False)
        GOLDEN_MESSAGES.write_text(f"{text}\n")


def _golden() -> dict[str, list[str]]:
    if not GOLDEN_MESSAGES.exists():
        return {}
    golden: dict[str, list[str]] = json.loads(GOLDEN_MESSAGES.read_text())
    return golden


def stable(text: str) -> str:
    """Return a message without folders, ports, addresses and digests."""
    for pattern, name in _VARYING:
        text = pattern.sub(name, text)
    return text


def _short(test: str) -> str:
    """Return the id of a test, whose parameters may be long texts."""
    if len(test) <= _LONGEST_ID:
        return test
    return f"{test[:_LONGEST_ID]}-{hashlib.sha256(test.encode()).hexdigest()[:8]}"


@contextmanager
def raises(
    kind: type[BaseException] | tuple[type[BaseException], ...],
) -> Iterator[pytest.ExceptionInfo[Any]]:
    """Expect an error of a class, whose message is the golden one of this place in this test."""
    with pytest.raises(kind) as raised:
        yield raised
    error = raised.value
    text = error.message if isinstance(error, InterferenceError) else str(error)
    message = f"{type(error).__name__}: {stable(text)}"
    test = _short(os.environ["PYTEST_CURRENT_TEST"].rpartition(" (")[0])
    place = len(_run.seen[test])
    _run.seen[test].append(message)
    if not _run.writes:
        known = _golden().get(test, [])
        assert place < len(known), f"no golden message: pytest --write-messages {test}"
        assert message == known[place]
