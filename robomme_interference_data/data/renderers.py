"""The renderers that datasets record."""

from collections.abc import Mapping

from .dataset import Dataset


def dataset_renderers(datasets: Mapping[str, Dataset]) -> dict[str, str | None]:
    """Return the renderer that each dataset records; None if it is unknown, as of recordings."""
    renderers = {}
    for name, dataset in datasets.items():
        recorded = {str(source.get("renderer") or "") for source in dataset.identity.sources}
        known = sorted(recorded - {""}) if dataset.cameras else []
        renderers[name] = " and ".join(known) or None
    return renderers
