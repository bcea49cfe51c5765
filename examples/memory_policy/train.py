"""Train the small memory policy on a buffer set: `train.py BUFFER_SET --out RUN`.

    python examples/memory_policy/train.py my-training --out runs/k0 --conditions k0
    python examples/memory_policy/train.py my-training --out runs/acts --task act --steps 6000

The same command resumes an interrupted run from its last checkpoint. `RUN/log.csv` has the losses.
"""

import argparse
import csv
import math
from collections.abc import Iterator
from pathlib import Path
from pickle import UnpicklingError
from time import perf_counter
from typing import Any

import torch
from command_line import default_device, device, names, number, run, weights, whole
from memory_model import POSITIONS, Config, MemoryModel, on_device, save_checkpoint
from torch.nn import functional
from torch.utils.data import DataLoader

from robomme_interference_data import BufferSet, load_buffer_set
from robomme_interference_data.constants import CAMERA_PREFIX
from robomme_interference_data.errors import FormatError, InvalidOptionError
from robomme_interference_data.storage.files import atomic_path
from robomme_interference_data.training import HistoryDataset


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )

    def add(name: str, text: str, **how: Any) -> None:
        shown = name[0] != "-" or how.get("default") in (None, ())
        parser.add_argument(name, help=text if shown else f"{text} (%(default)s)", **how)

    add("buffer_set", "folder, or namespace/name on the Hub, of a buffer set of train episodes")
    add("--out", "folder of the run", type=Path, required=True)
    add("--task", "answer questions, or act", choices=("answer", "act"), default="answer")
    conditions = "NAME,… or NAME=WEIGHT,…"
    add("--conditions", conditions, type=weights, default="k0,k1,k3,k7", metavar="NAMES")
    add("--memory", "framesamp:N, window:N, window:SECONDS@FPS or full", default="framesamp:32")
    add("--retrieval", "encoder of a retrieval step before the memory, such as thumbnail")
    add("--cameras", "NAME,…; the first if left out", type=names, metavar="NAMES")
    add("--image-size", "side of the images in pixels", type=whole(4, 4), default=64)
    add("--split", "split of the episodes; test on no episodes of it", default="train")
    add("--families", "NAME,…; all if left out", type=names, default=(), metavar="NAMES")
    add("--episodes", "indices of the episodes to use, such as 0-79; all if left out")
    add("--redraw", "draw the sessions anew in every epoch", action="store_true")
    add("--unit-episodes", "with --redraw, indices of episodes whose units may be drawn")
    add("--trunk", "reader of the memory", choices=("transformer", "gru"), default="transformer")
    add("--no-pictures", "the control: memory without pictures and states", action="store_true")
    where = "; ".join(f"{name}: {text}" for name, text in POSITIONS.items())
    add("--positions", f"frames to a frame in memory, {where}", choices=POSITIONS, default="both")
    add("--width", "values of a token", type=whole(4, 4), default=96)
    add("--layers", "layers of the trunk", type=whole(1), default=2)
    add("--no-attention-dropout", "faster with --memory full", action="store_true")
    add("--chunk", "with --task act, actions per chunk", type=whole(1), default=16)
    add("--noise", "with --task act, noise on the current joints in rad", type=number, default=0.02)
    add("--steps", "batches to train on, a setting of the run", type=whole(1), default=1000)
    add("--batch", "items per batch", type=whole(1), default=32)
    add("--save-every", "steps between checkpoints", type=whole(1), default=100)
    add("--learning-rate", "highest learning rate", type=number, default=1e-3)
    add("--workers", "processes that load items", type=whole(0), default=0)
    add("--seed", "seed of weights, noise and draws", type=whole(0), default=0)
    add("--device", "cpu, or cuda for a GPU", type=device, default=default_device())
    return parser.parse_args()


