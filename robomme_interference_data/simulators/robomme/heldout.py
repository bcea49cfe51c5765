"""The held-out episodes of RoboMME's challenge, as seeds: its metadata does not have them.

`heldout.json` has the seeds of each family by difficulty, in the order of the episodes' indices,
and its source.
"""

import json
from functools import cache
from importlib import resources
from typing import NamedTuple

from robomme_interference_data.constants import FAMILIES, HELDOUT
from robomme_interference_data.errors import UnknownNameError
from robomme_interference_data.ids import EpisodeId


class Setup(NamedTuple):
    """What RoboMME makes an episode from."""

    seed: int
    difficulty: str


def heldout_ids() -> list[EpisodeId]:
    """List the held-out episodes in canonical order: 50 of each family."""
    return [
        EpisodeId(family, HELDOUT, index)
        for family in FAMILIES
        for index in range(len(_setups()[family]))
    ]


def heldout_setup(episode: EpisodeId) -> Setup | None:
    """Return the seed and difficulty of a held-out episode; None for one of another split.

    Raises:
        UnknownNameError: There is no held-out episode of this family and index.
    """
    if episode.split != HELDOUT:
        return None
    setups = _setups().get(episode.family, ())
    if episode.index >= len(setups):
        raise UnknownNameError(
            f"no such episode: in robomme {episode.family} has {len(setups)} {HELDOUT} episodes"
        )
    return setups[episode.index]


@cache
def _setups() -> dict[str, tuple[Setup, ...]]:
    text = resources.files(__package__).joinpath("heldout.json").read_text(encoding="utf-8")
    return {
        family: tuple(
            Setup(seed, difficulty) for difficulty, seeds in groups.items() for seed in seeds
        )
        for family, groups in json.loads(text)["seeds"].items()
    }
