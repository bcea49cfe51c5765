"""What it costs to load a buffer from the Hub, to fetch a whole buffer set, and to publish one.

The Hub is a server on the loopback interface (tests/support/hub_server.py), every answer of which
takes longer by a latency; its client is the real one, in fresh processes, whose imports are left
out, with empty caches. A single buffer is loaded from real videos; the buffer set that is fetched
and published whole is made up, as the number of its files counts, not their size.
"""

import argparse
import re
from pathlib import Path
from statistics import median

from common import (
    add_buffer_set,
    demo_buffers,
    megabytes,
    positive,
    print_machine,
    print_table,
    run,
)
from files import span_bytes
from load import choose_buffer, spans_of
from loopback_hub import Hub, Run, running
from made_buffer_set import write_buffer_set

from robomme_interference_data import load_buffer, load_buffer_set
from robomme_interference_data.build_dataset.dataset.lerobot_writer import require_lerobot
from robomme_interference_data.cards.buffer_set_content import (
    BufferSetContent,
    plan_buffer_set,
    publish_buffer_set,
)
from robomme_interference_data.cards.publication import PublishConfig
from robomme_interference_data.data.fetch import fetch
from robomme_interference_data.data.fetch_plan import FetchConfig, plan_fetch

CONDITIONS = ("k0", "k1", "k3", "k7")
REAL, WHOLE, PLAIN = "someone/real", "someone/whole", "someone/plain"
VERSION = "data-1.0.0"
SPAN_FILES = re.compile(r"/(data|videos)/")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_buffer_set(parser)
    parser.add_argument("--queries", type=positive, default=450, help="of the made-up buffer set")
    parser.add_argument("--units", type=positive, default=450, help="of the made-up buffer set")
    parser.add_argument("--latency", type=positive, default=50, help="of every answer, ms")
    parser.add_argument("--rounds", type=positive, default=1, help="repetitions")
    options = parser.parse_args()
    require_lerobot()
    real = options.buffer_set or demo_buffers()
    with running(options.latency / 1000) as (hub, folder):
        print_machine("huggingface-hub")
        made = folder / "buffer_set"
        write_buffer_set(made, options.queries, options.units, CONDITIONS)
        time_publishing(hub, made, options)
        hub.run(publish, real, REAL)
        time_loading(hub, real, made, options)
        time_fetching(hub, options)


# --- one buffer ----------------------------------------------------------------------------------


def time_loading(hub: Hub, real: Path, made: Path, options: argparse.Namespace) -> None:
    """Load one buffer of each buffer set into an empty cache, and again; print the table."""
    rows = []
    for name, repo, root in (("real videos", REAL, real), ("made up", WHOLE, made)):
        buffer_set = load_buffer_set(root)
        buffer = choose_buffer(buffer_set)
        wanted = (repo, str(buffer.episode_id), buffer.condition)
        runs = []
        for _ in range(options.rounds):
            hub.fresh_cache()
            runs.append(hub.run(first_frame, *wanted))
            again = hub.run(first_frame, *wanted)
        last = runs[-1].asked
        files = [one for one in last if SPAN_FILES.search(one.path)]
        bytes_of_files = sum(one.sent for one in files)
        ratio = (
            f"{bytes_of_files / span_bytes(buffer, buffer_set, spans_of(buffer, buffer_set)):.2f}"
            if repo == REAL
            else ""
        )
        rows.append(
            [
                f"{name}, {len(buffer_set):,} buffers",
                f"{len(last) - len(files)}",
                f"{(runs[-1].received - bytes_of_files) / 1e3:,.0f}",
                f"{len(files)}",
                megabytes(bytes_of_files),
                ratio,
                f"{median(run.seconds for run in runs):.1f}",
                f"{len(again.asked)}",
                f"{again.seconds:.1f}",
            ]
        )
    title = (
        f"One buffer under {buffer.condition}, front camera, {len(buffer.sessions)} sessions: "
        "metadata (headers, manifests, episode tables; aim ≤ 300 kB), files of its sessions, how "
        "many times the bytes of its spans they are (aim ≤ 1.1), and seconds to the first frame, "
        f"into an empty cache and again; {_rounds(options)}."
    )
    columns = ("<split", ">requests for metadata", ">kB", ">requests for files", ">MB", ">× spans")
    columns += (">s", ">requests again", ">s again")
    print_table(title, columns, rows)


