"""The program's beginning: `shapepose-fg`, and `python -m shapepose_fg`."""

import os
import signal


def main() -> None:
    """Run the command line. Until it is loaded, Ctrl-C ends the program without a word."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, lambda *_: os._exit(130))
    from shapepose_fg.cli.main import main as run

    run()


if __name__ == "__main__":
    main()
