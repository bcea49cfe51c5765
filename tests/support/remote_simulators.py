"""Simulators in an interpreter of their own, for `--simulator support.remote_simulators:…`."""

from pathlib import Path

from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.simulators import RemoteSimulator


class Dot(RemoteSimulator):
    """The dot of `dot_worker.py`."""

    name = "dot"
    about = "a dot"
    worker = Path(__file__).with_name("dot_worker.py")
    needs = "numpy"
    cameras = ("top",)
    action_size = 2
    policies = ("oracle", "guess")
    suite_version = 4
    episodes_per_process = 2

    @classmethod
    def episodes(cls) -> list[EpisodeId]:
        """Two train and two test episodes of each family."""
        families = ("LeftSide", "RightSide")
        return [EpisodeId(f, s, n) for f in families for s in ("train", "test") for n in range(2)]


class AnyDot(Dot):
    """One that does not list its episodes, and so plays any."""

    @classmethod
    def episodes(cls) -> list[EpisodeId]:
        """None are listed."""
        return []
