"""History buffers for RoboMME-Interference, loaded by episode id.

```python
from robomme_interference_data import load_buffer

buffer = load_buffer("VideoRepick/test/7", k=3, split="my-split")
buffer.frames("front")  # (T, H, W, 3) uint8
```
"""

from robomme_interference_data.buffer import Buffer, Chunk
from robomme_interference_data.cache import DecodedCache
from robomme_interference_data.dataset import Dataset
from robomme_interference_data.errors import InterferenceError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.loader import Split, load_buffer, load_split
from robomme_interference_data.schema import BufferManifest, EpisodeRecord, SessionEntry
from robomme_interference_data.sessions import Session

__all__ = [
    # load
    "load_buffer",
    "load_split",
    "Split",
    "Buffer",
    "Chunk",
    "Session",
    "DecodedCache",
    # records
    "EpisodeId",
    "EpisodeRecord",
    "BufferManifest",
    "SessionEntry",
    "Dataset",
    # errors (all of them: robomme_interference_data.errors)
    "InterferenceError",
]
