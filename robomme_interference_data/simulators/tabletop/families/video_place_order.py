"""VideoPlaceOrder: remember on which target a cube was placed first, second or third."""

from numpy.random import RandomState

from robomme_interference_data.simulators.tabletop.kit import Kit
from robomme_interference_data.simulators.tabletop.motion import Arm, Script

from .video_place_button import PlaceFamily

ORDINALS = ("first", "second", "third")


class VideoPlaceOrder(PlaceFamily):
    """The arm places a cube on three targets, one after the other."""

    table = (0.30, 0.36, 0.52)
    paint = (0.95, 0.72, 0.15)
    colours_at = (1, 2, 2)
    times = ORDINALS
    row_of_targets = 0.03
    bow = 0.04

    def draw(self, rng: RandomState) -> None:
        super().draw(rng)
        self.asked = int(rng.randint(3))

    def build(self, kit: Kit) -> None:
        super().build(kit)
        kit.panel((-0.18, 0), (0.045, 0.15), (0.20, 0.24, 0.36))

    def goals(self) -> tuple[str, ...]:
        return (
            f"put the {self.colours[0]} cube on the {ORDINALS[self.asked]} target it was placed on",
        )

    def way(self, answer: int) -> tuple[int, ...]:
        visits = [number for number in self.order if number != answer]
        visits.insert(self.asked, answer)
        return tuple(visits[:3])

    def demonstrate(self, arm: Arm, answer: int) -> Script:
        first = self.way(answer)
        # A second cube goes its own way round, clear of where the first one stays.
        second = [number for number in self.order if number != first[-1]][:3]
        yield from arm.wait(10)
        for cube, way in zip(range(len(self.cubes)), (first, second), strict=False):
            for part, number in enumerate(way):
                yield from self.place(arm, cube, number, part)
        yield from self.exchange_targets(arm)
