"""VideoUnmaskSwap: remember where a cube ended up when its container moved."""

from collections.abc import Sequence

from numpy.random import RandomState

from robomme_interference_data.simulators.tabletop.families.video_unmask import VideoUnmask
from robomme_interference_data.simulators.tabletop.kit import Body
from robomme_interference_data.simulators.tabletop.motion import Arm, Script
from robomme_interference_data.simulators.tabletop.stage import swap

__all__ = ["VideoUnmaskSwap"]


class VideoUnmaskSwap(VideoUnmask):
    """As VideoUnmask, then containers change places in pairs, once, twice or three times."""

    def draw(self, rng: RandomState) -> None:
        super().draw(rng)
        self.swaps = [
            tuple(rng.permutation(len(self.spots))[:2].tolist()) for _ in range(self.level + 1)
        ]

    def demonstrate(self, arm: Arm, answer: Sequence[int]) -> Script:
        yield from super().demonstrate(arm, answer)
        for one, other in self.swaps:
            yield from swap(self.group(one), self.group(other))
            yield from arm.wait(5)
        yield from arm.wait(10)

    def group(self, number: int) -> list[Body]:
        """A container, and the cube under it if there is one."""
        hidden = [self.under[number]] if number in self.under else []
        return [self.shells[number], *hidden]
