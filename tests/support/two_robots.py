"""A buffer set whose units are of another robot, with states of another number of values."""

from pathlib import Path

from support.buffer_sets import plan_again
from support.made_up import MadeUpSource

from robomme_interference_data.build_dataset.dataset.build import build_dataset
from robomme_interference_data.build_dataset.dataset.plan import DatasetPlan, PlannedEpisode
from robomme_interference_data.constants import DEMONSTRATIONS, UNITS, Unit
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.storage.files import LocalFiles

QUERIES = {"Lift/test/0": (12, 5), "Stack/test/0": (12, 5)}
TRAIN = {"Lift/train/0": (11, None), "Stack/train/0": (11, None)}
UNIT = Unit(4, 2)
CONDITIONS = ("no-history", "k0", "k1", "raw-k1")


def build_two_robots(root: Path, values: int, *others: str) -> Path:
    """Build lessons of 5 frames with 8 values, and units of 4 frames with `values`.

    Frame n of a recording has a state of n in all values. `others` are further datasets.
    """
    for kind in (DEMONSTRATIONS, *others, *UNITS):
        source = MadeUpSource(TRAIN, values=values) if kind in UNITS else MadeUpSource(QUERIES)
        episodes = tuple(PlannedEpisode(0, episode) for episode in source.episodes())
        plan = DatasetPlan(kind, (source,), episodes, unit=UNIT)
        if kind != DEMONSTRATIONS:
            plan = plan.matching(Dataset(LocalFiles(root / DEMONSTRATIONS)))
        build_dataset(plan, root / kind, Serial(), WorkProgress(quiet=True))
    plan_again(root, CONDITIONS)
    return root
