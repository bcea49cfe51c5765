"""Judge rows, and pack each into one 64-bit number."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import FAMILIES, MAX_STEPS, SPLITS
from robomme_interference_data.errors import nearest
from robomme_interference_data.evaluate.rows import PROTOCOL_VERSION, condition_rank
from robomme_interference_data.evaluate.score.batches import Batch
from robomme_interference_data.evaluate.score.columns import Codes, Rows, distinct
from robomme_interference_data.evaluate.score.read import RELEASED_SIMULATOR, Source
from robomme_interference_data.evaluate.systems import name_system
from robomme_interference_data.simulators.registry import SIMULATORS

__all__ = ["BITS", "DIFFICULTIES", "REFUSED", "STATUSES", "Checker", "field", "pack"]

STATUSES = ("success", "fail", "timeout", "error")
"""By their codes in packed rows."""

DIFFICULTIES = ("easy", "medium", "hard")
_UNSAID = len(DIFFICULTIES)

BITS = {
    "simulator": 4,
    "system": 10,
    "condition": 7,
    "family": 4,
    "episode_split": 2,
    "episode": 17,
    "model_seed": 17,
    "status": 2,
}
"""Fields of a packed row from the highest bits down: 63 in all. Sorting sorts by them in turn."""

REFUSED = np.uint64(2**64 - 1)
"""Stands where a row was refused."""

_SHIFTS = {name: sum(list(BITS.values())[place + 1 :]) for place, name in enumerate(BITS)}
_SUCCESS = {True: 1, False: 0, None: 2}
_EXPECTED = np.array([1, 0, 0, 2])  # success by status
_WORDS: dict[Any, bool | None] = {"": None, "none": None, "nan": None}
_WORDS |= dict.fromkeys(("1", "true", "1.0"), True) | dict.fromkeys(("0", "false", "0.0"), False)


_SIMULATOR = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._:-]{0,127}")
"""Names of files hold it, so no `/`. A simulator of one's own is `module:function` in rows."""


def pack(**codes: Codes | int) -> NDArray[np.uint64]:
    """Pack codes into numbers; fields that are not given are zero."""
    packed: Any = np.uint64(0)
    for name, code in codes.items():
        packed = packed | (np.asarray(code).astype(np.uint64) << np.uint64(_SHIFTS[name]))
    return packed


def field(packed: NDArray[np.uint64], name: str) -> Codes:
    """Return one field of packed rows."""
    mask = np.uint64(2 ** BITS[name] - 1)
    return ((packed >> np.uint64(_SHIFTS[name])) & mask).astype(np.int64)