def first_frame(repo: str, episode: str, condition: str) -> None:
    """Load a buffer and decode its first frame."""
    buffer = load_buffer(episode, condition, buffer_set=repo, revision=VERSION, cameras=["front"])
    next(iter(buffer.stream(1, cameras=("front",))))


# --- a whole buffer set ---------------------------------------------------------------------


def time_fetching(hub: Hub, options: argparse.Namespace) -> None:
    """Fetch the made-up buffer set by both ways in turn; print the table."""
    ways = {"robomme-interference fetch": fetch_whole, "snapshot_download": snapshot}
    runs: dict[str, list[Run]] = {name: [] for name in ways}
    for number in range(options.rounds):
        for name in ways if number % 2 == 0 else reversed(ways):
            hub.fresh_cache()
            runs[name].append(hub.run(ways[name], WHOLE))
    ours, plain = runs.values()
    ratio = median(a.seconds / b.seconds for a, b in zip(ours, plain, strict=True))
    rows = [
        [
            name,
            f"{sum(bool(SPAN_FILES.search(one.path)) and one.sent > 0 for one in run[-1].asked):,}",
            f"{len(run[-1].asked):,}",
            megabytes(run[-1].received),
            f"{median(one.seconds for one in run):.1f}",
            f"{ratio:.2f}" if run is ours else "",
            "≤ 1.1" if run is ours else "",
        ]
        for name, run in runs.items()
    ]
    title = (
        f"The made-up buffer set of {options.queries:,} queries × {len(CONDITIONS)} conditions, "
        f"fetched whole into an empty cache; {_rounds(options)}."
    )
    columns = ("<way", ">files of episodes", ">requests", ">MB", ">s", ">ratio", ">aim")
    print_table(title, columns, rows)


def fetch_whole(repo: str) -> None:
    """Fetch a buffer set as the command does."""
    fetch(plan_fetch(load_buffer_set(repo, revision=VERSION), FetchConfig()))


def snapshot(repo: str) -> None:
    """Download the repositories of a buffer set with the Hub's client alone."""
    from huggingface_hub import snapshot_download

    for name in (f"{repo}-demonstrations", repo):
        snapshot_download(name, repo_type="dataset", revision=VERSION)


# --- publish -------------------------------------------------------------------------------------


def time_publishing(hub: Hub, made: Path, options: argparse.Namespace) -> None:
    """Publish the made-up buffer set twice, and upload its files plainly; print the table."""
    hub.fresh_cache()
    first, again = (hub.run(publish, made, WHOLE) for _ in range(2))
    plain = hub.run(upload_plainly, made, PLAIN)
    rows = [
        [
            name,
            f"{sum(one.method == 'PUT' for one in run.asked):,}",
            f"{sum('/commit/' in one.path for one in run.asked)}",
            f"{len(run.asked):,}",
            f"{run.sent:,}",
            f"{run.seconds:.1f}",
            "" if run is again else f"{run.seconds / plain.seconds:.2f}",
            aim,
        ]
        for name, run, aim in (
            ("publish", first, ""),
            ("publish again", again, "no bytes"),
            ("upload_folder", plain, ""),
        )
    ]
    files = 3 * (options.queries + options.units)
    title = (
        f"The made-up buffer set published, {files:,} files of episodes, without prior checks; "
        "each once."
    )
    columns = ("<way", ">large files", ">commits", ">requests", ">bytes sent", ">s", ">ratio")
    print_table(title, (*columns, ">aim"), rows)


def publish(root: Path, repo: str) -> None:
    """Publish a buffer set as the command does, without its checks."""
    config = PublishConfig(repo)
    content = BufferSetContent(load_buffer_set(root), config)
    publish_buffer_set(content, plan_buffer_set(content))


def upload_plainly(root: Path, repo: str) -> None:
    """Upload the datasets and manifests of a buffer set with the Hub's client alone."""
    from huggingface_hub import HfApi

    api, kind = HfApi(), {"repo_type": "dataset"}
    for name in (f"{repo}-demonstrations", repo):
        api.create_repo(name, **kind)
    for folder, name, inside in (
        ("demonstrations", f"{repo}-demonstrations", None),
        ("distractors", repo, None),
        ("manifests", repo, "manifests"),
    ):
        api.upload_folder(repo_id=name, folder_path=root / folder, path_in_repo=inside, **kind)


def _rounds(options: argparse.Namespace) -> str:
    return f"medians of {options.rounds} rounds; latency {options.latency} ms"


if __name__ == "__main__":
    run(main)
