"""Run policies on the benchmark, and score what came out.

```python
from pathlib import Path

from robomme_interference_data.evaluate import RunConfig, run_evaluation

if __name__ == "__main__":  # worker processes import the script
    config = RunConfig(policy="replay", split=Path("demo/tabletop"), out=Path("runs/replay"))
    print(run_evaluation(config).counts)
```
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from robomme_interference_data.evaluate.config import RunConfig
    from robomme_interference_data.evaluate.merge import Merged, merge_runs
    from robomme_interference_data.evaluate.policies.base import Policy, RolloutInfo
    from robomme_interference_data.evaluate.run import RunResult, run_evaluation

__all__ = [
    "Merged",
    "Policy",
    "RolloutInfo",
    "RunConfig",
    "RunResult",
    "merge_runs",
    "run_evaluation",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is asked for: the command line imports this package first."""
    homes = {"RunConfig": "config", "merge_runs": "merge", "Merged": "merge"}
    homes |= {"Policy": "policies.base", "RolloutInfo": "policies.base"}
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{homes.get(name, 'run')}"), name)
