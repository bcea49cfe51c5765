"""The methods of a score as a paragraph for a paper, with its citations."""

import math
import re
from importlib import resources
from typing import Any

import numpy as np

from robomme_interference_data.evaluate.score.outcomes import Outcomes
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.score.tables import families
from robomme_interference_data.evaluate.score.tables.contrast import Effect, Measure, Scope
from robomme_interference_data.evaluate.systems import display_name
from robomme_interference_data.viz.templates import fill

from .page import versions

_CITED = re.compile(r"\[@([a-z0-9]+)\]")


def methods(score: Score) -> tuple[str, str]:
    """Return the paragraph as Markdown with Pandoc citations, and its citations as BibTeX.

    It names only methods that a table of the score uses.
    """
    successes = [each for each in score.contrasts if each.measure is Measure.SUCCESS]
    values: dict[str, Any] = {
        "parts": [_part(score, outcomes) for outcomes in score.outcomes.values()],
        "offline": None if score.recordings is None else _offline(score, score.recordings),
        "repeats": any(outcomes.repeat_flips[0] for outcomes in score.outcomes.values()),
        "runs": any(cell.scope is Scope.TRAINING for cell in score.cells),
        # The conditions that are compared with k0.
        "primary": list(
            dict.fromkeys(
                contrast.condition
                for contrast in successes
                if contrast.primary and contrast.effect is Effect.SESSIONS
            )
        ),
        "chance": any(cell.chance >= 0 for cell in score.cells),
        "tables": set(score.tables),
        "intervals": {contrast.pairs.method for contrast in successes},
        "retention": any(not math.isnan(each.retention.value) for each in successes),
        "margin": score.settings.margin,
        "draws": score.draws,
        "family_draws": families.DRAWS,
        "versions": versions(),
        "notes": " ".join(score.notes),
    }
    text = fill(__package__, "methods.md.j2", values, what="the methods")
    cited = set(_CITED.findall(text))
    file = resources.files(__package__).joinpath("data", "methods.bib")
    entries = file.read_text(encoding="utf-8").strip().split("\n\n")
    entries = [entry for entry in entries if entry.partition("{")[2].partition(",")[0] in cited]
    return text, "\n\n".join(entries) + "\n"


def _offline(score: Score, recordings: Outcomes) -> dict[str, Any]:
    cells = [cell for cell in score.error_cells if not cell.part]
    return {
        "systems": list(map(display_name, recordings.systems)),
        "conditions": recordings.conditions,
        "rollouts": sum(sum(cell.counts) for cell in cells),
        "episodes": len(recordings.episodes),
        "complete": sum(cell.complete for cell in cells),
        "cells": len(cells),
        "errors": sum(cell.errors for cell in cells),
    }


def _part(score: Score, outcomes: Outcomes) -> dict[str, Any]:
    present = np.flatnonzero(outcomes.has_episode.any(axis=0)).tolist()
    cells = [cell for cell in score.cells if cell.simulator == outcomes.simulator and not cell.part]
    return {
        "simulator": outcomes.simulator,
        "asked": bool((outcomes.chance >= 0).any()),
        "systems": list(map(display_name, outcomes.systems)),
        "conditions": list(dict.fromkeys(cell.condition for cell in cells if cell.n)),
        "rollouts": sum(sum(cell.counts) for cell in cells),
        "episodes": len(present),
        "families": len({outcomes.episodes[place].family for place in present}),
        "runs": len({repeat.training_seed for repeat in outcomes.repeats}),
        "seeds": len({repeat.model_seed for repeat in outcomes.repeats}),
        "complete": sum(cell.complete for cell in cells),
        "cells": len(cells),
        "errors": sum(cell.errors for cell in cells),
    }
