"""How fast a policy server is fed a history buffer, against a bare send of the same bytes.

Server and client are two processes on the loopback interface. The adapter is given the frames of
a k7 buffer, cuts them into messages of 16 and packs them; the bare client sends the same messages,
packed beforehand, over the same kind of connection. Every message is answered before the next.
The second part also decodes the buffer, which evaluate does while the server works.
"""

import argparse
import asyncio
import multiprocessing
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from common import (
    Times,
    add_buffer_set,
    demo_buffers,
    interleave,
    megabytes,
    positive,
    print_machine,
    print_table,
)
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from robomme_interference_data import load_buffer_set
from robomme_interference_data.constants import UNIT_FRAMES
from robomme_interference_data.data.buffer import Buffer, Chunk
from robomme_interference_data.evaluate.policies.policy import RolloutInfo
from robomme_interference_data.evaluate.policies.websocket import WebsocketPolicy
from robomme_interference_data.evaluate.policies.wire import pack, unpack
from robomme_interference_data.evaluate.rollout.rollout import read_ahead

CHUNK = 16
ANSWER = pack({"reset_finished": True, "add_buffer_finished": True})
BARE = "bare send of the same bytes"
FED = "WebsocketPolicy"
READ = "WebsocketPolicy, server unpacks"
IN_TURN, AHEAD = "decode a chunk, send it", "decode ahead, as evaluate does"
OPTIONS: dict[str, Any] = {"compression": None, "max_size": None}


def main() -> None:
    """Measure and print."""
    options = parse_options()
    frames = options.lesson + 7 * UNIT_FRAMES
    draw = np.random.default_rng(0)
    # One frame more: the first live observation.
    images = draw.integers(0, 256, (frames + 1, 256, 256, 3), dtype=np.uint8)
    states = draw.normal(size=(frames + 1, 8)).astype(np.float32)
    buffer_set = load_buffer_set(options.buffer_set or demo_buffers(), threads=1)
    buffer = buffer_set.load(options.episode, buffer_set.conditions[-1])
    with servers() as ports:
        times, size = measure(ports, images, states, options.rounds)
        decoding = measure_decoding(ports[1], buffer, options.rounds)
    print_machine("websockets", "msgpack")
    messages = -(-len(images) // CHUNK)
    print_table(
        f"A k7 buffer of {frames:,} frames and the first live observation, front camera, "
        f"{megabytes(size)} MB in {messages} messages; medians of {options.rounds} rounds.",
        ("<feeding", ">ms", ">MB/s", ">ratio"),
        [
            [
                way,
                f"{times.median(way) * 1e3:.0f}",
                f"{size / 1e6 / times.median(way):,.0f}",
                f"{times.ratio(way, BARE):.2f}",
            ]
            for way in (BARE, FED, READ)
        ],
    )
    print_table(
        f"The {buffer.condition} buffer of {options.episode}, {len(buffer):,} frames, decoded "
        f"and fed to the server that unpacks; medians of {options.rounds} rounds.",
        ("<decoding and feeding", ">ms", ">ratio"),
        [
            [way, f"{decoding.median(way) * 1e3:.0f}", f"{decoding.ratio(way, IN_TURN):.2f}"]
            for way in (IN_TURN, AHEAD)
        ],
    )


def parse_options() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lesson", type=positive, default=246, help="frames of the lesson")
    parser.add_argument("--rounds", type=positive, default=7)
    add_buffer_set(parser)
    parser.add_argument("--episode", default="MoveCube/test/0", metavar="ID")
    return parser.parse_args()


def measure(
    ports: tuple[int, int], images: np.ndarray, states: np.ndarray, rounds: int
) -> tuple[Times, int]:
    """Time the three ways in turns; return their times and the bytes that each sends."""
    plain, _ = ports
    frames = len(images) - 1
    messages = [
        pack(
            {
                "add_buffer": True,
                "images": images[start : start + CHUNK, None],
                "state": states[start : start + CHUNK],
                "exec_start_idx": frames,
            }
        )
        for start in range(0, len(images), CHUNK)
    ]
    with ExitStack() as stack:
        bare = stack.enter_context(
            connect(f"ws://127.0.0.1:{plain}", ping_interval=None, proxy=None, **OPTIONS)
        )
        bare.recv()
        policies = [WebsocketPolicy("127.0.0.1", port) for port in ports]
        for policy in policies:
            stack.callback(policy.close)

        def send() -> None:
            for message in messages:
                bare.send(message)
                bare.recv()

        def feed(policy: WebsocketPolicy) -> None:
            policy.reset(RolloutInfo("pick", frames, 0))
            policy.add_history({"front": images[:-1]}, states[:-1], frames)
            policy.observe({"front": images[-1:]}, states[-1:])

        ways = {BARE: send, FED: lambda: feed(policies[0]), READ: lambda: feed(policies[1])}
        return interleave(ways, rounds), sum(map(len, messages))


def measure_decoding(port: int, buffer: Buffer, rounds: int) -> Times:
    """Time decoding and feeding a buffer, a chunk after the other and ahead."""
    policy = WebsocketPolicy("127.0.0.1", port)

    def feed(chunks: Iterator[Chunk]) -> None:
        policy.reset(RolloutInfo(buffer.goal, len(buffer), 0))
        for chunk in chunks:
            policy.add_history(chunk.frames, chunk.states, len(buffer))
        policy.observe({"front": buffer.query.frame()[None]}, buffer.query.state()[None])

    def ahead() -> None:
        with read_ahead(buffer.stream(64, ("front",)), 4) as chunks:
            feed(chunks)

    try:
        ways = {IN_TURN: lambda: feed(buffer.stream(64, ("front",))), AHEAD: ahead}
        return interleave(ways, rounds)
    finally:
        policy.close()


@contextmanager
def servers() -> Iterator[tuple[int, int]]:
    """Run a process with two servers, one of which unpacks what it gets; yield their ports."""
    context = multiprocessing.get_context("spawn")
    mine, theirs = context.Pipe()
    process = context.Process(target=run_servers, args=(theirs,), daemon=True)
    process.start()
    try:
        yield mine.recv()
    finally:
        process.terminate()
        process.join()


def run_servers(pipe: Connection) -> None:
    """Serve until the process is ended; tell the ports first."""

    async def answer(connection: ServerConnection, reads: bool) -> None:
        await connection.send(pack({}))
        try:
            while True:
                data = await connection.recv()
                if reads and isinstance(data, bytes):
                    unpack(data)
                await connection.send(ANSWER)
        except ConnectionClosed:
            return

    async def serve_both() -> None:
        started = [
            await serve(
                lambda connection, reads=reads: answer(connection, reads), "127.0.0.1", 0, **OPTIONS
            )
            for reads in (False, True)
        ]
        pipe.send(tuple(server.sockets[0].getsockname()[1] for server in started))
        await asyncio.gather(*(server.serve_forever() for server in started))

    asyncio.run(serve_both())


if __name__ == "__main__":
    main()
