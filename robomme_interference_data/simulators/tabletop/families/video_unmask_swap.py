"""VideoUnmaskSwap: remember where a cube ended up when its container moved."""

from collections.abc import Sequence

from numpy.random import RandomState

from robomme_interference_data.simulators.tabletop.families.video_unmask import VideoUnmask
from robomme_interference_data.simulators.tabletop.kit import Body
from robomme_interference_data.simulators.tabletop.motion import Arm, Script
from robomme_interference_data.simulators.tabletop.stage import exchanges, swap


class VideoUnmaskSwap(VideoUnmask):
    """As VideoUnmask, then containers change places in pairs, once, twice or three times.

    Of three containers one stays, whatever it hides; of four and five each ends elsewhere.
    """

    gap = 0.078  # m, from the row to the lanes beside it

    def draw(self, rng: RandomState) -> None:
        super().draw(rng)
        self.swaps = exchanges(rng, len(self.spots))

    def demonstrate(self, arm: Arm, answer: Sequence[int]) -> Script:
        yield from super().demonstrate(arm, answer)
        groups = [self.group(number) for number in range(len(self.shells))]
        for pair in self.swaps:
            yield from swap(groups, pair, self.gap)
            yield from arm.wait(5)
        yield from arm.wait(10)

    def group(self, number: int) -> list[Body]:
        """A container, and the cube under it if there is one."""
        hidden = [self.under[number]] if number in self.under else []
        return [self.shells[number], *hidden]
