"""Numbers and names fixed by the protocol, and every path inside a dataset or buffer set."""

from typing import NamedTuple

FORMAT_VERSION = 1
"""Version of the files that this package writes; a reader refuses one that it does not know."""

PROTOCOL_VERSION = 1
"""Version of the rules by which a rollout is run; rows of different versions never mix."""

RULE_VERSION = 1
"""Version of the rule that draws distractor units for a query (see `draw.py`)."""

# --- protocol (paper, section "The Benchmark") -----------------------------------------------

FAMILIES = (
    "VideoRepick",
    "VideoPlaceOrder",
    "VideoPlaceButton",
    "VideoUnmask",
    "VideoUnmaskSwap",
    "MoveCube",
    "InsertPeg",
    "PatternLock",
    "RouteStick",
)
"""The nine task families of the benchmark, in the paper's order (object, spatial, procedural)."""

SPLITS = ("train", "val", "test")

DIFFICULTIES = ("easy", "medium", "hard")

MAX_K = 63
"""Most sessions that a condition adds to the lesson (ours; the paper's most is 7)."""

UNIT_FRAMES = 32
"""Stored frames in a distractor unit."""

UNIT_STRIDE = 8
"""Raw frames from one stored frame of a unit to the next."""

UNIT_MIN_RAW_FRAMES = (UNIT_FRAMES - 1) * UNIT_STRIDE + 1
"""Raw frames that an episode needs to yield a unit: indices 0, 8, …, 248, so 249."""

MAX_STEPS = 1300
"""Executed steps after which a rollout times out."""

POSITION_LIMIT = 4096
"""Steps for which released MME-VLA servers hold position embeddings."""

ACTION_CHUNK = 16
"""Actions of a chunk that are executed before the policy is asked again."""

SAMPLE_FRAMES = 32
"""Frames that FrameSamp keeps of its whole history."""

FPS = 10
"""Recorded frames per second."""

KEY_FRAMES = 16
"""Frames from one key frame of an exact video to the next; threads decode whole such spans."""

# --- features of a dataset -------------------------------------------------------------------

FRONT = "observation.images.front"
WRIST = "observation.images.wrist"
STATE = "observation.state"
ACTION = "action"
CAMERA_PREFIX = "observation.images."

# --- paths inside a dataset (LeRobot v3 layout, plus our four files in meta/) ------------------

INFO_PATH = "meta/info.json"
TASKS_PATH = "meta/tasks.parquet"
STATS_PATH = "meta/stats.json"
EPISODES_DIR = "meta/episodes"
IDENTITY_PATH = "meta/interference.json"
RECORDS_PATH = "meta/interference.parquet"
REPORT_PATH = "meta/build_report.json"
SUMS_PATH = "meta/SHA256SUMS"
INDEX_DIR = "index"
INDEX_HEADER = "index.json"

PAPER_ENCODER = "google/siglip-so400m-patch14-384"
"""Model that embeds frames in the paper; its index is `index/siglip`."""

# --- paths inside a buffer set ----------------------------------------------------------------------

DEMONSTRATIONS = "demonstrations"
DISTRACTORS = "distractors"
RAW_DISTRACTORS = "distractors-raw"
"""The same episodes as the distractors', 256 frames at full rate."""
CONTRADICTIONS = "contradictions"
"""Lessons in the scenes of the queries, with other answers."""
SHIFTED = "shifted"
"""What the queries look like under shifts: a frame each, in the order of `shifts.SHIFTS`."""

LESSONS = (DEMONSTRATIONS, CONTRADICTIONS)
"""Whose episodes are lessons, with the query frame after them; those of
`UNITS` are units."""


class Unit(NamedTuple):
    """What a distractor unit is cut of a recorded episode: raw frames 0, stride, and so on.

    Attributes:
        frames: Stored frames; fewer at full rate, if the episode ends before.
        stride: Raw frames from one stored frame to the next.
    """

    frames: int
    stride: int


UNITS = {
    DISTRACTORS: Unit(UNIT_FRAMES, UNIT_STRIDE),
    RAW_DISTRACTORS: Unit(UNIT_FRAMES * UNIT_STRIDE, 1),
}
"""Of what the units of a dataset are."""

OPTIONAL_DATASETS = (RAW_DISTRACTORS, CONTRADICTIONS, SHIFTED)
"""Datasets that a buffer set may lack; on the Hub they are folders of its repository."""

DATASETS = (DEMONSTRATIONS, DISTRACTORS, *OPTIONAL_DATASETS)
"""Names of a buffer set's datasets, which are their kinds."""
QUESTIONS_PATH = "questions.parquet"
"""Questions about the past, which a buffer set may have."""
PARTS_PATH = "parts.json"
"""Digests of what a published version holds, by which the next one is numbered."""

MANIFESTS = "manifests"
MANIFEST_HEADER = "manifest.json"
MANIFEST_ROWS = "buffers.parquet"
MANIFEST_PATH = f"{MANIFESTS}/{MANIFEST_HEADER}"

# --- files of a run -----------------------------------------------------------------------------

RUN_HEADER = "run.json"
RUN_RECORD = "rollouts.jsonl"
RUN_TABLES = ("rollouts.parquet", "rollouts.csv")
"""Exported from the record when a run ends."""
