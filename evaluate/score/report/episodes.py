"""The outcomes of single episodes, which the page of a report shows on demand."""

import json
import math
import os
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from urllib.parse import quote

import numpy as np

from robomme_interference_data.constants import DIFFICULTIES
from robomme_interference_data.evaluate.score.outcomes import STATUSES, mean_errors, success
from robomme_interference_data.evaluate.score.rows.reading import CheckedRows
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.systems import display_name
from robomme_interference_data.schema.conditions import parse_condition


def names_of(score: Score) -> dict[str, str]:
    """Return the display names of the systems that have rows."""
    systems = dict.fromkeys(name for each in score.all_outcomes for name in each.systems)
    return {system: display_name(system) for system in systems}


def episodes_json(score: Score, conditions: Sequence[str], folder: Path) -> str:
    """Return the outcomes of each episode as JSON that is safe inside a script element.

    `names` holds the systems' display names; `rows` one row for each system and episode: simulator,
    system, family, the rest of the id, difficulty, the outcome under each condition, the flips, and
    under each condition the address of a video and that of the page of its buffer, relative to the
    folder of the report.
    """
    videos = _videos(score.rows)
    rows = []
    for outcomes in score.all_outcomes:
        errors = mean_errors(outcomes.action_l1)
        for place, system in enumerate(outcomes.systems):
            counts = outcomes.counts[place].transpose(1, 0, 2).tolist()
            rates = success(outcomes.status[place]).T.tolist()
            measured = errors[place].T.tolist()
            for number in np.flatnonzero(outcomes.has_episode[place]).tolist():
                episode = outcomes.episodes[number]
                difficulty = int(outcomes.difficulty[number])
                outcome_under = {
                    c: _outcome(statuses, error)
                    for c, statuses, error in zip(
                        outcomes.conditions, counts[number], measured[number], strict=True
                    )
                }
                shown = [
                    videos.get((outcomes.simulator, system, c, str(episode))) for c in conditions
                ]
                row = (
                    outcomes.simulator,
                    system,
                    episode.family,
                    f"{episode.split}/{episode.index}",
                    DIFFICULTIES[difficulty] if difficulty >= 0 else "",
                    [outcome_under.get(c, "") for c in conditions],
                    flips(outcomes.conditions, rates[number]),
                    [_address(video, folder) for video in shown],
                    [_address(video and video.with_suffix(".html"), folder) for video in shown],
                )
                rows.append(row)
    data = {"names": names_of(score), "rows": rows}
    text = json.dumps(data, ensure_ascii=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")


def _address(path: Path | None, folder: Path) -> str:
    """Return where a file lies from a folder, for a link; empty if there is no file."""
    if path is None or not path.is_file():
        return ""
    return quote(os.fsencode(os.path.relpath(path, folder)))  # names may not be UTF-8


def flips(conditions: Sequence[str], rates: Sequence[float]) -> str:
    """Return where an outcome changes between conditions of a kind: `k3 lost, k7 gained`."""
    known = [(c, r) for c, r in zip(conditions, rates, strict=True) if not math.isnan(r)]
    return ", ".join(
        f"{condition} {'gained' if rate > before else 'lost'}"
        for (last, before), (condition, rate) in pairwise(known)
        if rate != before and parse_condition(last).kind == parse_condition(condition).kind
    )


def _outcome(counts: Sequence[int], action_l1: float) -> str:
    if not math.isnan(action_l1):
        return f"{action_l1:.4f}"
    if sum(counts) == 1:
        return STATUSES[counts.index(1)]
    won, failed, timed_out, errors, _ = counts
    scored = won + failed + timed_out
    return f"{won}/{scored}" if scored else "error" if errors else ""


def _videos(rows: CheckedRows) -> dict[tuple[str, ...], Path]:
    """Return the existing videos of the lowest model seeds, by rollout."""
    videos: dict[tuple[str, ...], Path] = {}
    for row in sorted(rows, key=lambda row: row.model_seed):
        episode = f"{row.family}/{row.split}/{row.episode}"
        key = (row.simulator, row.system, row.condition, episode)
        if row.video and key not in videos and row.video.is_file():
            videos[key] = row.video
    return videos
