"""The command line, as `python -m robomme_interference_data`."""

import sys

if __name__ == "__main__":
    # Python puts the current folder first, which may be a downloaded buffer set with modules in it.
    if not sys.flags.safe_path:
        del sys.path[0]

    from robomme_interference_data.cli import run_program

    run_program()
