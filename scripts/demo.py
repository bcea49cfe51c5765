"""Go the whole way: recorded episodes in; buffers, rollouts and a report out. Run with `make demo`.

Where RoboMME's recordings lie beside the project (../shared/data), the demonstrations are the
nine families' first test episodes and the distractors come from its training episodes, filled up
with made-up sessions; elsewhere, all of it is a sample that the project records itself. Then the
embedded simulator plays all nine families, the controls are evaluated on it and scored, and
questions about what it showed are asked of the ideal observer and of chance.
Everything lands in demo/; what is there already is not made again.
"""

import os
import shlex
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

ROOT = Path(__file__).resolve().parent.parent
DEMO = Path("demo")
SHARED = Path("..") / "shared" / "data"
SPLIT = DEMO / "split"
THERE_BEFORE = (ROOT / DEMO).exists()
COMMAND = Path(sys.executable).parent / "robomme-interference"

FILLERS = "SampleReach,SamplePush,SampleStack,SampleWipe,SamplePour"
"""Families of made-up sessions, so that every query has seven others to draw from."""


def main() -> None:
    """Build, draw, audit, publish, load, retrieve; the same simulated; evaluate, ask, and score."""
    began = time.monotonic()
    DEMO.mkdir(exist_ok=True)
    sample = ["--source sample"]
    queries, units = recorded_here() if SHARED.is_dir() else (sample, sample)
    run("build demonstrations", *queries, "--split test", f"--out {SPLIT}/demonstrations")
    run("build distractors", *units, f"--out {SPLIT}/distractors")
    run(f"build manifests {SPLIT} --conditions no-history,k0,k1,k3,k7 --seed 0")
    run(f"show VideoRepick/test/0 k7 --split {SPLIT} --out {DEMO}/strip.png")
    run(f"audit {SPLIT}")
    # As it would be on the Hub, after every hash and rule has been checked.
    run(f"publish {SPLIT} --repo-id my-name/my-split --to {DEMO}/export")
    load()
    retrieve(SPLIT, "VideoUnmask/test/0", DEMO / "retrieval.png")
    simulate()
    retrieve(DEMO / "tabletop", "MoveCube/test/0", DEMO / "tabletop_retrieval.png")
    evaluate()
    ask()
    say(f"\nDone in {time.monotonic() - began:.0f} s: {DEMO / 'score' / 'report.html'}")


def retrieve(split: Path, episode: str, picture: Path) -> None:
    """Embed a split, draw why a session was chosen, and grade the choice on all buffers."""
    run(f"index {split} --encoder thumbnail")
    run(f"retrieve {episode} k7 --split {split} --out {picture}")
    run(f"retrieval-score {split} --out {DEMO}/retrieval/{split.name}")


def simulate() -> None:
    """Build a small split of all nine families from the embedded simulator."""
    out = DEMO / "tabletop"
    played = "--source tabletop --split test --episodes 0"
    run(f"build demonstrations {played} --out {out}/demonstrations")
    run(f"build distractors --source tabletop --episodes 2 --out {out}/distractors")
    # Beside the paper's: the lesson after the units, delay without content, and no lesson at all.
    conditions = "no-history,k0,k1,k3,k7,before-k7,held-k7,absent-k7"
    run(f"build manifests {out} --conditions {conditions}")
    run(f"show PatternLock/test/0 k7 --split {out} --out {DEMO}/tabletop.png")


def evaluate() -> None:
    """Roll out the controls on a handful of episodes under all conditions, and score them."""
    policies = {f"replay-{m}": f"replay:{m}" for m in ("framesamp", "window")}
    policies |= {"recall-framesamp": "recall:framesamp", "guess": "guess", "oracle": "oracle"}
    runs = [DEMO / "runs" / system for system in policies]
    for out, policy in zip(runs, policies.values(), strict=True):
        run(
            f"evaluate --policy {policy} --split {DEMO}/tabletop --out {out} --episodes 0",
            "--families MoveCube,PatternLock,RouteStick --workers 2",
        )
    # Three episodes a cell, not the benchmark's 450: a cell is complete with those given.
    run(f"score {' '.join(map(str, runs))} --grid given --out {DEMO}/score")


