"""Let a trained model answer the questions of a buffer set: rows that `score` and `compare` read.

    python examples/memory_policy/answer.py runs/k0 my-buffers --system learned-k0 --out k0.csv

Memory, cameras and image size are those of the training; conditions and retrieval may differ.
"""

import argparse
import csv
import sys
from collections.abc import Iterator
from pathlib import Path

import torch
from command_line import default_device, device, names, run
from memory_model import MemoryModel, load_checkpoint, on_device
from torch.utils.data import DataLoader

from robomme_interference_data import EpisodeId, Rollout, load_buffer_set
from robomme_interference_data.constants import DEMONSTRATIONS, PROTOCOL_VERSION
from robomme_interference_data.data.questions import LETTERS
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.evaluate.run.history import history_columns
from robomme_interference_data.retrieval.stored_selector import StoredSelector
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.conditions import NO_HISTORY
from robomme_interference_data.storage.files import atomic_path, sha256_file
from robomme_interference_data.training import HistoryDataset, Memory


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("checkpoint", type=Path, help="folder of a run of train.py --task answer")
    add("buffer_set", help="folder, or namespace/name on the Hub, with questions")
    add("--out", type=Path, required=True, help="CSV file to write")
    add("--system", required=True, help="label of the rows, such as learned-k0")
    add("--conditions", type=names, metavar="NAMES", help="NAME,…; all that apply if left out")
    add("--split", default="test", help="split of the episodes (%(default)s)")
    add("--retrieval", help="encoder of a retrieval step before the memory, such as thumbnail")
    add("--retrieval-rule", default="max", help="what is kept then, as for evaluate (%(default)s)")
    add("--device", type=device, default=default_device(), help="cpu or cuda (%(default)s)")
    return parser.parse_args()


def main(args: argparse.Namespace) -> None:
    """Answer, and write the rows."""
    if args.out.exists():
        raise InvalidOptionError(f"{args.out} exists.", "Use another `out`, or delete it.")
    model = load_checkpoint(args.checkpoint, args.device)
    if model.config.task != "answer":
        raise InvalidOptionError(f"{args.checkpoint} was trained to act; expected --task answer.")
    if model.config.training_step < model.config.training_steps:
        print(
            f"warning: {args.checkpoint} is of a training run that is not finished, step "
            f"{model.config.training_step:,} of {model.config.training_steps:,}",
            file=sys.stderr,
        )
    answered = [to_dict(row) for row in rows(model, args)]
    with atomic_path(args.out) as partial, partial.open("w", newline="") as file:
        writer = csv.DictWriter(file, answered[0])
        writer.writeheader()
        writer.writerows(answered)


def rows(model: MemoryModel, args: argparse.Namespace) -> Iterator[Rollout]:
    """Yield a row for each query episode under each condition."""
    config, buffer_set = model.config, load_buffer_set(args.buffer_set)
    memory = Memory.parse(config.memory)
    rule = args.retrieval_rule
    step = StoredSelector(args.retrieval, rule=rule) if args.retrieval else None
    label = None if step is None else step.label(buffer_set.datasets[DEMONSTRATIONS])
    weights = sha256_file(args.checkpoint / "model.safetensors")[:16]
    applying = [one for one in buffer_set.conditions if step is None or one != NO_HISTORY]
    for condition in args.conditions or applying:
        data = HistoryDataset(
            buffer_set,
            [condition],
            memory=config.memory,
            cameras=config.cameras,
            image_size=config.image_size,
            chunk=0,
            split=args.split,
            questions=True,
            retrieval=args.retrieval,
            retrieval_rule=rule,
            quiet=True,
        )
        right = 0
        for batch in DataLoader(data, batch_size=16):
            with torch.inference_mode():
                chosen = model(on_device(batch, args.device)).argmax(1).tolist()
            for number, option in enumerate(chosen):
                episode = EpisodeId.parse(batch["episode_id"][number])
                buffer = buffer_set.load(episode, condition)
                record, given = buffer.query.record, [*range(len(buffer))]
                if step is not None:
                    given = step.select(buffer_set, buffer).tolist()
                success = option == int(batch["question.answer"][number])
                right += success
                yield Rollout(
                    system=args.system,
                    policy="python",
                    policy_id=weights,
                    training_step=config.training_step,
                    memory=str(memory),
                    retrieval=label,
                    simulator="questions",
                    buffer_set=buffer_set.name,
                    revision=buffer_set.revision,
                    family=episode.family,
                    condition=condition,
                    split=episode.split,
                    episode=episode.index,
                    shift="none",
                    training_seed=config.seed,
                    model_seed=config.seed,
                    protocol_version=PROTOCOL_VERSION,
                    seed=record.seed,
                    difficulty=record.difficulty,
                    ability=record.ability,
                    goal=record.goal,
                    status="success" if success else "fail",
                    success=success,
                    steps=0,
                    **history_columns(buffer, given, memory, retrieved=step is not None),
                    answer=LETTERS[option],
                    chance=1 / int((~batch["question.option_is_pad"][number]).sum()),
                )
        print(f"{args.system}, {condition}: {right} of {len(data)} right")


if __name__ == "__main__":
    run(main, arguments())
