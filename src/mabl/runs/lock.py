"""One process writes a run folder; others may read it."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from mabl.errors import UserError


@contextmanager
def writing(folders: Sequence[Path], patience: float = 0) -> Iterator[None]:
    """Nobody else may write these run folders meanwhile; a process that dies lets go of them.

    Raises UserError if somebody else writes one, and does so for `patience` seconds.
    """
    with ExitStack() as held:
        for folder in folders:
            try:
                held.enter_context(FileLock(folder / ".lock", timeout=patience))
            except Timeout as error:
                raise UserError(
                    f"{folder} is being written by another mabl: wait for its end, or stop it"
                ) from error
        yield
