import os
import signal

from robomme_interference_data.runtime.safe_path import set_safe_path


def run_program() -> None:
    """Run the command line as a program: Ctrl-C never prints a traceback."""
    set_safe_path()
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # during the imports
    from .main import main

    signal.signal(signal.SIGINT, _interrupt)
    try:
        main()
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def _interrupt(*_: object) -> None:
    """Stop the command; a second Ctrl-C does not wait for its cleanup."""
    signal.signal(signal.SIGINT, lambda *_: os._exit(128 + signal.SIGINT))
    raise KeyboardInterrupt
