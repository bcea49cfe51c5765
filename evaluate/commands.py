"""The commands `ceiling`, `evaluate` and `ask`, and `merge` for runs."""

from collections.abc import Sequence
from pathlib import Path

import typer

from robomme_interference_data.cli.console import (
    check_output,
    command_line,
    echo,
    graceful_interrupt,
    print_json,
    print_status,
)
from robomme_interference_data.cli.options import AsJson, BufferSetFolder, with_settings
from robomme_interference_data.errors import counted
from robomme_interference_data.schema.shifts import NO_SHIFT

from .run.config import AskConfig, CeilingConfig, RunConfig


@with_settings
def ceiling(buffer_set: BufferSetFolder, config: CeilingConfig, as_json: AsJson = False) -> None:
    r"""Print how often an ideal observer with a memory rule would succeed, without a rollout.

    It uses marked evidence only; the share of it that the memory keeps is printed, too.

    Examples:
    ```
    robomme-interference ceiling my-buffers --memory window
    robomme-interference ceiling my-buffers --memory window:60@2
    robomme-interference ceiling my-buffers --memory framesamp:64 --frames 2
    robomme-interference ceiling my-buffers --retrieval thumbnail \
      --shift light:2
    ```
    """
    from robomme_interference_data.data.loading import load_buffer_set
    from robomme_interference_data.schema.codec import to_dict
    from robomme_interference_data.schema.sampling import Memory

    from . import ceiling as module

    opened = load_buffer_set(buffer_set)
    cells = module.ceiling(opened, config)
    if as_json:
        print_json([to_dict(cell) for cell in cells])
        return
    title = f"Ceiling on {opened.name}, memory {Memory.parse(config.memory)}"
    if config.frames > 1:
        title += f", {config.frames} frames of a part"
    if config.retrieval is not None:
        title += f", with retrieval {config.retrieval}, rule {config.retrieval_rule}"
        title += "" if config.shift == NO_SHIFT else f", shift {config.shift}"
    echo(module.ceiling_table(cells, title).text())


@with_settings
def evaluate(config: RunConfig, as_json: AsJson = False) -> None:
    r"""Roll out a policy under the benchmark's conditions, one row per rollout.

    Before each episode the policy gets the history of the condition: nothing (no-history), the
    lesson (k0), or the lesson and k sessions of other tasks. OUT/rollouts.jsonl has a row for each
    rollout, OUT/run.json the settings; tables are exported when the run ends. To resume an
    interrupted run, re-run the same command: it skips finished rollouts and repeats errors.

    Before the first row, a probe repeats short rollouts after others. If policy, simulator or
    subgoal writer keep a state, the run does not begin; if they are not deterministic, it
    measures how many outcomes flip. OUT/run.json has what it found.

    With --offline there is no simulator: the policy acts along recorded executions, and rows have
    the difference of its actions to the recorded ones. The policies hold and mean fit any robot,
    as your own may.

    Examples:
    ```
    robomme-interference evaluate my-buffers --policy replay:window \
      --out runs/window

    robomme-interference evaluate my-buffers --policy hold --offline \
      --out runs/offline

    robomme-interference evaluate my-buffers \
      --policy websocket://localhost:8000 --system perceptual-framesamp-modul \
      --conditions k0,k7 --out runs/framesamp \
      --policy-option checkpoint=mme_vla_suite/perceptual-framesamp-modul/79999

    robomme-interference evaluate my-buffers --policy lerobot:me/act@v1 \
      --system act-v1 --policy-option device=cpu --out runs/act
    ```
    """
    _run(config, "Finished rollouts", "rollouts", as_json=as_json)


@with_settings
def ask(config: AskConfig, as_json: AsJson = False) -> None:
    r"""Ask a model multiple-choice questions about history buffers, without a simulator.

    It sees the goal, the first live observation with the possible answers marked, and the history
    frames that its memory keeps. Rows are scored like those of rollouts; OUT/answers has the
    transcripts. First make the questions: robomme-interference build BUFFER_SET --only questions.

    Examples:
    ```
    robomme-interference ask my-buffers --model recall --out runs/recall \
      --conditions k0,k7

    robomme-interference ask my-buffers --system qwen3-vl-4b --out runs/qwen \
      --model openai:http://localhost:8000/v1#Qwen/Qwen3-VL-4B-Instruct
    ```
    """
    _run(config, "Answers", "questions", as_json=as_json)


def _run(config: RunConfig | AskConfig, kept: str, unit: str, *, as_json: bool) -> None:
    """Run, and print the results; exit with 1 after errors."""
    from robomme_interference_data.schema.codec import to_dict

    from .probe.result import probe_text
    from .run.evaluation import run_evaluation
    from .run.progress import RunProgress, error_table, rate_table

    check_output(config.out)
    offline = isinstance(config, RunConfig) and config.offline
    with (
        graceful_interrupt(f"{kept} are in {config.out}", config.out),
        RunProgress(quiet=as_json, unit=unit, workers=config.workers) as shown,
    ):
        result = run_evaluation(config, progress=shown, command=[command_line()])
    if as_json:
        if result.probe is not None and not result.probe.all_independent:
            print_status(probe_text(result.probe))  # else it is printed before the rows
        print_json([to_dict(row) for row in result.rows])
    else:
        echo((error_table if offline else rate_table)(result.rows).text())
        chances = [row.chance for row in result.rows if row.chance is not None]
        chance = f"; chance is {sum(chances) / len(chances):.1%}" if chances else ""
        echo(f"{len(result.rows)} of {result.planned} {unit} in {result.folder}{chance}")
    if result.stopped is not None:
        print_status(f"Stopped: {result.stopped}", fg="red")
    if broken := result.counts["error"]:
        number = counted(broken, unit.removesuffix("s"))
        print_status(
            f"{number} broke (see {result.folder}/errors.log); re-run with:\n{command_line()}"
        )
        raise typer.Exit(1)


def merge_shards(runs: Sequence[Path], out: Path, *, as_json: bool) -> None:
    """Merge the shards of a run; see the command `merge`."""
    from .run.merge import merge_runs
    from .run.progress import rate_table

    merged = merge_runs(runs, out)
    lists = {name: getattr(merged, name) for name in _LISTS}
    if as_json:
        listed = {
            name: [{"episode": str(item.episode), "condition": item.condition} for item in items]
            for name, items in lists.items()
        }
        print_json({"planned": merged.planned, "rows": len(merged.rows), **listed})
        return
    echo(rate_table(merged.rows).text())
    for name, items in lists.items():
        if items:
            more = f" and {len(items) - 5:,} more" if len(items) > 5 else ""
            shown = ", ".join(map(str, items[:5]))
            print_status(f"{len(items):,} {_LISTS[name]}: {shown}{more}")
    echo(f"{len(merged.rows):,} of {counted(merged.planned, 'rollout')} in {out}")


_LISTS = {
    "missing": "missing",
    "broken": "broken, to run again",
    "duplicates": "in more than one run, the first one kept",
    "conflicts": "of these have different results",
}
