"""Draw the README's figure: the paper's rates with and without retrieval, and the ceiling."""

from pathlib import Path

from matplotlib.figure import Figure

from robomme_interference_data.evaluate.score.tables.paper import published

CONDITIONS = ("k0", "k1", "k3", "k7")
CURVES = {
    "perceptual-framesamp-modul": ("FrameSamp-Modul", "#0072b2"),
    "retrieval-framesamp-modul": ("with retrieval", "#000000"),
}
"""Published systems: how the figure names and colors them."""


def main() -> None:
    """Write docs/pictures/headline.png."""
    figure = Figure(figsize=(7.2, 3.4), layout="constrained")
    axes = figure.subplots()
    places = range(len(CONDITIONS))
    axes.plot(places, [100] * len(CONDITIONS), color="#666666", linestyle="--")
    axes.annotate("ideal observer\nwith the same 32 frames", (3.08, 100), va="center")
    for system, (label, color) in CURVES.items():
        cells = {cell.condition: cell for cell in published() if cell.system == system}
        rates = [100 * cells[condition].rate for condition in CONDITIONS]
        lows, highs = zip(*(cells[condition].interval for condition in CONDITIONS), strict=True)
        below = [rate - 100 * low for rate, low in zip(rates, lows, strict=True)]
        above = [100 * high - rate for rate, high in zip(rates, highs, strict=True)]
        axes.errorbar(places, rates, (below, above), color=color, marker="o", capsize=3)
        axes.annotate(label, (3.08, rates[-1]), va="center", color=color)
    axes.set_xticks(list(places), CONDITIONS)
    axes.set_xlabel("the lesson, then k sessions of other tasks")
    axes.set_xlim(-0.2, 4.3)
    axes.set_ylim(0, 108)
    axes.set_ylabel("success, %")
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(Path(__file__).parent / "headline.png", dpi=150)


if __name__ == "__main__":
    main()
