"""Episodes of one dataset come from one version of a simulator, and from one renderer.

Another version has other episodes under the same ids, and another renderer draws other pixels.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from robomme_interference_data.build_dataset.alike import unequal
from robomme_interference_data.errors import BuildError, named
from robomme_interference_data.storage.files import write_json
from robomme_interference_data.storage.text import read_json

from .plan import DatasetPlan

_STAGED = "sources.json"
"""File in the folder of a build: the provenance of each source, by its kind."""


def check_same_simulators(
    where: str,
    recorded: Iterable[Mapping[str, Any]],
    planned: Iterable[Mapping[str, Any]],
    advice: str,
) -> None:
    """Check that simulators are those that earlier episodes come from.

    Args:
        where: What holds the earlier episodes.
        recorded: Provenance of the earlier episodes' sources.
        planned: Provenance of the sources of further ones.
        advice: What to do otherwise, beside using the recorded versions and renderer.

    Raises:
        BuildError: Versions or the renderer differ; lists the differences.
    """
    earlier = {source.get("kind"): source for source in recorded}
    for source in planned:
        before = earlier.get(source["kind"])
        if before is None or "versions" not in source or before == source:
            continue
        found = unequal(("it", facts_of(before)), ("this build", facts_of(source)))
        raise BuildError(
            f"{where} has episodes of another {source['kind']}: {'; '.join(found)}",
            f"Build with those versions and that renderer, {advice}",
        )


def check_staged_simulators(work: Path, out: Path, plan: DatasetPlan) -> None:
    """Check that an interrupted build in `work` used the same simulators; record those of this one.

    Raises:
        BuildError: It staged episodes of other versions, or of another renderer.
    """
    path = work / _STAGED
    recorded: dict[str, Any] = {}
    if path.is_file() and any((work / "episodes").glob("[!.]*")):
        recorded = read_json(path)
    check_same_simulators(
        f"the interrupted build of {out}",
        recorded.values(),
        plan.provenances,
        f"choose another {named('buffer_set')}, or remove {work} to begin again.",
    )
    write_json(path, recorded | {source["kind"]: source for source in plan.provenances})


def facts_of(source: Mapping[str, Any]) -> dict[str, Any]:
    """Return a provenance with each version as a fact of its own."""
    versions = source.get("versions", {})
    return {name: fact for name, fact in source.items() if name != "versions"} | versions
