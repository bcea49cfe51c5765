"""The memory of this machine: a limit on this process, and how many workers fit in it."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

from robomme_interference_data.errors import FormatError


@contextmanager
def memory_limit(most: int) -> Iterator[None]:
    """Limit the data of this process to `most` bytes; afterwards, its former limit applies again.

    Only a program that owns its process may do so, not a library. Windows has no such limit, and
    macOS does not enforce it.

    Raises:
        FormatError: If more memory is needed.
    """
    try:
        import resource
    except ImportError:  # Windows
        yield
        return
    # RLIMIT_AS would also count what is only reserved: gigabytes on machines with many cores.
    before, highest = resource.getrlimit(resource.RLIMIT_DATA)
    limits = [limit for limit in (most, before, highest) if limit != resource.RLIM_INFINITY]
    resource.setrlimit(resource.RLIMIT_DATA, (min(limits), highest))
    try:
        yield
    except MemoryError:
        raise FormatError(
            f"the files need more than {most / 2**30:g} GB of memory",
            "Give fewer files at once; from Python, there is no limit.",
        ) from None
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (before, highest))


def fitting_workers(worker_gb: float) -> int:
    """Return how many workers this machine has cores and memory for; at least one.

    Args:
        worker_gb: Memory in GB that each of them takes; 0 if it does not matter.
    """
    cores = os.cpu_count() or 1
    if not worker_gb or not hasattr(os, "sysconf"):  # Windows
        return cores
    memory_gb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    return max(1, min(cores, int(memory_gb / worker_gb)))
