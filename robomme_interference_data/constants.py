"""Constants of the protocol, and every path inside a dataset, buffer set or run."""

from typing import NamedTuple

FORMAT_VERSION = 1
"""Version of the file format; readers reject others."""

PROTOCOL_VERSION = 1
"""Version of the rollout rules; rows of different versions never mix."""

RULE_VERSION = 1
"""Version of the rule that draws distractor units (see `draw.py`)."""

DOCS_URL = "https://robotmemorybench.com/docs"
"""Address of the documentation; hints, help and the package's metadata name it."""

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

HELDOUT = "heldout"
"""Split of the episodes that RoboMME's challenge published as seeds."""

SPLITS = ("train", "val", "test", HELDOUT)
"""Splits, in canonical order."""

DIFFICULTIES = ("easy", "medium", "hard")

ABILITIES = ("recall", "several", "update", "order-first", "order-last", "absent")
"""What a query of a day needs of a memory, in the order of tables: one lesson; two halves of a
lesson, apart from each other; the newer one of two lessons with different answers; the first or the
last of two, as the goal says; to know that there was no lesson."""

MAX_K = 63
"""Most sessions that a condition adds to the lesson (ours; the paper uses up to 7)."""

UNIT_FRAMES = 32
"""Stored frames in a distractor unit."""

UNIT_STRIDE = 8
"""Raw frames between stored frames of a unit."""

MAX_STEPS = 1300
"""Executed steps after which a rollout times out."""

POSITION_LIMIT = 4096
"""Steps for which released MME-VLA servers hold position embeddings."""

ACTION_CHUNK = 16
"""Actions of a chunk that are executed before the next call of the policy."""

SAMPLE_FRAMES = 32
"""Frames in the memory of FrameSamp."""

VALUE_NAMES = (
    "joint_1",
    "joint_2",
    "joint_3",
    "joint_4",
    "joint_5",
    "joint_6",
    "joint_7",
    "gripper",
)
"""Values of RoboMME's states and actions: joint positions in rad; the gripper's opening in m in a
state, −1 closed to 1 open in an action."""

FPS = 10
"""Recorded frames per second."""

KEY_FRAMES = 16
"""Frames per key frame of an exact video; threads decode multiples of them."""

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

FRAME_COLUMNS = ("timestamp", "frame_index", "episode_index", "index", "task_index")
"""Columns that LeRobot adds to every frame, in its order."""
DATASET_FOLDERS = ("data", "meta", "videos")
"""Folders of a dataset's own files, which `SUMS_PATH` lists."""

PAPER_ENCODER = "google/siglip-so400m-patch14-384"
"""Model that embeds frames in the paper; its index is `index/siglip`."""

# --- paths inside a buffer set ------------------------------------------------------------------

DEMONSTRATIONS = "demonstrations"
DISTRACTORS = "distractors"
RAW_DISTRACTORS = "distractors-raw"
"""The episodes of the distractors, 256 frames at full rate."""
CONTRADICTIONS = "contradictions"
"""Lessons in the scenes of the queries with other answers."""
SHIFTED = "shifted"
"""First live observations of the queries under shifts: a frame for each of `shifts.SHIFTS`."""
EXECUTIONS = "executions"
"""Recordings of the queries from the first live observation on, with actions."""

DAYS = "days"
"""Recordings of a robot's days: many tasks, without a cut."""

LESSONS = (DEMONSTRATIONS, CONTRADICTIONS)
"""Datasets of lessons followed by their first live observation."""


class Unit(NamedTuple):
    """Size of a distractor unit, raw frames 0, stride and so on, and how many an episode yields.

    Attributes:
        frames: Stored frames; fewer at full rate if the episode is shorter.
        stride: Raw frames between stored frames.
        per_episode: Most units of a recorded episode, as far as they do not overlap.
    """

    frames: int
    stride: int
    per_episode: int = 1

    def __str__(self) -> str:
        text = f"{self.frames} frames at stride {self.stride}"
        return text if self.per_episode == 1 else f"{text}, up to {self.per_episode} of an episode"

    @property
    def raw_frames(self) -> int:
        """Raw frames that an episode must have: 249 for the indices 0, 8, …, 248."""
        return (self.frames - 1) * self.stride + 1

    def in_dataset(self, name: str) -> "Unit":
        """Return the unit in another dataset of the buffer set; this is that of the distractors."""
        if name == RAW_DISTRACTORS:  # the same raw frames, all of them
            return Unit(self.frames * self.stride, 1, self.per_episode)
        return self

    def recorded(self) -> dict[str, int]:
        """Return the unit as a dataset records it; one of an episode is not mentioned."""
        values = self._asdict()
        if self.per_episode == 1:
            del values["per_episode"]
        return values


PAPER_UNIT = Unit(UNIT_FRAMES, UNIT_STRIDE)
"""The paper's; the builder of a buffer set may choose another one."""

UNITS = (DISTRACTORS, RAW_DISTRACTORS)
"""Datasets of units."""

OPTIONAL_DATASETS = (RAW_DISTRACTORS, CONTRADICTIONS, SHIFTED, EXECUTIONS, DAYS)
"""Datasets that a buffer set may lack; on the Hub, folders of its repository."""

DATASETS = (DEMONSTRATIONS, DISTRACTORS, *OPTIONAL_DATASETS)
"""Names, and kinds, of a buffer set's datasets."""

QUESTIONS_PATH = "questions.parquet"
"""Questions about the past; optional."""

MANIFESTS = "manifests"
MANIFEST_HEADER = "manifest.json"
MANIFEST_ROWS = "buffers.parquet"
MANIFEST_PATH = f"{MANIFESTS}/{MANIFEST_HEADER}"
SHARD_PATH = "shard.json"
"""What the folder of a shard of a build is; in a buffer set, while shards are merged."""

FETCH_RECORD = f"{MANIFESTS}/fetched.json"
"""What a copy of a published buffer set holds."""

# --- names in rows -------------------------------------------------------------------------------

OFFICIAL = "robomme"
"""The benchmark's own simulator, the source of the published recordings and results."""

QUESTIONS = "questions"
"""The simulator in the rows of answered questions."""

RECORDINGS = "recordings"
"""Plays back executions for offline evaluation; a simulator in rows only, not one to choose."""

ORACLE = "oracle"
"""Name of the writer of subgoals that reads the simulator, which knows the answer."""

# --- files of a run -----------------------------------------------------------------------------

RUN_HEADER = "run.json"
RUN_RECORD = "rollouts.jsonl"
RUN_TABLES = ("rollouts.parquet", "rollouts.csv")
"""Exported from the record at the end of a run."""
MAX_ROW_BYTES = 2 << 30
"""Maximum bytes of a file of rows: two million rollouts have fewer."""
RUN_METRICS = "metrics.csv"
"""Written while a run proceeds, with `--track csv`."""
