"""The versions in a simulator's own interpreter, where this runs as a program of its own.

Its arguments are the name of the simulator, and the distributions to look up.
"""

import importlib.metadata
import json
import platform
import sys
from contextlib import suppress

if __name__ == "__main__":
    simulator, *names = sys.argv[1:]
    versions = {simulator + "_python": platform.python_version()}
    for name in names:
        with suppress(importlib.metadata.PackageNotFoundError):  # it is only on the path
            versions[simulator + "_" + name] = importlib.metadata.version(name)
    sys.stdout.write(json.dumps(versions))  # noqa: TID251 - a separate program
