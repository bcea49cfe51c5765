"""The goal of a LeRobot episode, from its tasks and the wordings that a dataset keeps. Pure rules.

The tasks of an episode's frames, which LeRobot returns with each frame, are the truth: LeRobot's
tools change them, and leave columns that they do not know behind.
"""

import unicodedata
from collections.abc import Callable, Sequence

from robomme_interference_data.errors import InvalidOptionError, SourceError, named

SEVERAL_TASKS: dict[str, Callable[[Sequence[str]], tuple[str, ...]]] = {
    "wordings": tuple,
    "joined": lambda tasks: ("; ".join(tasks),),
    "first": lambda tasks: (tasks[0],),
    "last": lambda tasks: (tasks[-1],),
}
"""What the wordings of the goal are if an episode has several tasks, by the name of the choice."""


def check_choice(choice: str | None) -> None:
    """Check the name of a choice of `SEVERAL_TASKS`; None for none.

    Raises:
        InvalidOptionError: There is no such choice.
    """
    if choice is not None and choice not in SEVERAL_TASKS:
        raise InvalidOptionError.one_of("several_tasks", choice, SEVERAL_TASKS)


def goal_wordings(
    tasks: Sequence[str], wordings: Sequence[str], choice: str | None
) -> tuple[str, ...]:
    """Return the wordings of an episode's goal.

    Args:
        tasks: Its tasks, in the order in which they begin.
        wordings: The wordings that the dataset keeps beside them, the first of which was the task
            when they were written; possibly none.
        choice: What several tasks are, see `SEVERAL_TASKS`.

    Raises:
        SourceError: There are several tasks and no choice.
    """
    if not tasks:
        return tuple(wordings)
    if len(tasks) > 1:
        if choice is None:
            raise SourceError(
                f"it has {len(tasks)} tasks: {', '.join(map(repr, tasks))}",
                f"State what they are, such as {named('several_tasks', 'joined')}: wordings of one "
                "goal, steps that are joined to one goal, or of which the first or the last is the "
                f"goal ({', '.join(SEVERAL_TASKS)}).",
            )
        return SEVERAL_TASKS[choice](tasks)
    if wordings and one_form(wordings[0]) == one_form(tasks[0]):
        return tuple(wordings)
    return tuple(tasks)


def one_form(text: str) -> str:
    """Return a text as it is compared: Unicode has several forms of letters such as ö."""
    return unicodedata.normalize("NFC", text)
