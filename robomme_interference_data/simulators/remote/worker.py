"""The other side of `RemoteSimulator`: the program that runs a simulator in its own interpreter.

That interpreter may be older than this package and have other libraries, so this file needs only
Python 3.8 and numpy. It runs as `python worker.py DESCRIPTOR FILE`: FILE is the user's, with a
class `Episodes`, whose methods are the calls:

    class Episodes:
        def __init__(self, cameras, **options): ...  # names of the cameras to draw; options
        def reset(self, family, split, index, frame_step): ...  # facts, arrays
        def step(self, action, observe): ...  # facts, arrays
        def act(self, policy, known, answer): ...  # facts, arrays; for built-in policies
        def close(self): ...  # end the running episode; called after an exception

Facts are a dictionary of what JSON can hold; arrays map a name to an array, or to a list of arrays
of one shape and type. See `RemoteSimulator` for their names. An `ImportError` while the class is
loaded or made means that the interpreter lacks something; the attributes `install` of the error, a
list of distributions, or `fix`, a sentence, say what to do.

The wire: the two programs share a pipe, since simulators print to stdout. A message is a sequence
of byte strings, each sent with `multiprocessing.connection.Connection.send_bytes` (a signed
big-endian 32-bit length, or -1 and an unsigned 64-bit one; then the bytes):

1. the head, a JSON object in UTF-8: a request has the key `call` and the arguments of the call, an
   answer has the facts. Its key `arrays` lists [name, dtype.str, shape] of what follows;
2. for each array, in that order, each of its entries along the first axis: the bytes in C order.

The first request is `start`; its arguments are those of `Episodes`. An answer with the key `failed`
has the text of an exception; with `refused`, why `Episodes` does not accept these arguments, and
which ones it `takes`; with `problem`, what the interpreter lacks, and its `fix`. Nothing is
pickled: pickles of numpy 1 and 2 differ, and loading one may run any code.
"""

from __future__ import annotations

import importlib.util
import inspect
import json
import os
import queue
import shlex
import signal
import sys
import threading
import traceback
from multiprocessing.connection import Connection
from typing import Any


def send(channel: Connection, head: dict[str, Any], arrays: dict[str, Any] | None = None) -> None:
    """Send a message; an array is sent entry by entry, so that a list of them is not copied."""
    arrays = arrays or {}
    described = []
    for name, items in arrays.items():
        if len({(item.dtype.str, item.shape) for item in items}) != 1:
            raise ValueError(f"{name}: expected arrays of one shape and type")
        described.append([name, items[0].dtype.str, [len(items), *items[0].shape]])
    channel.send_bytes(json.dumps({**head, "arrays": described}).encode())
    for items in arrays.values():
        for item in items:
            channel.send_bytes(item.tobytes())


def receive(channel: Connection) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the head and the arrays, by name, of the next message."""
    head = json.loads(channel.recv_bytes())
    arrays = {}
    for name, dtype, shape in head.pop("arrays"):
        import numpy as np

        arrays[name] = np.empty(shape, dtype)
        for item in arrays[name].reshape(shape[0], -1):
            channel.recv_bytes_into(item)
    return head, arrays


def load(path: str) -> Any:
    """Load a module from its file: no folder is put on the import path, where it could hide one."""
    spec: Any = importlib.util.spec_from_file_location("_simulator", path)
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def serve(channel: Connection, path: str) -> None:
    """Answer requests until the other side closes the pipe, which ends this process."""
    requests: Any = queue.SimpleQueue()
    threading.Thread(target=_read, args=(channel, requests), daemon=True).start()
    head, _ = requests.get()
    head.pop("call")  # `start`
    try:
        make = load(path).Episodes
        signature = inspect.signature(make)
        try:
            signature.bind(**head)
        except TypeError as error:
            send(channel, {"refused": str(error), "takes": [*signature.parameters]})
            return
        worker = make(**head)
    except ImportError as error:
        traceback.print_exc()
        send(channel, {"problem": str(error), "fix": _fix(error)})
        return
    except Exception as error:
        traceback.print_exc()
        send(channel, {"failed": _text(error)})
        return
    send(channel, {})
    while True:
        head, _ = requests.get()
        try:
            call = getattr(worker, head.pop("call"))
            facts, arrays = call(**head)
            send(channel, facts, arrays)
        except Exception as error:
            traceback.print_exc()
            close = getattr(worker, "close", None)
            if close is not None:
                close()
            send(channel, {"failed": _text(error)})


def _read(channel: Connection, requests: Any) -> None:
    """Queue requests; end this process, even during a call, when the other side is gone."""
    try:
        while True:
            requests.put(receive(channel))
    except (EOFError, OSError):
        pass
    except Exception:
        traceback.print_exc()
    os._exit(1)


def _fix(error: ImportError) -> str | None:
    """Return what to do about an error, None if that is unknown.

    That is its attribute `fix`, or the command that installs the distributions that it lists as
    `install`; by default, the missing module.
    """
    fix, missing = getattr(error, "fix", None), getattr(error, "install", None)
    if fix is not None:
        return str(fix)
    if missing is None and isinstance(error, ModuleNotFoundError) and error.name:
        missing = [error.name.split(".")[0].replace("_", "-")]
    if not missing:
        return None
    command = [sys.executable, "-m", "pip", "install"]
    if importlib.util.find_spec("pip") is None:  # an environment that uv made
        command = ["uv", "pip", "install", "--python", sys.executable]
    return "Install what is missing: " + " ".join(map(shlex.quote, [*command, *missing]))


def _text(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"


def main() -> None:
    """Serve on the pipe of a file descriptor."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the other side handles Ctrl-C
    os.set_inheritable(int(sys.argv[1]), False)
    serve(Connection(int(sys.argv[1])), sys.argv[2])


if __name__ == "__main__":
    main()