class Checker:
    """Packs the rows of one source after another, and says what is wrong with a row.

    Attributes:
        simulators: Names by code, in the order in which they were first seen; so are `systems`
            and `model_seeds`.
        revisions: Simulator to the revision of its rows, as far as rows name one.
        pinned: Codes of simulator and system of the rows that name a revision.
        unpinned: The same of those that name none.
        difficulty: Code by episode, −1 where no row tells: a row per `episode_group`, a column per
            index.
        seeds: Seed of the scene, likewise.
    """

    def __init__(self, system: str | None = None):
        self._default = system
        self.simulators: list[str] = []
        self.systems: list[str] = []
        self.model_seeds: list[int] = []
        self.revisions: dict[str, str] = {}
        self.pinned: set[tuple[int, int]] = set()
        self.unpinned: set[tuple[int, int]] = set()
        self._width = 0
        self.difficulty = np.zeros((0, 0), np.int8)
        self.seeds = np.zeros((0, 0), np.int64)

    def pack(self, batch: Batch, source: Source) -> tuple[NDArray[np.uint64], dict[int, str]]:
        """Return the packed rows, `REFUSED` for bad ones, and the reason for each bad row."""
        rows = Rows(batch)
        default = None if "system" in source.columns else self._default
        codes = {
            "simulator": rows.code("simulator", self._simulator, RELEASED_SIMULATOR),
            "system": rows.code("system", self._system, default),
            "condition": rows.code("condition", _condition),
            "family": rows.code("family", _family),
            "episode_split": rows.code("episode_split", _split, "test"),
            "episode": rows.number("episode", 2 ** BITS["episode"] - 1),
            "model_seed": self._seeds(rows),
            "status": rows.code("status", _status),
        }
        success = rows.code("success", _success)
        rows.refuse(
            (success >= 0) & (codes["status"] >= 0) & (success != _EXPECTED[codes["status"]]),
            lambda row: (
                f"success {rows.shown('success', row)} contradicts status "
                f"{rows.shown('status', row)}"
            ),
        )
        rows.number("steps", MAX_STEPS, absent=0, empty=0)
        if "protocol_version" in batch.columns:
            version = rows.number("protocol_version", 2**31)
            rows.refuse(
                version != PROTOCOL_VERSION,
                lambda row: (
                    f"protocol version {rows.shown('protocol_version', row)}; expected "
                    f"{PROTOCOL_VERSION}"
                ),
            )
        if "revision" in batch.columns:
            self._check_revisions(rows, codes["simulator"])
        self._check_episodes(rows, codes)
        packed = pack(**{name: np.maximum(code, 0) for name, code in codes.items()})
        packed = np.broadcast_to(packed, batch.rows).copy()
        packed[list(rows.reasons)] = REFUSED
        sound = packed[packed != REFUSED]
        pairs, _ = distinct(field(sound, "simulator") << BITS["system"] | field(sound, "system"))
        said = self.pinned if "revision" in source.columns else self.unpinned
        said.update(divmod(pair, 2 ** BITS["system"]) for pair in pairs.tolist())
        return packed, rows.reasons

    def _simulator(self, value: str | None) -> int:
        name = value or ""
        if name not in SIMULATORS and name.lower() in SIMULATORS:
            raise ValueError(f"there is no simulator {name!r}. Did you mean {name.lower()!r}?")
        if not _SIMULATOR.fullmatch(name):
            raise ValueError(
                f"{name!r} is not the name of a simulator; expected up to 128 letters, digits, "
                "'.', '_', '-' and ':'"
            )
        return _code(name, self.simulators, "simulator")

    def _system(self, value: str | None) -> int:
        if value in self.systems:
            return self.systems.index(value)
        return _code(name_system(value or "").name, self.systems, "system")

    def _seeds(self, rows: Rows) -> Codes:
        seeds = rows.number("model_seed", 2**62, absent=0)
        values, place = distinct(seeds)
        codes = np.zeros(len(values), np.int64)
        for index, value in enumerate(values.tolist()):
            if value < 0:  # refused
                continue
            if value not in self.model_seeds:
                self.model_seeds.append(value)
            codes[index] = self.model_seeds.index(value)
        most = 2 ** BITS["model_seed"]
        rows.refuse(codes[place] >= most, lambda row: f"more than {most:,} model seeds")
        return codes[place]

    def _check_revisions(self, rows: Rows, simulator: Codes) -> None:
        revisions: list[str] = []
        code = rows.code("revision", lambda v: _revision(revisions, v))
        sound = (simulator >= 0) & (code >= 0)
        for pair in np.unique((simulator * max(len(revisions), 1) + code)[sound]).tolist():
            number, place = divmod(pair, len(revisions))
            name = self.simulators[number]
            known = self.revisions.setdefault(name, revisions[place])
            if known != revisions[place]:
                rows.refuse(
                    (simulator == number) & (code == place),
                    _beside(rows, known),
                )

    def _check_episodes(self, rows: Rows, codes: dict[str, Codes]) -> None:
        """Hold seed and difficulty against what other rows of the same episode say."""
        difficulty = rows.code("difficulty", _difficulty, default="")
        difficulty = np.where(difficulty == _UNSAID, -1, difficulty)
        seed = rows.number("seed", 2**62, absent=-1, empty=-1)
        episode = np.maximum(codes["episode"], 0)
        self._grow(int(episode.max(initial=0)))
        group = episode_group(*(np.maximum(codes[n], 0) for n in _GROUP))
        sound = np.ones(len(episode), bool)
        sound[list(rows.reasons)] = False
        for name, known, given in (
            ("difficulty", self.difficulty, difficulty),
            ("seed", self.seeds, seed),
        ):
            if (known[group, episode] == given).all():  # nothing new, nothing else
                continue
            said = sound & (given >= 0)
            at = group[said], episode[said]
            before = known[at]
            # Of several rows the first one counts: what is assigned last stays. Copies, because
            # numpy walks through reversed views forwards.
            last_first = tuple(place[::-1].copy() for place in at)
            known[last_first] = np.where(before >= 0, before, given[said])[::-1].copy()
            wrong = np.zeros(len(episode), bool)
            wrong[said] = known[at] != given[said]
            rows.refuse(wrong, _differs(rows, name))

    def _grow(self, episode: int) -> None:
        groups, width = self.difficulty.shape
        wanted = len(self.simulators) * len(FAMILIES) * len(SPLITS)
        if groups < wanted or width <= episode:
            self._width = max(self._width, 64, 2 ** int(episode).bit_length())
            for name in ("difficulty", "seeds"):
                old = getattr(self, name)
                new = np.full((wanted, self._width), -1, old.dtype)
                new[: old.shape[0], : old.shape[1]] = old
                setattr(self, name, new)


