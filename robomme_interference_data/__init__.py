"""History buffers for RoboMME-Interference, loaded by episode id.

```python
from robomme_interference_data import load_buffer

buffer = load_buffer("VideoRepick/test/7", "k3", split="my-split")
buffer.frames("front")  # (T, H, W, 3) uint8
```
"""

from typing import TYPE_CHECKING

from robomme_interference_data.lazy import lazily

if TYPE_CHECKING:
    from robomme_interference_data.data.buffer import Buffer, Chunk
    from robomme_interference_data.data.buffer_set import Split
    from robomme_interference_data.data.dataset import Dataset
    from robomme_interference_data.data.loading import load_buffer, load_split
    from robomme_interference_data.data.query import Query
    from robomme_interference_data.errors import InterferenceError
    from robomme_interference_data.ids import EpisodeId
    from robomme_interference_data.schema.conditions import Condition
    from robomme_interference_data.schema.manifest import BufferManifest, Session, SessionEntry
    from robomme_interference_data.schema.records import EpisodeRecord
    from robomme_interference_data.schema.rollouts import Rollout
    from robomme_interference_data.storage.cache import DecodedCache

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

__getattr__ = lazily(
    __name__,
    *(".data.loading", ".data.buffer_set", ".data.buffer", ".storage.cache", ".data.query"),
    *(".schema.records", ".schema.manifest", ".schema.rollouts"),
    *(".ids", ".schema.conditions", ".data.dataset", ".errors"),
)
