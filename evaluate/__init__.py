"""Run policies on the benchmark, and score what came out.

```python
from robomme_interference_data.evaluate import run_evaluation

if __name__ == "__main__":  # worker processes import the script
    result = run_evaluation("replay", "demo/tabletop", "runs/replay-full", episodes="0")
```
"""

from robomme_interference_data.evaluate.merge import Merged, merge_runs
from robomme_interference_data.evaluate.policies.base import Policy, RolloutInfo
from robomme_interference_data.evaluate.rows import Rollout
from robomme_interference_data.evaluate.runner import RunResult, run_evaluation

__all__ = [
    "Merged",
    "Policy",
    "Rollout",
    "RolloutInfo",
    "RunResult",
    "merge_runs",
    "run_evaluation",
]