_GROUP = ("simulator", "family", "episode_split")


def episode_group(simulator: Any, family: Any, split: Any) -> Any:
    """Return the row of `Checker.difficulty` for codes of simulator, family and split."""
    return (simulator * len(FAMILIES) + family) * len(SPLITS) + split


def _code(name: str, names: list[str], what: str) -> int:
    if name not in names:
        if len(names) == 2 ** BITS[what]:
            raise ValueError(f"more than {2 ** BITS[what]} values of {what}")
        names.append(name)
    return names.index(name)


def _beside(rows: Rows, known: str) -> Callable[[int], str]:
    return lambda row: (
        f"revision {rows.shown('revision', row)} beside {known!r}: rows of different splits do "
        "not mix"
    )


def _differs(rows: Rows, name: str) -> Callable[[int], str]:
    return lambda row: (
        f"{name} {rows.shown(name, row)} differs from that of other rows of the same episode"
    )


def _revision(names: list[str], value: str | None) -> int:
    if not value:
        raise ValueError("revision is empty")
    if value not in names:
        names.append(value)
    return names.index(value)


def _family(value: Any) -> int:
    if value not in FAMILIES:
        raise ValueError(f"unknown family {value or ''!r}. {nearest(value or '', FAMILIES)}")
    return FAMILIES.index(value)


def _condition(value: Any) -> int:
    return condition_rank(value or "") + 1


def _split(value: Any) -> int:
    if value not in SPLITS:
        raise ValueError(f"unknown split {value or ''!r}. {nearest(value or '', SPLITS)}")
    return SPLITS.index(value)


def _status(value: Any) -> int:
    value = "timeout" if value == "ongoing" else value or ""  # as the released rows have it
    if value not in STATUSES:
        raise ValueError(f"unknown status {value!r}. {nearest(value, STATUSES)}")
    return STATUSES.index(value)


def _success(value: Any) -> int:
    if isinstance(value, bool) or value is None:
        return _SUCCESS[value]
    if str(value).lower() not in _WORDS:
        raise ValueError(f"success {value!r}; expected 1, 0, true, false or nothing")
    return _SUCCESS[_WORDS[str(value).lower()]]


def _difficulty(value: Any) -> int:
    if not value:
        return _UNSAID
    if value not in DIFFICULTIES:
        raise ValueError(f"unknown difficulty {value!r}. {nearest(value, DIFFICULTIES)}")
    return DIFFICULTIES.index(value)
