"""Which renderers drew the images that a policy compares: lessons, units and live observations."""

from collections import defaultdict
from collections.abc import Iterable

LIVE_OBSERVATIONS = "live observations"
"""The images of a rollout itself, beside those of datasets."""


def renderers_note(renderers: Iterable[tuple[str, str | None]]) -> str | None:
    """Return a sentence about images that different renderers drew; None if none are known to be.

    Args:
        renderers: Names of datasets, or `LIVE_OBSERVATIONS`, with a renderer; None if unknown.
    """
    drawn = defaultdict[str | None, dict[str, None]](dict)  # without repetitions, in their order
    for images, renderer in renderers:
        drawn[renderer][images] = None
    without = drawn.pop(None, {})
    if len(drawn) < 2:
        return None
    origins = [f"{' and '.join(images)} from {renderer}" for renderer, images in drawn.items()]
    known = {images for named in drawn.values() for images in named}
    if unknown := [images for images in without if images not in known]:
        origins.append(f"{' and '.join(unknown)} unknown")
    return (
        f"Images come from different renderers: {'; '.join(origins)}. Their pixels may differ, and "
        "a policy can see that."
    )
