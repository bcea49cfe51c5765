"""What a run records of its leak probe, and how it is reported."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from robomme_interference_data.errors import FormatError
from robomme_interference_data.stats.intervals import wilson

INDEPENDENT, NONDETERMINISTIC, BROKEN = "independent", "nondeterministic", "broken"


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
        digest: Of a nondeterministic system, a digest of the values of its first plays. If the
            system gives the same one whenever it is started again, it is no noise that makes it
            differ, but a state that every rollout changes.
        error: Of a broken probe, why.
        unprobed: Of a merged run, the folders that were not probed.

    Raises:
        FormatError: There is no such verdict, or noise without a p-value.
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
    digest: str | None = None
    error: str | None = None
    unprobed: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        verdicts = INDEPENDENT, NONDETERMINISTIC, BROKEN
        if self.verdict not in verdicts:
            raise FormatError(f"verdict {self.verdict!r} is none of {', '.join(verdicts)}")
        if self.verdict == NONDETERMINISTIC and self.p_value is None:
            raise FormatError(f"a probe with the verdict {NONDETERMINISTIC} has no p_value")

    @property
    def done(self) -> bool:
        """Whether it need not be repeated."""
        return self.verdict != BROKEN

    @property
    def all_independent(self) -> bool:
        """Whether all of the run was probed, and no state survives a reset."""
        return self.verdict == INDEPENDENT and not self.unprobed


def probe_text(probe: Probe | None) -> str:
    """Return what a probe found, in a sentence."""
    if probe is None:
        return "not probed: whether a state survives a reset is unknown"
    unprobed = f"; not probed: {', '.join(probe.unprobed)}" if probe.unprobed else ""
    if probe.verdict == BROKEN:
        text = f"not probed, as a rollout of the probe broke: {probe.error}"
    elif probe.verdict == INDEPENDENT:
        beside = ", and while another client acts" if probe.clients > 1 else ""
        text = (
            f"no state survives a reset: {len({*probe.rollouts})} rollouts, {probe.plays} plays, "
            f"the same values after any predecessor{beside}"
        )
    else:
        text = _noise_text(probe)
    return text + unprobed


def _noise_text(probe: Probe) -> str:
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
        f"{flipped}; a leak larger than this noise was not found (p = {probe.p_value:.2g}). If its "
        f"first values have the digest {(probe.digest or '')[:8]} again after every restart, it "
        "keeps a state that all rollouts change"
    )


def joined_probe(shards: Sequence[tuple[str, Probe | None]]) -> Probe | None:
    """Return the probe of merged folders that claims least; None if no folder was probed."""
    order = (BROKEN, NONDETERMINISTIC, INDEPENDENT)
    known = [probe for _, probe in shards if probe is not None]
    if not known:
        return None
    unprobed = [name for name, probe in shards if probe is None]
    unprobed += [name for probe in known for name in probe.unprobed]
    weakest = min(known, key=lambda probe: order.index(probe.verdict))
    return replace(weakest, unprobed=tuple(unprobed))
