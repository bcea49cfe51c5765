"""What of the packages that a run uses is installed."""

import platform
from importlib import metadata

from robomme_interference_data.simulators.registry import simulator_class

from .config import AskConfig, RunConfig


def package_versions(config: RunConfig | AskConfig) -> dict[str, str]:
    """Return the versions of Python and of what a run uses, by name; what is missing is left out.

    RoboMME's interpreter has others: see `simulator_versions`.
    """
    names = ["robomme-interference-data", "numpy", "av", "torch"]
    if isinstance(config, RunConfig) and config.policy.startswith("lerobot:"):
        names.append("lerobot")
    if config.retrieval is not None:
        names.append("transformers")
    if isinstance(config, RunConfig):
        names += simulator_class(config.simulator).packages
    found = {"python": platform.python_version()}
    for name in names:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found
