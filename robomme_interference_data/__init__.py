"""History buffers for RoboMME-Interference, loaded by episode id.

```python
from robomme_interference_data import load_buffer

buffer = load_buffer("VideoRepick/test/7", "k3", split="my-split")
buffer.frames("front")  # (T, H, W, 3) uint8
```
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from robomme_interference_data.buffer import Buffer, Chunk
    from robomme_interference_data.cache import DecodedCache
    from robomme_interference_data.conditions import Condition
    from robomme_interference_data.dataset import Dataset
    from robomme_interference_data.errors import InterferenceError
    from robomme_interference_data.ids import EpisodeId
    from robomme_interference_data.query import Query
    from robomme_interference_data.records import (
        BufferManifest,
        EpisodeRecord,
        Rollout,
        Session,
        SessionEntry,
    )
    from robomme_interference_data.split import Split, load_buffer, load_split

__all__ = [
    # load
    "load_buffer",
    "load_split",
    "Split",
    "Buffer",
    "Chunk",
    "Session",
    "Query",
    "DecodedCache",
    # records
    "EpisodeId",
    "Condition",
    "EpisodeRecord",
    "BufferManifest",
    "SessionEntry",
    "Rollout",
    "Dataset",
    # errors (all of them: robomme_interference_data.errors)
    "InterferenceError",
]

_MODULES = (
    "split",
    "buffer",
    "cache",
    "query",
    "records",
    "ids",
    "conditions",
    "dataset",
    "errors",
)


def __getattr__(name: str) -> Any:
    """Import a public name when it is used: the command line and workers need few of them."""
    if name in __all__:
        for module in _MODULES:
            found = import_module(f"{__name__}.{module}")
            if name in found.__all__:
                return getattr(found, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
