"""Many episodes over several worker processes, in order, with bad workers replaced."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from queue import SimpleQueue
from typing import Any

from robomme_interference_data.errors import SimulatorCrashError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.simulators.worker import RemoteSimulator

__all__ = ["map_episodes"]


def map_episodes[Result](
    play: Callable[[RemoteSimulator, EpisodeId], Result],
    episodes: Sequence[EpisodeId],
    simulator: str = "tabletop",
    workers: int = 1,
    tries: int = 2,
    episode_s: float = 600.0,
    **options: Any,
) -> Iterator[tuple[EpisodeId, Result | SimulatorCrashError]]:
    """Play episodes and yield what came of each, in the order given.

    A worker that dies or exceeds its time is replaced and its episode tried again; if that fails
    too, its error is yielded in place of a result. Any other error of `play` is raised.

    Args:
        play: Called in a thread with a simulator and an episode; resets it itself.
        episodes: Which episodes.
        simulator: Name of the simulator.
        workers: Worker processes, at least 1.
        tries: How often an episode is tried.
        episode_s: Seconds that the simulator may take over one episode.
        **options: For the simulator.
    """
    free: SimpleQueue[RemoteSimulator] = SimpleQueue()
    remotes = [RemoteSimulator(simulator, episode_s, **options) for _ in range(workers)]
    for remote in remotes:
        free.put(remote)

    def attempt(episode: EpisodeId) -> Result | SimulatorCrashError:
        remote = free.get()
        try:
            for number in range(tries):
                try:
                    return play(remote, episode)
                except SimulatorCrashError as error:
                    if number == tries - 1:
                        return error
            raise AssertionError("tries is at least 1")
        finally:
            free.put(remote)

    waiting = iter(episodes)
    running: list[tuple[EpisodeId, Future[Result | SimulatorCrashError]]] = []
    try:
        with ThreadPoolExecutor(workers) as threads:
            # At most two episodes a worker are ahead, so results do not pile up in memory.
            for episode in waiting:
                running.append((episode, threads.submit(attempt, episode)))
                if len(running) >= 2 * workers:
                    done, future = running.pop(0)
                    yield done, future.result()
            for done, future in running:
                yield done, future.result()
    finally:
        for remote in remotes:
            remote.close()