def ask() -> None:
    """Ask questions about the past: of the ideal observer, and of chance."""
    split = DEMO / "tabletop"
    run(f"build questions {split}")
    run(f"question VideoUnmask/test/0 --split {split} --out {DEMO}/question.png")
    runs = [DEMO / "asked" / model for model in ("recall", "guess")]
    for out in runs:
        run(f"ask --model {out.name} --split {split} --out {out} --conditions no-history,k0,k7")
    run(f"score {' '.join(map(str, runs))} --grid given --out {DEMO}/score-questions")


def recorded_here() -> tuple[list[str], list[str]]:
    """Prepare RoboMME's recordings; return the sources of demonstrations and of distractors."""
    recordings, lessons = DEMO / "recordings", DEMO / "lessons"
    if not (recordings / "done").exists():
        say("Unpacking RoboMME's own recordings (HDF5, five families)")
        unpack = [sys.executable, str(SHARED / "unpack_h5.py"), str(recordings)]
        subprocess.run(unpack, check=True, stdout=subprocess.DEVNULL)
        (recordings / "done").touch()
    if not (lessons / "frames.parquet").exists():
        say("Laying out the first test episode of each of the nine families (front camera)")
        lay_out_lessons(SHARED / "lessons", lessons)
    return (
        [f"--source frames:{lessons}"],
        [
            f"--source robomme-h5:{recordings} --source sample:{FILLERS}",
            "--cameras front",
        ],
    )


def lay_out_lessons(lessons: Path, folder: Path) -> None:
    """Bring the lessons into the layout of a `frames` source (docs/sources.md)."""
    rows = []
    for path in sorted(lessons.glob("*.npz")):
        with np.load(path) as lesson:
            episode_id = f"{lesson['env_id']}/test/{lesson['episode']}"
            video = folder / "videos" / "front" / f"{episode_id}.mkv"
            video.parent.mkdir(parents=True, exist_ok=True)
            video.write_bytes(path.with_name(f"{path.stem}_front.mkv").read_bytes())
            rows += [
                {
                    "episode_id": episode_id,
                    "frame_index": index,
                    "state": state,
                    "is_demo": index < int(lesson["exec_start_idx"]),
                    "goal": str(lesson["task_goal"].flat[0]),
                    "seed": int(lesson["seed"]),
                    "difficulty": str(lesson["difficulty"]),
                    "simulator": "robomme",
                    "exact": True,
                }
                for index, state in enumerate(lesson["state"])
            ]
    pq.write_table(pa.Table.from_pylist(rows), folder / "frames.parquet")


def load() -> None:
    """Load a buffer by its episode id, as a notebook would."""
    from robomme_interference_data import load_buffer

    say('\n>>> buffer = load_buffer("VideoRepick/test/0", "k3", split="demo/export", verify=True)')
    buffer = load_buffer("VideoRepick/test/0", "k3", split=DEMO / "export", verify=True)
    say(f'>>> buffer\n{buffer}\n>>> buffer.goal\n"{buffer.goal}"')
    say(f'>>> buffer.frames("front").shape\n{buffer.frames("front").shape}')
    say(f">>> buffer.states.shape\n{buffer.states.shape}")
    for session in buffer.sessions:
        say(f"{session.start:5} – {session.stop - 1:4}  {session.role:10}  {session.source}")


def run(*parts: str) -> None:
    """Print and run one of the project's commands; end with its exit code if it fails."""
    words = " ".join(parts)
    say(f"\n$ robomme-interference {words}")
    code = subprocess.run([str(COMMAND), *shlex.split(words)], check=False).returncode
    if code and THERE_BEFORE:
        say(
            "\nSome of demo/ was there before. If an earlier version of the project made it, "
            "start afresh: rm -r demo && make demo"
        )
    if code:
        sys.exit(code)


def say(text: str) -> None:
    """Print at once, so that lines and the commands' own output stay in order."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    os.chdir(ROOT)
    main()
