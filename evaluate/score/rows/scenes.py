"""Which evaluations by other programs ran in the same scenes, as far as their files tell."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from robomme_interference_data.errors import FormatError, named

from .row_format import FileColumns, ReadFiles

ScenesOf = Mapping[tuple[str, str], frozenset[tuple[str, Any]]]
"""Simulator and system of evaluations by other programs, to what decides the scenes of their
episodes: evaluation and seed, None if it is unknown."""


def check_apart(files: ReadFiles) -> None:
    """Check that no two evaluations by other programs hold the same episodes of a system."""
    held: dict[tuple[Any, ...], Path] = {}
    for path, contents in files.items():
        if contents.scenes is None:
            continue
        columns = [contents.columns[name] for name in ("system", "simulator", "family")]
        columns.append(_seeds(contents))
        for key in dict.fromkeys(zip(*columns, strict=True)):
            if held.setdefault(key, path) != path:
                system, simulator, family, seed = key
                raise FormatError(
                    f"{held[key]} and {path} both hold {family} in {simulator} of {system}, with "
                    f"{'unknown seeds' if seed is None else f'the model seed {seed}'}",
                    f"Name their systems or seeds, one for each file: {named('system')}, "
                    f"{named('model_seed')}.",
                )


def _seeds(contents: FileColumns) -> Sequence[Any]:
    """Return the model seed of each row, None where it is unknown."""
    return contents.columns.get("model_seed", [None] * len(contents.lines))


def scenes_of(files: ReadFiles) -> ScenesOf:
    """Return what decides the scenes of evaluations by other programs."""
    decided_by: dict[tuple[str, str], set[tuple[str, Any]]] = {}
    for contents in files.values():
        if contents.scenes is None:
            continue
        seeds = _seeds(contents)
        rows = zip(contents.columns["simulator"], contents.columns["system"], seeds, strict=True)
        for simulator, system, seed in dict.fromkeys(rows):
            decided_by.setdefault((simulator, system), set()).add(
                (contents.scenes.evaluation, seed)
            )
    return {key: frozenset(scenes) for key, scenes in decided_by.items()}


def of_other_scenes(scenes: ScenesOf) -> list[tuple[str, str]]:
    """Return simulator and system where scenes are not known to be those of most systems."""
    known = {
        key: value for key, value in scenes.items() if all(seed is not None for _, seed in value)
    }
    # Systems are paired where scenes are those of most; the others are named.
    usual = {}
    for simulator in dict.fromkeys(simulator for simulator, _ in known):
        counts = Counter(value for (name, _), value in known.items() if name == simulator)
        usual[simulator] = counts.most_common(1)[0][0]
    return [key for key in scenes if key not in known or known[key] != usual[key[0]]]


def notes_on(files: ReadFiles, scenes: ScenesOf) -> Iterator[str]:
    """Yield what readers must know of evaluations by other programs."""
    programs = dict.fromkeys(
        contents.scenes.program for contents in files.values() if contents.scenes
    )
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
