"""FetchReach of Gymnasium-Robotics as a memory task, in an interpreter of its own.

`reach_worker.py` runs it there; this class declares what it is, and lists its episodes.
"""

from pathlib import Path

from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.simulators import RemoteSimulator

FAMILIES = ("ReachShown", "ReachOpposite")


class ReachSimulator(RemoteSimulator):
    """The arm reaches for the corner of a square that a marker showed, or for the opposite one."""

    name = "reach"
    about = "FetchReach of Gymnasium-Robotics, an example of a benchmark of one's own"
    worker = Path(__file__).with_name("reach_worker.py")
    needs = 'gymnasium-robotics (pip install "gymnasium-robotics==1.4.2" "mujoco<3.4")'
    remote_packages = ("gymnasium-robotics", "mujoco", "numpy")
    cameras = ("view",)
    action_size = 4
    fps = 25
    policies = ("oracle", "guess")
    suite_version = 1

    @classmethod
    def episodes(cls) -> list[EpisodeId]:
        """Return 5 train and 3 test episodes of each family."""
        counts = {"train": 5, "test": 3}
        return [EpisodeId(f, s, n) for f in FAMILIES for s in counts for n in range(counts[s])]
