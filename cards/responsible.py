"""The fields on responsible AI of `croissant.json`: those that dataset tracks ask for at least."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from .publication import HUB, Publication


def responsible(
    limitations: Iterable[str], families: Sequence[str], simulators: Sequence[str]
) -> dict[str, Any]:
    """Return what is asked of data by those who are to use it.

    Args:
        limitations: What it is not good for.
        families: Task families in it.
        simulators: Simulators that it comes from; none for a real robot.
    """
    made_up = bool(simulators)
    return {
        "rai:dataLimitations": list(limitations),
        "rai:dataBiases": (
            f"One robot arm at a table, in tasks of these families only: {', '.join(families)}; "
            "scenes, objects and wordings are those that the recordings happen to have, and "
            "families differ in the length of their lessons."
        ),
        "rai:personalSensitiveInformation": (
            "None: the pictures are of simulated scenes, without people or places."
            if made_up
            else "Not checked: recordings of a real robot may show people and places."
        ),
        "rai:dataUseCases": (
            "To measure whether robot policies can use the one past session that matters when it "
            "lies behind others that do not. Not for training on test episodes, and no sign of "
            "fitness for use on a real robot."
        ),
        "rai:dataSocialImpact": (
            "Robots that remember better need to be shown less often; memory of past sessions may "
            "also keep what people nearby did not mean to be kept. The data itself shows no people."
            if made_up
            else "Robots that remember better need to be shown less often; memory of past sessions "
            "may also keep what people nearby did not mean to be kept."
        ),
        "rai:hasSyntheticData": made_up,
    }


def origin(
    about: Publication, repositories: Mapping[str, str | None], kinds: Iterable[str], how: str
) -> dict[str, Any]:
    """Return what data was made from, and how.

    Args:
        about: As what it is published.
        repositories: Repositories that it was made from, and their commits.
        kinds: Kinds of the sources that recordings were read from.
        how: How, in a sentence.
    """
    found = dict(repositories)
    if about.base_repo:
        found[about.base_repo] = about.base_commit
    sources = [
        {
            "@type": "sc:Dataset",
            "name": repo,
            "url": f"{HUB}/datasets/{repo}" + (f"/tree/{commit}" if commit else ""),
        }
        for repo, commit in sorted(found.items())
    ]
    named = (f"recorded episodes, read as {kind}" for kind in kinds)
    sources += [{"@type": "sc:Dataset", "name": name} for name in named]
    activity: dict[str, Any] = {
        "@type": "prov:Activity",
        "name": "robomme-interference-data",
        "description": how + (f" Command: {about.command}" if about.command else ""),
    }
    derived = {"prov:wasDerivedFrom": sources} if sources else {}
    return {**derived, "prov:wasGeneratedBy": [activity]}
