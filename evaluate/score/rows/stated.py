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
        systems: A name for all files without a column for the system, or one for each of them;
            by default the name that their file names state.
        model_seeds: Likewise the seeds of files without a column for the model seed.

    Raises:
        FormatError: A system is unknown.
        InvalidIdError: The name of a system is invalid.
        InvalidOptionError: The number of values is not that of the files that need one.
    """
    names = _values("system", parts, systems)
    seeds = _values("model_seed", parts, model_seeds)
    completed = {}
    for path, part in parts.items():
        columns = dict(part.columns)
        if "system" not in columns:
            system = names.get(path, part.system)
            if system is None:
                raise _no_system(path)
            columns["system"] = [name_system(system).name] * len(part.lines)
        if path in seeds:
            columns["model_seed"] = [seeds[path]] * len(part.lines)
        completed[path] = replace(part, columns=columns)
    _check_apart(completed)
    return completed


def _no_system(path: Path) -> FormatError:
    return FormatError(
        f"{path} names no system",
        f"Name it, such as {named('system', 'my-memory')}; of several such files each, in their "
        f"order (of two that are compared: {named('system_a')}, {named('system_b')}).",
    )


def _values(column: str, parts: Parts, stated: Sequence[Any]) -> dict[Path, Any]:
    """Return the stated value for each file without a column."""
    lacking = [path for path, part in parts.items() if column not in part.columns]
    if not stated or not lacking:
        return {}
    if len(stated) == 1:
        return dict.fromkeys(lacking, stated[0])
    if len(stated) != len(lacking):
        raise InvalidOptionError(
            f"{counted(len(stated), 'value')} of {named(column)} for "
            f"{counted(len(lacking), 'file')} without a column {column}: "
            f"{', '.join(map(str, lacking))}",
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
            f"Results of {program} state no condition: they count as no-history, and each task as "
            "a family."
        )
    for simulator in dict.fromkeys(simulator for simulator, _ in scenes):
        others = [system for name, system in of_other_scenes(scenes) if name == simulator]
        if others and sum(name == simulator for name, _ in scenes) > 1:
            yield (
                f"In {simulator}, {', '.join(others)} and other systems are not paired: their "
                f"scenes are not known to be the same ({named('model_seed')} names seeds)."
            )
