"""The entry point: `shapepose-fg`, and `python -m shapepose_fg`."""

import gc
import os
import signal


def main() -> None:
    """Run the command line. Until it is loaded, Ctrl-C ends the program without a message.

    Garbage collection skips the modules imported here, and they are not finalised at exit.
    """
    gc.disable()
    # NumPy's matrices are small here: its threads wait for each other, a tenth of all processor
    # time.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, lambda *_: os._exit(130))
    from shapepose_fg.cli.main import main as run

    gc.freeze()
    gc.enable()
    try:
        run()
    finally:
        gc.freeze()


if __name__ == "__main__":
    main()
