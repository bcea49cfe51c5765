"""Make the reference plans of the package, from what is recorded of their episodes.

`PYTHONPATH=tests python tests/support/make_plans.py official DATASET…` takes the lengths of lessons
from `docs/results/robomme/lessons.parquet`, and from the given datasets, which one renderer drew,
all digests and further units. The units of the present plan stay.
`… make_plans.py tutorial BUFFER_SET` takes all of a buffer set.
"""

import sys
import tempfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
from support.buffer_sets import plan_again
from support.made_up import record, write_metadata

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.verify import reference
from robomme_interference_data.build_dataset.verify.reference import (
    read_plan,
    reference_plan,
    write_plan,
)
from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    FORMAT_VERSION,
    OFFICIAL,
    PAPER_UNIT,
    RULE_VERSION,
)
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.data.renderers import dataset_renderers
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.conditions import DEFAULT_CONDITIONS
from robomme_interference_data.schema.reference_plan import ReferenceEpisode, ReferencePlan
from robomme_interference_data.storage.files import LocalFiles

LESSONS = Path(__file__).parents[2] / "docs" / "results" / "robomme" / "lessons.parquet"
PLANS = Path(reference.__file__).with_name("plans")


def planned(plan: ReferencePlan, folder: Path) -> ReferencePlan:
    """Plan the buffers of a reference plan again, as `build` does, from its episodes alone."""
    for name in {episode.dataset: None for episode in plan.episodes}:
        records = []
        for number, episode in enumerate(e for e in plan.episodes if e.dataset == name):
            lesson = None if name != DEMONSTRATIONS else episode.frames
            made = record(name, str(episode.episode), number, lesson=episode.frames)
            changes = {
                "length": episode.frames + (lesson is not None),
                "exec_start_idx": lesson,
                "span_sha256": None if lesson is None else made.span_sha256,
                "simulator": plan.simulators[0],
            }
            records.append(replace(made, **changes))
        write_metadata(folder / name, name, records)
    plan_again(folder, plan.conditions, seed=plan.seed)
    made_again = reference_plan(load_buffer_set(folder))
    digests = {(episode.dataset, episode.episode): episode.digests for episode in plan.episodes}
    episodes = tuple(
        replace(episode, digests=digests[episode.dataset, episode.episode])
        for episode in made_again.episodes
    )
    return replace(made_again, episodes=episodes, renderers=plan.renderers)


def official(datasets: Iterable[Dataset], folder: Path) -> ReferencePlan:
    """Return the plan of the official query episodes."""
    renderers: dict[str, str | None] = {}
    known: dict[tuple[str, EpisodeId], ReferenceEpisode] = {}
    if (PLANS / "official.json").is_file():
        for episode in read_plan("official").episodes:
            known[episode.dataset, episode.episode] = replace(episode, digests={})
            renderers[episode.dataset] = None
    for row in pq.read_table(LESSONS, columns=["episode_id", "lesson_frames"]).to_pylist():
        key = DEMONSTRATIONS, EpisodeId.parse(row["episode_id"])
        known.setdefault(key, ReferenceEpisode(*key, row["lesson_frames"], {}))
    for dataset in datasets:
        renderer = dataset_renderers({dataset.kind: dataset})[dataset.kind]
        if (renderers.get(dataset.kind) or renderer) != renderer:
            sys.exit(f"{renderer} drew {dataset.files.location}, another one the datasets before")
        renderers[dataset.kind] = renderer
        for stored in dataset.records():
            start, stop = stored.session
            key = dataset.kind, stored.episode_id
            known[key] = ReferenceEpisode(*key, stop - start, stored.feature_sha256)
    episodes = tuple(known[key] for key in sorted(known))
    plan = ReferencePlan(
        FORMAT_VERSION,
        RULE_VERSION,
        0,
        (OFFICIAL,),
        PAPER_UNIT.recorded(),
        DEFAULT_CONDITIONS,
        renderers,
        episodes,
        (),
    )
    return planned(plan, folder)


if __name__ == "__main__":
    name, *folders = sys.argv[1:]
    if name == "official":
        with tempfile.TemporaryDirectory() as temporary:
            opened = [Dataset(LocalFiles(Path(folder))) for folder in folders]
            plan = official(opened, Path(temporary))
    else:
        plan = reference_plan(load_buffer_set(folders[0]))
    write_plan(plan, PLANS / f"{name}.json")
