"""Train on history buffers: a map-style PyTorch dataset, whose items are what a rollout gives.

```python
from robomme_interference_data.training import HistoryDataset

data = HistoryDataset("my-buffers", conditions={"k0": 1, "k7": 1}, memory="framesamp:32")
```
"""

from typing import TYPE_CHECKING

from robomme_interference_data.lazy import lazy_exports

if TYPE_CHECKING:
    from robomme_interference_data.schema.sampling import Memory
    from robomme_interference_data.storage.resize import resize

    from .history_dataset import HistoryDataset
    from .sampler import HistorySampler

__all__ = ["HistoryDataset", "HistorySampler", "Memory", "resize"]

__getattr__ = lazy_exports(
    __name__,
    {
        ".history_dataset": "HistoryDataset",
        ".sampler": "HistorySampler",
        "robomme_interference_data.schema.sampling": "Memory",
        "robomme_interference_data.storage.resize": "resize",
    },
)