def main(args: argparse.Namespace) -> None:
    """Train, from the beginning or from the last checkpoint."""
    buffer_set = load_buffer_set(args.buffer_set)
    other = ("out", "device", "workers", "save_every")
    settings = {name: value for name, value in vars(args).items() if name not in other}
    settings |= {"data": buffer_set.revision}
    state = resume(args.out, settings)
    data = make_data(buffer_set, args)
    print(data)
    args.out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(args.seed)
    model = MemoryModel(make_config(data, args))
    if args.task == "act":
        model.fit_scales(data[[*range(0, len(data), max(1, len(data) // 256))]])
    model.to(args.device)
    optimizer = torch.optim.AdamW(model.parameters(), args.learning_rate, weight_decay=0.05)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, args.learning_rate, args.steps)
    parts = {"model": model, "optimizer": optimizer, "schedule": schedule}
    for name, part in parts.items() if state else ():
        part.load_state_dict(state[name])
    step, log = (state["step"], state["log"]) if state else (0, [])
    if state:
        torch.set_rng_state(state["random"])
        torch.cuda.set_rng_state_all(state["random_on_gpus"])
        save(args.out, model, state)  # in case that files other than the state are lost
    print(f"{sum(p.numel() for p in model.parameters()):,} parameters; step {step} of {args.steps}")
    began = perf_counter()
    model.train()
    for batch in batches(data, args, step):
        if args.task == "act":  # it learns to come back from where it did not mean to go
            joints = batch["observation.state"][:, :-1]
            joints += args.noise * torch.randn_like(joints)
        loss, accuracy = train_step(model, batch, optimizer)
        if not math.isfinite(loss):
            raise InvalidOptionError(
                f"The loss is {loss} at step {step + 1} with --learning-rate {args.learning_rate} "
                f"and --noise {args.noise}; expected a finite one.",
                "Use lower ones, and another --out.",
            )
        schedule.step()
        step += 1
        if step % 20 == 0 or step == args.steps:
            seconds = perf_counter() - began
            log.append([step, round(loss, 5), round(accuracy, 4), round(seconds, 2)])
            print(f"step {step}: loss {loss:.4f}, accuracy {accuracy:.2f}, {seconds:.0f} s")
        if step % args.save_every == 0 or step == args.steps:
            kept = {name: part.state_dict() for name, part in parts.items()}
            kept |= {"step": step, "log": log, "random": torch.get_rng_state()}
            kept |= {"random_on_gpus": torch.cuda.get_rng_state_all()}
            save(args.out, model, kept | {"settings": settings})


def make_data(buffer_set: BufferSet, args: argparse.Namespace) -> HistoryDataset:
    """Return the items to train on."""
    return HistoryDataset(
        buffer_set,
        args.conditions,
        memory=args.memory,
        cameras=args.cameras,
        image_size=args.image_size,
        chunk=args.chunk if args.task == "act" else 0,
        split=args.split,
        families=args.families,
        episodes=args.episodes,
        retrieval=args.retrieval,
        questions=args.task == "answer",
        redraw=args.redraw,
        unit_episodes=args.unit_episodes,
        seed=args.seed,
    )


def make_config(data: HistoryDataset, args: argparse.Namespace) -> Config:
    """Return the configuration of a model for the items."""
    item = data[0]
    return Config(
        task=args.task,
        data=data.buffer_set.revision,
        memory=args.memory,
        cameras=tuple(name.removeprefix(CAMERA_PREFIX) for name in data.cameras),
        image_size=args.image_size,
        points=item["question.points"].shape[1] if args.task == "answer" else 1,
        state=len(item["observation.state"]),
        action=item["action"].shape[1] if args.task == "act" else 8,
        chunk=args.chunk,
        width=args.width,
        layers=args.layers,
        attention_dropout=not args.no_attention_dropout,
        trunk=args.trunk,
        pictures=not args.no_pictures,
        positions=args.positions,
        seed=args.seed,
        training_steps=args.steps,
    )


def batches(data: HistoryDataset, args: argparse.Namespace, step: int) -> Iterator[dict[str, Any]]:
    """Yield the batches from a step on; which they are depends on the seed and the step only."""
    per_epoch = max(1, len(data) // args.batch)
    while step < args.steps:
        epoch, done = divmod(step, per_epoch)
        data.set_epoch(epoch)
        generator = torch.Generator().manual_seed(args.seed * 1_000_003 + epoch)
        order = torch.randperm(len(data), generator=generator)
        rest = order[done * args.batch : per_epoch * args.batch].tolist()
        # With its own generator, the loader does not change what dropout draws.
        loader = DataLoader(
            data, args.batch, sampler=rest, num_workers=args.workers, generator=generator
        )
        for batch in loader:
            if step == args.steps:
                return
            step += 1
            yield on_device(batch, args.device)


def train_step(
    model: MemoryModel, batch: dict[str, Any], optimizer: torch.optim.Optimizer
) -> tuple[float, float]:
    """Take one step; return the loss, and the share of right answers or signs of the gripper."""
    predicted = model(batch)
    if model.config.task == "answer":
        loss = functional.cross_entropy(predicted, batch["question.answer"])
        right = (predicted.argmax(1) == batch["question.answer"]).float().mean()
    else:
        valid = ~batch["action_is_pad"]
        loss = ((predicted - batch["action"]) / model.action_std).abs()[valid].mean()
        same = predicted[..., -1].sign() == batch["action"][..., -1].sign()
        right = same[valid].float().mean()
    optimizer.zero_grad()
    loss.backward()
    torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
    optimizer.step()
    return loss.item(), right.item()


def resume(out: Path, settings: dict[str, Any]) -> dict[str, Any] | None:
    """Return the state of an interrupted run with the same settings; None without one."""
    path = out / "state.pt"
    if not path.is_file():
        found = out.iterdir() if out.exists() else ()
        written = [one.name for one in found if one.suffix != ".partial"]
        if others := {*written} - {"config.json", "model.safetensors"}:
            raise InvalidOptionError(
                f"{out} holds other files, such as {min(others)}; expected a folder of a run.",
                "Use another `out`.",
            )
        return None
    try:
        state: dict[str, Any] = torch.load(path, weights_only=True, map_location="cpu")
    except (RuntimeError, EOFError, UnpicklingError):
        raise FormatError(f"{path} is damaged.", "Delete it to begin again.") from None
    before = state["settings"]
    if changed := [name for name in settings if before.get(name) != settings[name]]:
        what = "; ".join(f"{name}: {before.get(name)}, now {settings[name]}" for name in changed)
        raise InvalidOptionError(
            f"{out} holds a run with other settings ({what}).",
            "Use the same settings to resume it, or another `out`.",
        )
    return state


def save(out: Path, model: MemoryModel, state: dict[str, Any]) -> None:
    """Write the weights, then what `resume` reads, each whole or not at all, and the log."""
    save_checkpoint(model, out, state["step"])
    with atomic_path(out / "state.pt") as partial:
        torch.save(state, partial)
    with (out / "log.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["step", "loss", "accuracy", "seconds"], *state["log"]])


if __name__ == "__main__":
    run(main, arguments())
