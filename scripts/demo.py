"""Show that other sessions bury a lesson and that retrieval finds it again. Run: `make demo`.

Buffers are built, a policy is rolled out with and without a retrieval step, and the results are
scored. The embedded simulator plays the episodes, and is what the policy is evaluated in. All is
written into demo/. A second run repeats no episode and no rollout, and an interrupted one resumes.
"""

import json
import os
import shlex
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
COMMAND = Path(sys.executable).parent / "robomme-interference"

LESSON_ONLY = "k0"
BURIED = "raw-k7"
FRAMESAMP = "demo/runs/framesamp"
RETRIEVAL = "demo/runs/retrieval"

STEPS = {
    "Play nine test episodes and eight or more others, and plan buffers of them": (
        "build demo/buffers --source tabletop --split test --episodes 0-2 "
        "--families MoveCube,PatternLock,RouteStick --unit-episodes 0 --cameras front "
        f"--conditions no-history,{LESSON_ONLY},k3,k7,{BURIED}"
    ),
    "Draw a buffer: the lesson, and seven sessions of other tasks behind it": (
        f"show demo/buffers RouteStick/test/0 {BURIED} --out demo/buffer.png"
    ),
    "Embed every frame, for retrieval": "index demo/buffers",
    "Explain which part of that buffer is retrieved": (
        f"retrieve demo/buffers RouteStick/test/0 {BURIED} --out demo/retrieval.png"
    ),
    "Roll out a policy that remembers 32 frames, sampled evenly from the whole buffer": (
        "evaluate demo/buffers --policy replay:framesamp "
        f"--conditions {LESSON_ONLY},{BURIED} --out {FRAMESAMP}"
    ),
    "The same policy behind a retrieval step": (
        "evaluate demo/buffers --policy replay:framesamp --retrieval thumbnail "
        f"--conditions {BURIED} --out {RETRIEVAL}"
    ),
    "Compare the two": (
        f"score {FRAMESAMP} {RETRIEVAL} --expected observed --png --out demo/score"
    ),
}

RESULTS = {
    "demo/score/report.html": "start here: success rates, differences and figures, on one page",
    "demo/score/figures/kinds-tabletop.png": "the figure of the sentence above",
    "demo/buffer.png": "what a policy is given before the episode: the lesson, then seven others",
    "demo/retrieval.png": "which of these frames the retrieval step passes on, and why",
    "demo/runs/retrieval/rollouts.jsonl": "one row for each rollout",
    "demo/buffers": "the datasets (LeRobot v3) and the buffers planned from them",
}

NEXT = (
    "robomme-interference verify demo/buffers",
    "robomme-interference evaluate demo/buffers --policy guess --out demo/runs/guess",
    "robomme-interference list demo/buffers",
)


def main() -> None:
    """Run the steps; list what they made."""
    began = time.monotonic()
    for number, (title, arguments) in enumerate(STEPS.items(), 1):
        say(f"\n{number} of {len(STEPS)}. {title}\n$ robomme-interference {arguments}")
        code = subprocess.run([str(COMMAND), *shlex.split(arguments)], check=False).returncode
        if code:
            say("\nIf an earlier version of the project made demo/: rm -r demo && make demo")
            sys.exit(code)
    say(f"\n{summary(Path(FRAMESAMP), Path(RETRIEVAL))}")
    say(f"\nDone in {time.monotonic() - began:.0f} s. What there is to open:\n")
    width = max(map(len, RESULTS))
    for path, what in RESULTS.items():
        say(f"  {path:{width}}  {what}")
    say("\nNext:\n")
    for line in NEXT:
        say(f"  {line}")


def summary(framesamp: Path, retrieval: Path) -> str:
    """Return what the rollouts of two runs show, in one sentence with its three numbers."""
    alone = successes(framesamp, LESSON_ONLY)
    buried = successes(framesamp, BURIED)
    retrieved = successes(retrieval, BURIED)
    return (
        f"With the lesson alone the policy succeeds in {alone} episodes, with seven other sessions "
        f"behind the lesson in {buried}, and with retrieval in front of it in {retrieved}."
    )


def successes(run: Path, condition: str) -> str:
    """Return how many rollouts of a run succeeded under a condition, such as "3 of 9"."""
    lines = (run / "rollouts.jsonl").read_text(encoding="utf-8").splitlines()
    rows = [json.loads(line) for line in lines]
    # A rollout that broke has a row for each attempt: the last one counts.
    last = {(row["family"], row["episode"]): row for row in rows if row["condition"] == condition}
    statuses = [row["status"] for row in last.values()]
    return f"{statuses.count('success')} of {len(statuses)}"


def say(text: str) -> None:
    """Print at once, so that lines and the commands' own output stay in order."""
    print(text, flush=True)


if __name__ == "__main__":
    os.chdir(ROOT)
    main()
