import os
import signal
import sys

from robomme_interference_data.package import install_source
from robomme_interference_data.runtime.safe_path import set_safe_path


def run_program() -> None:
    """Run the command line as a program: Ctrl-C never prints a traceback."""
    set_safe_path()
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # during the imports
    try:
        from .main import main
    except ImportError as error:  # a required library is missing or broken, so nothing can run
        fix = f"pip install --force-reinstall {install_source()}"
        sys.exit(f"Error: a required library cannot be imported: {error}\nReinstall it: {fix}")

    signal.signal(signal.SIGINT, _interrupt)
    try:
        main()
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def _interrupt(*_: object) -> None:
    """Stop the command; a second Ctrl-C does not wait for its cleanup."""
    signal.signal(signal.SIGINT, lambda *_: os._exit(128 + signal.SIGINT))
    raise KeyboardInterrupt
