"""What a run records of its leak probe, and how it is reported."""

from collections.abc import Sequence
from dataclasses import dataclass

from robomme_interference_data.stats.intervals import wilson


@dataclass(frozen=True)
class Probe:
    """What the leak probe found before the first row. A leak leaves no run.

    Attributes:
        verdict: `independent`: the same values after any predecessor. `nondeterministic`: other
            values after the same predecessor, too. `broken`: a rollout of the probe broke.
        rollouts: The rollouts that it repeated, such as `MoveCube/test/3 k7`.
        plays: How often it played one.
        clients: Clients of one policy that acted in turns: 2 where workers share policies.
        component: Of a nondeterministic system, what gave the first different value: `policy`,
            `simulator`, `subgoal writer` or `retrieval step`.
        step: Executed steps before that value.
        pairs: Of a nondeterministic system, pairs of plays of a rollout after the same predecessor.
        flips: Pairs of these with another outcome.
        p_value: Of a nondeterministic system, probability of its plays without a leak.
        error: Of a broken probe, why.
    """

    verdict: str
    rollouts: tuple[str, ...]
    plays: int
    clients: int
    component: str | None = None
    step: int | None = None
    pairs: int | None = None
    flips: int | None = None
    p_value: float | None = None
    error: str | None = None

    @property
    def done(self) -> bool:
        """Whether it need not be repeated."""
        return self.verdict != BROKEN


INDEPENDENT, NONDETERMINISTIC, BROKEN = "independent", "nondeterministic", "broken"


def probe_text(probe: Probe | None) -> str:
    """Return what a probe found, in a sentence."""
    if probe is None:
        return "not probed: whether a state survives a reset is unknown"
    if probe.verdict == BROKEN:
        return f"not probed, as a rollout of the probe broke: {probe.error}"
    if probe.verdict == INDEPENDENT:
        beside = ", and while another client acts" if probe.clients > 1 else ""
        return (
            f"no state survives a reset: {len({*probe.rollouts})} rollouts, {probe.plays} plays, "
            f"the same values after any predecessor{beside}"
        )
    pairs, flips = probe.pairs or 0, probe.flips or 0
    flipped = "no rollout was repeated under the same conditions"
    if pairs:
        low, high = wilson(flips, pairs)
        flipped = (
            f"{flips} of {pairs} repeated rollouts ({flips / pairs:.1%}, 95% interval "
            f"{100 * low:.0f} to {100 * high:.0f}) have another outcome"
        )
    return (
        f"not deterministic: the {probe.component} differs from step {probe.step} on, and "
        f"{flipped}; a leak larger than this noise was not found (p = {probe.p_value:.2g})"
    )


def joined_probe(probes: Sequence[Probe | None]) -> Probe | None:
    """Return the probe that claims least; None if a shard was not probed."""
    order = (BROKEN, NONDETERMINISTIC, INDEPENDENT)
    known = [probe for probe in probes if probe is not None]
    if len(known) < len(probes):
        return None
    return min(known, key=lambda probe: order.index(probe.verdict), default=None)
