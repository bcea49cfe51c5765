"""Run policies on the benchmark, and implement policies of your own.

```python
from pathlib import Path

from robomme_interference_data.evaluate import RunConfig, run_evaluation

if __name__ == "__main__":  # worker processes import the script
    config = RunConfig(policy="replay", buffer_set=Path("demo/buffers"), out=Path("runs/replay"))
    print(run_evaluation(config).counts)
```

What only some runs use (subgoals, answers, shared policies, servers, videos, tracking) is imported
in the function that uses it: most runs import none of it.
"""

from typing import TYPE_CHECKING

from robomme_interference_data.lazy import lazy_exports

if TYPE_CHECKING:
    from robomme_interference_data.schema.evidence import Evidence
    from robomme_interference_data.schema.subgoal import Subgoal
    from robomme_interference_data.simulators.base import Simulator
    from robomme_interference_data.simulators.episode import Observation

    from .policies.policy import BatchPolicy, Frames, Policy, RolloutInfo
    from .run.config import AskConfig, RunConfig
    from .run.evaluation import RunResult, run_evaluation
    from .run.merge import Merged, merge_runs

__all__ = [
    # run
    "AskConfig",
    "Merged",
    "RunConfig",
    "RunResult",
    "merge_runs",
    "run_evaluation",
    # implement a policy
    "BatchPolicy",
    "Evidence",
    "Frames",
    "Observation",
    "Policy",
    "RolloutInfo",
    "Simulator",
    "Subgoal",
]

__getattr__ = lazy_exports(
    __name__,
    {
        ".policies.policy": "BatchPolicy Frames Policy RolloutInfo",
        ".run.config": "AskConfig RunConfig",
        ".run.evaluation": "RunResult run_evaluation",
        ".run.merge": "Merged merge_runs",
        "robomme_interference_data.schema.evidence": "Evidence",
        "robomme_interference_data.schema.subgoal": "Subgoal",
        "robomme_interference_data.simulators.base": "Simulator",
        "robomme_interference_data.simulators.episode": "Observation",
    },
)
