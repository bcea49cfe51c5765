"""What the leak probe concludes from plays of a system that is not deterministic."""

from collections.abc import Sequence
from itertools import combinations, permutations

import numpy as np

from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.stats.significance import poisson_binomial

from .trace import Play

LEAK_P = 0.01
"""Largest p-value at which plays that are noisy show a leak."""


def flips(plays: Sequence[Play]) -> tuple[int, int]:
    """Return how many pairs of `rounds` were played after the same rollout, and how many flip."""
    pairs = [pair for same in _same_predecessor(plays) for pair in same]
    return len(pairs), sum(first.status != second.status for first, second in pairs)


def noise_p(repeats: Sequence[Sequence[Play]], plays: Sequence[Play]) -> float:
    """Return the p-value of a leak in a noisy system: the smallest of all tests, corrected.

    Each test supposes that the past has no effect. Then plays of a rollout may change places:

    - the first actions of all `repeats` rarely change as little from one repeat to the next in
      any other order;
    - the first actions at two places of the `repeats` are rarely closest within either place;
    - of four `plays`, two after a rollout and two after another one, these pairs are the closest
      in at most a third of the rollouts, by their first actions and by their outcomes.

    Args:
        repeats: The plays of a sequence, at least twice. With 7 repeats, the smallest p-values of
            the first two tests (2 of 5,040 orders, 1 of 1,716 divisions) stay below `LEAK_P` after
            correction for 9 tests, of which there are no more.
        plays: The plays of `rounds`.
    """
    places = [*zip(*repeats, strict=True)]
    found = [_order_p(repeats)] + [
        _halves_p([play.first_action for play in (*first, *second)])
        for first, second in combinations(places, 2)
        if first[0].planned.item == second[0].planned.item
    ]
    fours = [same for same in _same_predecessor(plays) if len(same) == 2]
    for distance in (_action_distance, _outcome_distance):
        closest = 0
        for (a, b), (c, d) in fours:
            same = distance(a, b) + distance(c, d)
            others = (distance(a, c) + distance(b, d), distance(a, d) + distance(b, c))
            closest += same < min(others)
        if fours:
            found.append(poisson_binomial(closest, [1 / 3] * len(fours)))
    return min(1.0, len(found) * min(found))


def _order_p(repeats: Sequence[Sequence[Play]]) -> float:
    """Return the share of orders in which repeats change as little as in the given one.

    Here a state shows that grows with every rollout, such as in a server that no new client clears.
    """
    actions = np.array([[play.first_action for play in plays] for plays in repeats])
    distances = np.abs(actions[:, None] - actions[None]).max(axis=3).sum(axis=2)
    orders = np.array([*permutations(range(len(repeats)))])
    lengths = distances[orders[:, :-1], orders[:, 1:]].sum(axis=1)
    # The given one comes first. Backward it is as long, but for the rounding of its sum.
    return float(np.mean(lengths <= lengths[0] * (1 + 1e-9)))


def _halves_p(actions: Sequence[tuple[float, ...]]) -> float:
    """Return the share of divisions into halves that are as close within as the given one."""
    vectors = np.array(actions)
    distances = np.abs(vectors[:, None] - vectors[None]).max(axis=2)
    # Either half of a division names it: here that with the first play.
    count = len(actions)
    chosen = [(0, *others) for others in combinations(range(1, count), count // 2 - 1)]
    halves = np.array([[place in half for place in range(count)] for half in chosen])
    sums = sum(((half @ distances) * half).sum(axis=1) for half in (halves, ~halves))
    # The given one comes first.
    return float(np.mean(sums <= sums[0]))


def _same_predecessor(plays: Sequence[Play]) -> list[list[tuple[Play, Play]]]:
    """Return the pairs of plays after the same rollout, of each rollout."""
    groups: dict[WorkItem, dict[str, list[Play]]] = {}
    for play in plays:
        if play.after is not None:
            groups.setdefault(play.planned.item, {}).setdefault(play.after, []).append(play)
    return [
        [(group[0], group[1]) for group in own.values() if len(group) > 1]
        for own in groups.values()
    ]


def _action_distance(first: Play, second: Play) -> float:
    difference = np.subtract(first.first_action, second.first_action)
    return float(np.abs(difference).max(initial=0.0))


def _outcome_distance(first: Play, second: Play) -> float:
    return float(first.status != second.status)
