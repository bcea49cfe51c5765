"""Draw architecture.svg: the folders of the package, and which may import which."""

from pathlib import Path

import matplotlib

matplotlib.use("svg")
matplotlib.rcParams["svg.hashsalt"] = "architecture"
from matplotlib import pyplot  # noqa: E402

BOXES = {
    "cli": (4.0, 8, "the command line"),
    "cards": (4.0, 7, "publish data and results, with cards"),
    "build_dataset": (0.9, 6, "recordings to datasets and manifests"),
    "training": (8.1, 6, "buffers into training items"),
    "evaluate": (4.6, 6, "buffers into rollouts, rows into scores"),
    "retrieval": (5.2, 5, "select the relevant session"),
    "simulators": (4.0, 4, "tabletop and RoboMME"),
    "viz": (4.0, 3, "tables, figures, film strips, videos"),
    "data": (4.0, 2, "datasets, queries, buffers"),
    "stats": (6.2, 1, "intervals, tests"),
    "runtime": (2.6, 1, "tasks in processes or on Ray"),
    "storage": (4.0, 0, "files, Hub, Parquet, video, cache"),
    "schema": (4.0, -1, "records and rules, without IO"),
}
"""Folder to the center of its box, and what is in it."""

ARROWS = (
    ("cli", "cards"),
    ("cards", "build_dataset"),
    ("cards", "evaluate"),
    ("build_dataset", "simulators"),
    ("evaluate", "retrieval"),
    ("training", "retrieval"),
    ("retrieval", "simulators"),
    ("simulators", "viz"),
    ("viz", "data"),
    ("data", "runtime"),
    ("data", "stats"),
    ("runtime", "storage"),
    ("stats", "storage"),
    ("storage", "schema"),
)


def main() -> None:
    """Write the picture beside this script."""
    figure, axes = pyplot.subplots(figsize=(9, 7.3))
    width, height = {"stats": 1.9, "training": 2.8}, 0.56
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
    axes.set(xlim=(-1.0, 9.7), ylim=(-1.45, 8.45))
    axes.axis("off")
    path = Path(__file__).parent / "architecture.svg"
    figure.savefig(path, bbox_inches="tight", metadata={"Date": None})


if __name__ == "__main__":
    main()
