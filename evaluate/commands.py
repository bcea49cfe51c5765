"""The commands of rollouts and questions: `ceiling`, `evaluate`, `ask` and `merge`."""

from pathlib import Path
from typing import Annotated

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
from robomme_interference_data.schema.shifts import NO_SHIFT

from .run.config import AskConfig, CeilingConfig, RunConfig


@with_settings
def ceiling(buffer_set: BufferSetFolder, config: CeilingConfig, as_json: AsJson = False) -> None:
    """Tell what a memory keeps of the answers, before anybody has rolled out anything.

    The share of the evidence that is kept, and, on tabletop, how often the ideal observer
    succeeds: no policy with that memory can do better.

    Examples:
    ```
    robomme-interference ceiling my-buffers --memory window
    robomme-interference ceiling my-buffers --retrieval thumbnail --conditions k0,k7
    robomme-interference ceiling my-buffers --retrieval thumbnail --shift light:2
    ```
    """
    from robomme_interference_data.data.loading import load_buffer_set
    from robomme_interference_data.schema.codec import to_dict

    from . import ceiling as module

    opened = load_buffer_set(buffer_set)
    cells = module.ceiling(opened, config)
    if as_json:
        print_json([to_dict(cell) for cell in cells])
        return
    title = f"Ceiling on {opened.name}, memory {config.memory}"
    if config.retrieval is not None:
        title += f", behind retrieval {config.retrieval}, rule {config.retrieval_rule}"
        title += "" if config.shift == NO_SHIFT else f", shift {config.shift}"
    echo(module.ceiling_table(cells, title).text())


@with_settings
def evaluate(config: RunConfig, as_json: AsJson = False) -> None:
    r"""Roll out a policy under the benchmark's conditions, one row per rollout.

    Before each episode the policy gets the history that the condition prescribes: nothing
    (no-history), the lesson (k0), or the lesson and k sessions of other tasks. RUN/rollouts.jsonl
    holds what came out, RUN/run.json what ran; tables are exported when the run ends. Stop it at
    any time: the same command goes on, skips what is finished and repeats what broke.

    Examples:
    ```
    robomme-interference evaluate S --policy replay:window \
      --out runs/window

    robomme-interference evaluate S --policy websocket://localhost:8000 \
      --system perceptual-framesamp-modul --out runs/mine \
      --policy-option checkpoint=mme_vla_suite/perceptual-framesamp-modul/79999 \
      --conditions k0,k7 --families MoveCube,RouteStick

    robomme-interference evaluate S --policy websocket --workers 2 \
      --serve 'python serve.py --port {port}' --system mine --out runs/served

    robomme-interference evaluate S --policy lerobot:me/act@v1 \
      --system act-v1 --policy-option device=cpu --out runs/act

    robomme-interference evaluate S --policy guess --conditions no-history \
      --workers 2 --out runs/guess

    robomme-interference evaluate S --policy replay --shift light:2 --out runs/light

    robomme-interference evaluate S --policy oracle --episodes 0-4 --videos \
      --out runs/oracle

    robomme-interference evaluate S --policy replay --shard 2/8 \
      --out runs/shard-2
    ```
    """
    _run(config, "Finished rollouts", "rollouts", as_json=as_json)


@with_settings
def ask(config: AskConfig, as_json: AsJson = False) -> None:
    r"""Ask multiple-choice questions about what history buffers show, without a simulator.

    Of each query episode: the goal, the first live view with the possible answers marked, and the
    frames of the buffer that are kept. Right or wrong measures whether the past can be read out of
    memory. Rows are those of rollouts, and are scored alike; what was asked and answered is in
    RUN/answers. Make the questions first: robomme-interference build questions BUFFER_SET.

    Examples:
    ```
    robomme-interference ask S --model recall --out runs/recall --conditions k0,k7

    robomme-interference ask S --model openai:http://localhost:8000/v1#Qwen/Qwen3-VL-4B-Instruct \
      --system qwen3-vl-4b --out runs/qwen --frames 32 --sampling framesamp

    robomme-interference ask S --model transformers:my/model --control blank \
      --system mine-blank --out runs/blank
    ```
    """
    _run(config, "Answers", "questions", as_json=as_json)


def _run(config: RunConfig | AskConfig, kept: str, unit: str, *, as_json: bool) -> None:
    """Run, and print the results; fails if something broke."""
    from robomme_interference_data.schema.codec import to_dict

    from .run.evaluation import run_evaluation
    from .run.progress import RunProgress, rate_table

    check_output(config.out)
    with (
        graceful_interrupt(f"{kept} are in {config.out}", config.out),
        RunProgress(quiet=as_json, unit=unit) as shown,
    ):
        result = run_evaluation(config, progress=shown, command=[command_line()])
    if as_json:
        print_json([to_dict(row) for row in result.rows])
    else:
        echo(rate_table(result.rows).text())
        chances = [row.chance for row in result.rows if row.chance is not None]
        chance = f"; chance is {sum(chances) / len(chances):.1%}" if chances else ""
        echo(f"{len(result.rows)} of {result.planned} {unit} in {result.folder}{chance}")
    if result.stopped is not None:
        print_status(f"Stopped: {result.stopped}", fg="red")
    if broken := result.counts["error"]:
        print_status(
            f"{broken} {unit} broke (see {result.folder}/errors.log); the same command runs them "
            f"again:\n{command_line()}"
        )
        raise typer.Exit(1)


def merge(
    runs: Annotated[list[Path], typer.Argument(help="Folders of the shards of a run.")],
    out: Annotated[Path, typer.Option(help="Folder of the joined run, new.")],
    as_json: AsJson = False,
) -> None:
    """Join shards of a run into one, and tell which rollouts are missing or double.

    The shards must agree in all settings that can change a result. The joined run scores like
    any other, and evaluate with its folder as --out runs what is missing.

    Example:
    ```
    robomme-interference merge runs/shard-1 runs/shard-2 --out runs/whole
    ```
    """
    from .run.merge import merge_runs
    from .run.progress import rate_table

    check_output(out)
    merged = merge_runs(runs, out)
    lists = {name: getattr(merged, name) for name in _LISTS}
    if as_json:
        told = {
            name: [{"episode": str(one.episode), "condition": one.condition} for one in items]
            for name, items in lists.items()
        }
        print_json({"planned": merged.planned, "rows": len(merged.rows), **told})
        return
    echo(rate_table(merged.rows).text())
    for name, items in lists.items():
        if items:
            more = f" and {len(items) - 5:,} more" if len(items) > 5 else ""
            shown = ", ".join(map(str, items[:5]))
            print_status(f"{len(items):,} {_LISTS[name]}: {shown}{more}")
    echo(f"{len(merged.rows):,} of {merged.planned:,} rollouts in {out}")


_LISTS = {
    "missing": "missing",
    "broken": "broken, to be run again",
    "duplicates": "in more than one run, the first one kept",
    "conflicts": "of those did not end alike",
}
