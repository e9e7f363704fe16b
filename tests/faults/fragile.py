"""`mabl`, but killed at the N-th operation on files of its run: `--kill-at=N` comes first."""

import os
import signal
import sys

OPERATIONS = ("open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "shutil.rmtree")


def die_at(number: int) -> None:
    """Count what Python is about to do to a folder called `killed`; at `number`, die at once."""
    done = 0

    def count(event: str, arguments: tuple) -> None:
        nonlocal done
        if event in OPERATIONS and "killed" in os.fsdecode(str(arguments[0])):
            done += 1
            if done == number:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(count)


if __name__ == "__main__":
    if sys.argv[1].startswith("--kill-at="):
        die_at(int(sys.argv.pop(1).partition("=")[2]))
    from mabl.cli import main

    main()
