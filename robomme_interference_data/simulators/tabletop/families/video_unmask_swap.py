"""VideoUnmaskSwap: remember where a cube ended up when its container moved."""

from collections.abc import Sequence

from numpy.random import RandomState

from robomme_interference_data.simulators.tabletop.kit import Body
from robomme_interference_data.simulators.tabletop.motion import Arm, Script
from robomme_interference_data.simulators.tabletop.swaps import SwapFamily

from .video_unmask import VideoUnmask


class VideoUnmaskSwap(SwapFamily, VideoUnmask):
    """As VideoUnmask, then containers change places in pairs, once, twice or three times.

    Of three containers one stays, whatever it hides; of four and five each ends elsewhere.
    """

    gap = 0.078  # m, from the row to the lanes beside it

    def draw(self, rng: RandomState) -> None:
        super().draw(rng)
        self.count = len(self.spots)
        self.draw_swaps(rng)

    def demonstrate(self, arm: Arm, answer: Sequence[int]) -> Script:
        yield from super().demonstrate(arm, answer)
        groups = [self.group(number) for number in range(len(self.shells))]
        yield from self.swap(arm, groups, 1)
        yield from arm.wait(10)

    def group(self, number: int) -> list[Body]:
        """A container, and the cube under it if there is one."""
        hidden = [self.under[number]] if number in self.under else []
        return [self.shells[number], *hidden]
