"""Simulators of the benchmark's task families.

```python
from robomme_interference_data.simulators import make_simulator

simulator = make_simulator("tabletop")
lesson, first, info = simulator.reset("MoveCube/test/3")
observation, status = simulator.step(action)
simulator.close()
```
"""

from typing import TYPE_CHECKING

from robomme_interference_data.lazy import lazy_exports

if TYPE_CHECKING:
    from robomme_interference_data.schema.rollouts import Status

    from .base import Simulator
    from .episode import Demonstration, EpisodeInfo, Observation
    from .registry import SIMULATORS, make_simulator
    from .remote.simulator import RemoteSimulator

__all__ = [
    # factory
    "make_simulator",
    "SIMULATORS",
    # interface
    "Simulator",
    "RemoteSimulator",
    "Demonstration",
    "EpisodeInfo",
    "Observation",
    "Status",
]

__getattr__ = lazy_exports(
    __name__,
    {
        ".registry": "make_simulator SIMULATORS",
        ".base": "Simulator",
        ".remote.simulator": "RemoteSimulator",
        ".episode": "Demonstration EpisodeInfo Observation",
        "robomme_interference_data.schema.rollouts": "Status",
    },
)
