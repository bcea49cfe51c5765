"""What files do not state of their rows: the user does, or readers are told that it is unknown."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from robomme_interference_data.errors import FormatError, InvalidOptionError, counted, named
from robomme_interference_data.evaluate.systems import name_system

from .row_format import FileColumns

Parts = Mapping[Path, FileColumns]
"""Files with their columns."""

ScenesOf = Mapping[tuple[str, str], frozenset[tuple[str, Any]]]
"""Simulator and system of evaluations by other programs, to what decides the scenes of their
episodes: evaluation and seed, None if it is unknown."""


def with_stated(
    parts: Parts, systems: Sequence[str], model_seeds: Sequence[int]
) -> dict[Path, FileColumns]:
    """Return the files, with system and model seed of those that do not state theirs.

    Args:
        parts: The files.
        systems: A name for all files that name no system, or one for each of them in order.
        model_seeds: Likewise the seeds of files without a column for the model seed.

    Raises:
        FormatError: A system is unknown.
        InvalidIdError: The name of a system is invalid.
        InvalidOptionError: The number of values is not that of the files that need one.
    """
    completed = dict(parts)
    for path, part in parts.items():
        if part.system is not None:
            completed[path] = _with(part, "system", name_system(part.system).name)
    for path, system in _values("system", completed, systems).items():
        completed[path] = _with(completed[path], "system", name_system(system).name)
    for path, seed in _values("model_seed", completed, model_seeds).items():
        completed[path] = _with(completed[path], "model_seed", seed)
    for path, part in completed.items():
        if "system" not in part.columns:
            raise FormatError(
                f"{path} names no system",
                f"Name it, such as {named('system', 'my-memory')}; of several such files each, in "
                f"their order (of two that are compared: {named('system_a')}, "
                f"{named('system_b')}).",
            )
    _check_apart(completed)
    return completed


def _with(part: FileColumns, column: str, value: Any) -> FileColumns:
    """Return a file with the same value in each row, unless it has the column."""
    return replace(part, columns={column: [value] * len(part.lines), **part.columns})


def _values(column: str, parts: Parts, stated: Sequence[Any]) -> dict[Path, Any]:
    """Return the stated value for each file without a column."""
    lacking = [path for path, part in parts.items() if column not in part.columns]
    if not stated:
        return {}
    if not lacking:
        held = {str(value) for part in parts.values() for value in part.columns[column]}
        if held.issuperset(map(str, stated)):
            return {}  # the files say the same
    if lacking and len(stated) == 1:
        return dict.fromkeys(lacking, stated[0])
    if len(stated) != len(lacking):
        raise InvalidOptionError(
            f"{counted(len(stated), 'value')} of {named(column)} for "
            f"{counted(len(lacking), 'file')} that state no {column}: "
            f"{', '.join(map(str, lacking)) or 'all do'}",
            "Give one for all of them, or one for each in their order.",
        )
    return dict(zip(lacking, stated, strict=True))


def _check_apart(parts: Parts) -> None:
    """Check that no two evaluations by other programs hold the same episodes of a system."""
    held: dict[tuple[Any, ...], Path] = {}
    for path, part in parts.items():
        if part.scenes is None:
            continue
        columns = [part.columns[name] for name in ("system", "simulator", "family")]
        columns.append(part.columns.get("model_seed", [None] * len(part.lines)))
        for key in dict.fromkeys(zip(*columns, strict=True)):
            if held.setdefault(key, path) != path:
                system, simulator, family, seed = key
                raise FormatError(
                    f"{held[key]} and {path} both hold {family} in {simulator} of {system}, with "
                    f"{'unknown seeds' if seed is None else f'the model seed {seed}'}",
                    f"Name their systems or seeds, one for each file: {named('system')}, "
                    f"{named('model_seed')}.",
                )


def scenes_of(parts: Parts) -> ScenesOf:
    """Return what decides the scenes of evaluations by other programs."""
    found: dict[tuple[str, str], set[tuple[str, Any]]] = {}
    for part in parts.values():
        if part.scenes is None:
            continue
        seeds = part.columns.get("model_seed", [None] * len(part.lines))
        rows = zip(part.columns["simulator"], part.columns["system"], seeds, strict=True)
        for simulator, system, seed in dict.fromkeys(rows):
            found.setdefault((simulator, system), set()).add((part.scenes.evaluation, seed))
    return {key: frozenset(scenes) for key, scenes in found.items()}


def of_other_scenes(scenes: ScenesOf) -> list[tuple[str, str]]:
    """Return simulator and system where scenes are not known to be those of most systems."""
    known = {
        key: value for key, value in scenes.items() if all(seed is not None for _, seed in value)
    }
    usual = {}
    for simulator in dict.fromkeys(simulator for simulator, _ in known):
        counts = Counter(value for (name, _), value in known.items() if name == simulator)
        usual[simulator] = counts.most_common(1)[0][0]
    return [key for key in scenes if key not in known or known[key] != usual[key[0]]]


def notes_on(parts: Parts, scenes: ScenesOf) -> Iterator[str]:
    """Yield what readers must know of evaluations by other programs."""
    programs = dict.fromkeys(part.scenes.program for part in parts.values() if part.scenes)
    for program in programs:
        yield (
            f"Results of {program} state no condition: they count as no-history, each task as a "
            "family, and a cell is complete with all episodes that occur in any file."
        )
    for simulator in dict.fromkeys(simulator for simulator, _ in scenes):
        others = [system for name, system in of_other_scenes(scenes) if name == simulator]
        if others and sum(name == simulator for name, _ in scenes) > 1:
            yield (
                f"In {simulator}, {', '.join(others)} and other systems are not paired: their "
                f"scenes are not known to be the same ({named('model_seed')} names seeds)."
            )
