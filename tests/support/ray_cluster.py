"""A Ray cluster of several nodes on this machine."""

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import ray
from ray.cluster_utils import Cluster

_MEMORY = 80 << 20


@contextmanager
def running_cluster(nodes: int, cpus: int = 1) -> Iterator[Cluster]:
    """A head that does no work, and as many nodes that do; workers find the tests' modules."""
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = str(Path(__file__).parents[1])
    head = {"num_cpus": 0, "object_store_memory": _MEMORY, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    try:
        for _ in range(nodes):
            add_node(cluster, cpus)
        # Once for all tests: Ray's own processes are kept for the next.
        ray.init(address=cluster.address, log_to_driver=False, logging_level=logging.ERROR)
        yield cluster
    finally:
        ray.shutdown()
        cluster.shutdown()
        if before is None:
            del os.environ["PYTHONPATH"]
        else:
            os.environ["PYTHONPATH"] = before


def add_node(cluster: Cluster, cpus: int = 1, **environment: str) -> Any:
    return cluster.add_node(num_cpus=cpus, object_store_memory=_MEMORY, env_vars=environment)
