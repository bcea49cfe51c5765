"""Train the small memory policy on a buffer set: `train.py BUFFER_SET --out RUN`.

    python examples/memory_policy/train.py my-buffers --out runs/k0 --conditions k0
    python examples/memory_policy/train.py my-buffers --out runs/acts --task act --steps 5000

The same command resumes an interrupted run. `RUN/log.csv` has the losses.
"""

import argparse
import csv
import json
import time
from collections.abc import Iterator
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from memory_model import Config, MemoryModel, save_checkpoint
from torch.nn import functional
from torch.utils.data import DataLoader, Subset

from robomme_interference_data.errors import InterferenceError
from robomme_interference_data.training import HistoryDataset


def positive(text: str) -> int:
    """Read a whole number from 1."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r}; expected a whole number from 1")
    return int(text)


def by_four(text: str) -> int:
    """Read a multiple of 4: patches have 4 pixels, and attention has 4 heads."""
    if positive(text) % 4:
        raise argparse.ArgumentTypeError(f"{text}; expected a multiple of 4")
    return int(text)


def weighted(text: str) -> tuple[str, float]:
    """Read `NAME` or `NAME=WEIGHT`."""
    name, _, weight = text.partition("=")
    try:
        return name, float(weight or 1)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}; expected NAME or NAME=WEIGHT") from None


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("buffer_set", help="folder, or namespace/name on the Hub, with train episodes")
    add("--out", type=Path, required=True, help="folder of the run")
    add("--task", choices=("answer", "act"), default="answer", help="answer questions, or act")
    every = [(name, 1.0) for name in ("k0", "k1", "k3", "k7")]
    add("--conditions", nargs="+", type=weighted, default=every, help="NAME or NAME=WEIGHT")
    add("--memory", default="framesamp:32", help="framesamp:N, window:N or full")
    add("--retrieval", help="encoder of a retrieval step before the memory, such as thumbnail")
    add("--cameras", nargs="+", default=["front"])
    add("--image-size", type=by_four, default=64, help="side of the images in pixels")
    add("--families", nargs="+", default=[], help="default: all")
    add("--episodes", help="indices of the train episodes to use, such as 0-79; default: all")
    add("--redraw", action="store_true", help="draw the sessions anew in every epoch")
    add("--unit-episodes", help="with --redraw, train episodes whose units may be drawn")
    add("--trunk", choices=("transformer", "gru"), default="transformer")
    add("--no-pictures", action="store_true", help="the control: positions and lengths only")
    add("--width", type=by_four, default=96, help="values of a token")
    add("--layers", type=positive, default=2)
    add("--chunk", type=positive, default=16, help="actions per chunk (--task act)")
    add("--noise", type=float, default=0.02, help="std on current joints in rad (--task act)")
    add("--steps", type=positive, default=1000)
    add("--batch", type=positive, default=32)
    add("--save-every", type=positive, default=100, help="steps between checkpoints")
    add("--learning-rate", type=float, default=1e-3)
    add("--workers", type=int, default=0, help="processes that load items")
    add("--seed", type=int, default=0)
    add("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    return parser.parse_args()


def main() -> None:
    """Train, from the beginning or from the last checkpoint."""
    args = arguments()
    if args.device.startswith("cuda") and not torch.cuda.is_available():
        raise SystemExit("error: no GPU is available here; leave --device out, or use cpu")
    data = HistoryDataset(
        args.buffer_set,
        dict(args.conditions),
        memory=args.memory,
        cameras=args.cameras,
        image_size=args.image_size,
        chunk=args.chunk if args.task == "act" else 0,
        families=args.families,
        episodes=args.episodes,
        retrieval=args.retrieval,
        questions=args.task == "answer",
        redraw=args.redraw,
        unit_episodes=args.unit_episodes,
        seed=args.seed,
    )
    print(data)
    if other := [str(one) for one in data.episode_ids if one.split != "train"]:
        print(f"warning: {other[0]} and others are not train episodes: do not test on them")
    settings = {
        k: v for k, v in vars(args).items() if k not in ("out", "device", "workers", "save_every")
    }
    settings |= {"data": data.buffer_set.revision}
    args.out.mkdir(parents=True, exist_ok=True)
    state = resume(args.out, settings)
    torch.manual_seed(args.seed)
    item = data[0]
    config = Config(
        task=args.task,
        data=data.buffer_set.revision,
        memory=args.memory,
        cameras=tuple(args.cameras),
        image_size=args.image_size,
        points=item["question.points"].shape[1] if args.task == "answer" else 1,
        state=len(item["observation.state"]),
        action=item["action"].shape[1] if args.task == "act" else 8,
        chunk=args.chunk,
        width=args.width,
        layers=args.layers,
        trunk=args.trunk,
        pictures=not args.no_pictures,
    )
    model = MemoryModel(config)
    if args.task == "act":
        sample = range(0, len(data), max(1, len(data) // 256))
        model.fit_scales(next(iter(DataLoader(Subset(data, sample), len(sample)))))
    model.to(args.device)
    optimizer = torch.optim.AdamW(model.parameters(), args.learning_rate, weight_decay=0.05)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, args.learning_rate, args.steps)
    parts = {"model": model, "optimizer": optimizer, "schedule": schedule}
    for name, part in parts.items() if state else ():
        part.load_state_dict(state[name])
    step, log = (state["step"], state["log"]) if state else (0, [])
    if state:
        torch.set_rng_state(state["random"])
    print(f"{sum(p.numel() for p in model.parameters()):,} parameters; step {step} of {args.steps}")
    began = time.perf_counter()
    model.train()
    for batch in batches(data, args, step):
        if args.task == "act":  # it learns to come back from where it did not mean to go
            joints = batch["observation.state"][:, :-1]
            joints += args.noise * torch.randn_like(joints)
        loss, accuracy = train_step(model, batch, optimizer)
        schedule.step()
        step += 1
        if step % 20 == 0 or step == args.steps:
            seconds = time.perf_counter() - began
            log.append([step, round(loss, 5), round(accuracy, 4), round(seconds, 2)])
            print(f"step {step}: loss {loss:.4f}, accuracy {accuracy:.2f}, {seconds:.0f} s")
        if step % args.save_every == 0 or step == args.steps:
            kept = {name: part.state_dict() for name, part in parts.items()}
            kept |= {"step": step, "log": log, "random": torch.get_rng_state()}
            save_checkpoint(model, args.out)  # first: a finished state means a finished model
            save_state(args.out, kept | {"settings": settings})


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
            Subset(data, rest), args.batch, num_workers=args.workers, generator=generator
        )
        for batch in loader:
            if step == args.steps:
                return
            step += 1
            yield {
                name: value.to(args.device) if isinstance(value, torch.Tensor) else value
                for name, value in batch.items()
            }


def train_step(
    model: MemoryModel, batch: dict[str, Any], optimizer: torch.optim.Optimizer
) -> tuple[float, float]:
    """Take one step; return the loss, and the share of right answers or exact gripper commands."""
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
        return None
    try:
        state: dict[str, Any] = torch.load(path, weights_only=True, map_location="cpu")
    except (RuntimeError, EOFError, UnpicklingError) as error:
        raise SystemExit(f"error: {path} is damaged ({error}): delete it to begin again") from None
    different = [name for name, value in settings.items() if state["settings"].get(name) != value]
    if different:
        raise SystemExit(
            f"{out} holds a run with another {', '.join(different)}: "
            f"{json.dumps(state['settings'])}. Use the same settings, or another --out."
        )
    return state


def save_state(out: Path, state: dict[str, Any]) -> None:
    """Write what `resume` reads, whole or not at all, and the log."""
    torch.save(state, out / "state.partial")
    (out / "state.partial").replace(out / "state.pt")
    with (out / "log.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["step", "loss", "accuracy", "seconds"], *state["log"]])


if __name__ == "__main__":
    try:
        main()
    except (InterferenceError, OSError) as error:
        raise SystemExit(f"error: {error}") from None
