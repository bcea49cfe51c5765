"""What data is not good for, in plain words."""

from collections.abc import Iterable, Sequence

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.evaluate.score.outcomes import TEST_EPISODES
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.simulators.registry import SIMULATORS, simulator_class


def is_whole_grid(records: Sequence[EpisodeRecord]) -> bool:
    """Tell whether queries are the paper's: nine families, test episodes 0 to 49 each."""
    ids = {(one.episode_id.family, one.episode_id.split, one.episode_id.index) for one in records}
    return ids == {(f, "test", n) for f in FAMILIES for n in range(TEST_EPISODES)}


def origin_limit(simulators: Sequence[str]) -> str:
    """Return where episodes come from, in a sentence."""
    known = {name: simulator_class(name).about for name in SIMULATORS}
    known["sample"] = "sample, made-up pictures without content, for trying the tools out"
    named = [known.get(name, f"the simulator {name}") for name in simulators]
    if not named:
        return "The recordings name no simulator."
    return f"The episodes come from {'; and from '.join(named)}."


def data_limits(
    queries: Sequence[EpisodeRecord], simulators: Sequence[str], more: Iterable[str]
) -> list[str]:
    """Return what data is not good for, as plain text, a sentence or two each."""
    found = [origin_limit(simulators)]
    if not is_whole_grid(queries):
        found.append(
            f"{len(queries):,} query episode{'s' * (len(queries) != 1)}, not the paper's grid of "
            f"{len(FAMILIES)} families × {TEST_EPISODES} test episodes: rates over these are not "
            "rates over the benchmark."
        )
    if any(record.episode_id.split == "test" for record in queries):
        found.append(
            "Test episodes are for evaluation. A policy that was trained on their demonstrations, "
            "goals or scenes is not measured by them."
        )
    found.append(
        "A lesson shows the answer to its own query, and the history is recorded, not what the "
        "robot itself went through: nothing here measures learning from failure, or forgetting by "
        "a policy's own training."
    )
    return [*found, *more]
