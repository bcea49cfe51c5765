"""Run policies on the benchmark, and score what came out.

```python
from pathlib import Path

from . import RunConfig, run_evaluation

if __name__ == "__main__":  # worker processes import the script
    config = RunConfig(policy="replay", buffer_set=Path("demo/buffers"), out=Path("runs/replay"))
    print(run_evaluation(config).counts)
```
"""

from typing import TYPE_CHECKING

from robomme_interference_data.lazy import lazy_exports

if TYPE_CHECKING:
    from .policies.policy import Policy, RolloutInfo
    from .run.config import AskConfig, RunConfig
    from .run.evaluation import RunResult, run_evaluation
    from .run.merge import Merged, merge_runs

__all__ = [
    "AskConfig",
    "Merged",
    "Policy",
    "RolloutInfo",
    "RunConfig",
    "RunResult",
    "merge_runs",
    "run_evaluation",
]

__getattr__ = lazy_exports(
    __name__,
    {
        ".policies.policy": "Policy RolloutInfo",
        ".run.config": "AskConfig RunConfig",
        ".run.evaluation": "RunResult run_evaluation",
        ".run.merge": "Merged merge_runs",
    },
)
