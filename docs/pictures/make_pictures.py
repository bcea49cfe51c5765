"""Make the pictures of docs/simulators.md: two moments of a demonstration, two of execution."""

from contextlib import closing
from pathlib import Path

import numpy as np
from PIL import Image

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.simulators import Status, make_simulator

SIZE = 224  # pixels, of each moment


def main() -> None:
    """Play the first hard test episode of each family with the oracle, and write its picture."""
    with closing(make_simulator("tabletop")) as simulator:
        for family in FAMILIES:
            lesson, first, _ = simulator.reset(f"{family}/test/2")
            live, status = [], Status.ONGOING
            while status is Status.ONGOING:
                seen, status = simulator.step(simulator.act("oracle"))
                live.append(seen.images["front"])
            shown = lesson.images["front"]
            moments = [shown[len(shown) * 3 // 10], shown[len(shown) * 6 // 10]]
            moments += [first.images["front"], live[-1]]
            small = [Image.fromarray(image).resize((SIZE, SIZE)) for image in moments]
            gap = np.full((SIZE, 4, 3), 255, np.uint8)
            row = [part for image in small for part in (np.asarray(image), gap)][:-1]
            path = Path(__file__).parent / f"{family}.jpg"
            Image.fromarray(np.concatenate(row, axis=1)).save(path, quality=85)
            print(f"{path.name}: {status}, {path.stat().st_size // 1024} KB")  # noqa: T201


if __name__ == "__main__":
    main()
