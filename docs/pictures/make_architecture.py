"""Draw architecture.svg: the folders of the package, and which import which."""

from pathlib import Path

import matplotlib

matplotlib.use("svg")
matplotlib.rcParams["svg.hashsalt"] = "architecture"
from matplotlib import pyplot  # noqa: E402

BOXES = {
    "cli": (3.6, 8, "the command line"),
    "cards": (3.6, 7, "publish data and results, with cards"),
    "build_dataset": (1.4, 6, "recordings to datasets and manifests"),
    "evaluate": (5.4, 6, "buffers into rollouts, rows into scores"),
    "training": (9.3, 6, "buffers into training items"),
    "simulators": (3.9, 5, "tabletop and RoboMME"),
    "retrieval": (7.6, 5, "select the relevant session"),
    "viz": (1.6, 4, "tables, figures, film strips, videos"),
    "cli: options, console": (7.6, 4, "what the commands of each folder share"),
    "stats": (10.6, 4, "intervals, tests"),
    "data": (1.6, 3, "datasets, queries, buffers"),
    "runtime": (5.3, 3, "tasks in processes or on Ray"),
    "storage": (3.4, 2, "files, Hub, Parquet, video, cache"),
    "schema": (3.4, 1, "records and rules, without IO"),
}
"""Folder to the center of its box, and what is in it. `tests/system/test_architecture.py` compares
the arrows with the code."""

ARROWS = (
    ("cli", "cards"),
    ("cli", "training"),
    ("cards", "build_dataset"),
    ("cards", "evaluate"),
    ("build_dataset", "simulators"),
    ("build_dataset", "retrieval"),
    ("evaluate", "simulators"),
    ("evaluate", "retrieval"),
    ("training", "retrieval"),
    ("retrieval", "viz"),
    ("retrieval", "cli: options, console"),
    ("retrieval", "stats"),
    ("simulators", "viz"),
    ("simulators", "runtime"),
    ("cli: options, console", "runtime"),
    ("viz", "data"),
    ("data", "storage"),
    ("runtime", "storage"),
    ("storage", "schema"),
)
"""Imports between folders, without those that a path of others implies."""


def main() -> None:
    """Write the picture beside this script."""
    figure, axes = pyplot.subplots(figsize=(10.5, 6.9))
    width, height = {"stats": 1.7, "training": 2.8}, 0.56
    for source, target in ARROWS:
        (x0, y0, _), (x1, y1, _) = BOXES[source], BOXES[target]
        arrow = {"arrowstyle": "-|>", "color": "#777777", "lw": 1.2, "shrinkA": 0, "shrinkB": 0}
        ends = (x1, y1 + height / 2), (x0, y0 - height / 2)
        axes.annotate("", *ends, arrowprops=arrow)
    for name, (x, y, text) in BOXES.items():
        wide = width.get(name, 3.4)
        box = pyplot.Rectangle(
            (x - wide / 2, y - height / 2),
            wide,
            height,
            fc="#eef3fa",
            ec="#4a6fa5",
            lw=1.2,
            zorder=2,
        )
        axes.add_patch(box)
        axes.text(x, y + 0.1, name, ha="center", va="center", weight="bold", size=10, zorder=3)
        axes.text(x, y - 0.13, text, ha="center", va="center", size=7.5, color="#333", zorder=3)
    axes.set(xlim=(-0.5, 11.6), ylim=(0.6, 8.4))
    axes.axis("off")
    path = Path(__file__).parent / "architecture.svg"
    figure.savefig(path, bbox_inches="tight", metadata={"Date": None})


if __name__ == "__main__":
    main()
