"""Make the pictures of docs/reference/tabletop.md: what episodes are, and how shifts look."""

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.schema.shifts import KINDS, STRENGTHS, Shift
from robomme_interference_data.simulators import Status, make_simulator
from robomme_interference_data.simulators.tabletop.simulator import TabletopSimulator

SIZE = 224  # pixels, of each moment


def main() -> None:
    """Write the pictures of all families, and that of the shifts."""
    with closing(make_simulator("tabletop")) as simulator:
        assert isinstance(simulator, TabletopSimulator)
        draw_shifts(simulator)
        for family in FAMILIES:
            draw_family(simulator, family)


def draw_family(simulator: TabletopSimulator, family: str) -> None:
    """Play the first hard test episode with the oracle: two moments of lesson and execution."""
    lesson, first, _ = simulator.reset(f"{family}/test/2")
    live, status = [], Status.ONGOING
    while status is Status.ONGOING:
        seen, status = simulator.step(simulator.act("oracle"))
        live.append(seen.images["front"])
    shown = lesson.images["front"]
    moments = [shown[len(shown) * 3 // 10], shown[len(shown) * 6 // 10]]
    write(family, [[*moments, first.images["front"], live[-1]]])


def draw_shifts(simulator: TabletopSimulator) -> None:
    """Show a first live view as it was recorded, and under each kind: a row, by strength."""
    _, first, _ = simulator.reset("InsertPeg/test/2", demonstration=False)
    rows = []
    for kind in KINDS:
        views = simulator.views(Shift(kind, strength) for strength in STRENGTHS)
        rows.append([first.images["front"], *(seen.images["front"] for seen in views)])
    write("shifts", rows)


def write(name: str, rows: Sequence[Sequence[NDArray[np.uint8]]]) -> None:
    """Write images as a grid, white between them."""
    lines = []
    for row in rows:
        small = [Image.fromarray(image).resize((SIZE, SIZE)) for image in row]
        gap = np.full((SIZE, 4, 3), 255, np.uint8)
        line = np.concatenate([part for one in small for part in (np.asarray(one), gap)][:-1], 1)
        lines += [line, np.full((4, line.shape[1], 3), 255, np.uint8)]
    path = Path(__file__).parent / f"{name}.jpg"
    Image.fromarray(np.concatenate(lines[:-1])).save(path, quality=85)
    print(f"{path.name}: {path.stat().st_size // 1024} KB")  # noqa: T201


if __name__ == "__main__":
    main()
