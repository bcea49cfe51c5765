"""History buffers for RoboMME-Interference, loaded by episode id.

```python
from robomme_interference_data import load_buffer

buffer = load_buffer("VideoRepick/test/7", "k3", buffer_set="my-buffers")
buffer.frames("front")  # (T, H, W, 3) uint8
```
"""

import sys
from typing import TYPE_CHECKING

from .lazy import lazy_exports

if TYPE_CHECKING:
    from .data.buffer import Buffer, Chunk
    from .data.buffer_set import BufferSet
    from .data.dataset import Dataset
    from .data.loading import load_buffer, load_buffer_set
    from .data.query import Query
    from .errors import InterferenceError
    from .evaluate.run.row import Rollout
    from .ids import EpisodeId
    from .schema.conditions import Condition
    from .schema.manifest import BufferManifest, Session, SessionEntry
    from .schema.records import EpisodeRecord
    from .storage.cache import DecodedCache

__all__ = [
    # load
    "load_buffer",
    "load_buffer_set",
    "BufferSet",
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

if "IPython" in sys.modules:
    from .notebooks import register

    register()

__getattr__ = lazy_exports(
    __name__,
    {
        ".data.loading": "load_buffer load_buffer_set",
        ".data.buffer_set": "BufferSet",
        ".data.buffer": "Buffer Chunk",
        ".data.query": "Query",
        ".data.dataset": "Dataset",
        ".storage.cache": "DecodedCache",
        ".ids": "EpisodeId",
        ".schema.conditions": "Condition",
        ".schema.records": "EpisodeRecord",
        ".schema.manifest": "BufferManifest Session SessionEntry",
        ".evaluate.run.row": "Rollout",
        ".errors": "InterferenceError",
    },
)
