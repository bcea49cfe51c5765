"""Go from recordings to a report: buffers, retrieval, a dozen rollouts, a score. Run: `make demo`.

The embedded simulator plays the episodes here, and is what the policy is evaluated in. Everything
lands in demo/. A second run repeats no episode and no rollout, and an interrupted one resumes.
"""

import os
import shlex
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
COMMAND = Path(sys.executable).parent / "robomme-interference"

ROLLOUTS = "--conditions k0,k7"
STEPS = {
    "Play three test episodes and nine others, and plan buffers of them": (
        "build demo/buffers --source tabletop --split test --episodes 0 "
        "--families MoveCube,PatternLock,RouteStick --unit-episodes 2 --cameras front "
        "--conditions no-history,k0,k3,k7"
    ),
    "Draw a buffer: the lesson, and seven sessions of other tasks behind it": (
        "show demo/buffers RouteStick/test/0 k7 --out demo/buffer.png"
    ),
    "Embed every frame, for retrieval": "index demo/buffers",
    "Explain which part of that buffer is retrieved": (
        "retrieve demo/buffers RouteStick/test/0 k7 --out demo/retrieval.png"
    ),
    "Roll out a policy that remembers frames sampled evenly from the whole buffer": (
        f"evaluate demo/buffers --policy replay:framesamp {ROLLOUTS} --out demo/runs/framesamp"
    ),
    "The same policy behind a retrieval step": (
        f"evaluate demo/buffers --policy replay:framesamp --retrieval thumbnail {ROLLOUTS} "
        "--out demo/runs/retrieval"
    ),
    "Compare the two": (
        "score demo/runs/framesamp demo/runs/retrieval --expected observed --out demo/score"
    ),
}

RESULTS = {
    "demo/score/report.html": "start here: success rates, differences and figures, on one page",
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
    say(f"\nDone in {time.monotonic() - began:.0f} s. What there is to open:\n")
    width = max(map(len, RESULTS))
    for path, what in RESULTS.items():
        say(f"  {path:{width}}  {what}")
    say("\nNext:\n")
    for line in NEXT:
        say(f"  {line}")


def say(text: str) -> None:
    """Print at once, so that lines and the commands' own output stay in order."""
    print(text, flush=True)


if __name__ == "__main__":
    os.chdir(ROOT)
    main()
