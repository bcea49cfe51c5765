"""Make the entry of a submission from what its author gives."""

import os
from collections.abc import Sequence
from pathlib import Path

from robomme_interference_data.errors import InvalidOptionError, counted, named
from robomme_interference_data.storage.files import sha256_file
from robomme_interference_data.storage.hub import HubFiles, locate

from .entries import Entries, PublishedRun, Submission
from .published import Grid, Results


def new_submission(
    entries: Entries,
    results: Sequence[str],
    checkpoints: Sequence[str],
    weights: Sequence[Path],
    *,
    memory: str,
    trained_on: str,
) -> Submission:
    """Return the entry of some results: with the label of their rows, on the board of these.

    Args:
        entries: The file that the entry is for.
        results: Repositories of `publish-results`, with any revision, or folders; one for each
            training run.
        checkpoints: Where the weights of each are.
        weights: The file of weights of each, whose SHA-256 the entry states.
        memory: One of `MemoryKind`.
        trained_on: One of `TrainedOn`.

    Raises:
        InvalidOptionError: The numbers of values differ.
        HubError: The Hub does not know a repository or its revision.
    """
    for option, values in (("checkpoint", checkpoints), ("weights", weights)):
        if len(values) != len(results):
            raise InvalidOptionError(
                f"{counted(len(values), 'value')} of {named(option)} for "
                f"{counted(len(results), 'value')} of {named('results')}",
                "Give one for each of the results, in their order.",
            )
    runs = tuple(
        PublishedRun(_pinned(entries, location), checkpoint, sha256_file(path))
        for location, checkpoint, path in zip(results, checkpoints, weights, strict=True)
    )
    opened = Results(runs[0], entries)
    system = opened.rows[0].system if not opened.fault and opened.rows else runs[0].results
    return Submission(
        system=system,
        board=_board(entries, opened),
        memory=memory,
        trained_on=trained_on,
        runs=runs,
    )


def _pinned(entries: Entries, location: str) -> str:
    """Return a repository at its commit, and a folder relative to that of the entries."""
    files = locate(location)
    if isinstance(files, HubFiles):
        return files.location
    return Path(os.path.relpath(files.location, entries.folder)).as_posix()


def _board(entries: Entries, results: Results) -> str:
    """Return the board with the buffer set and simulator of a run; else the first: see rule 2."""
    for board in entries.boards if not results.fault else ():
        grid = Grid.of(entries, board)
        identity = results.header.identity
        if grid is not None and (identity.get("revision"), identity.get("simulator")) == (
            grid.revision,
            board.simulator,
        ):
            return board.name
    return entries.boards[0].name
