"""Files of run folders: replaced whole, and outliving a loss of power."""

import os
from pathlib import Path

from mabl.errors import UserError


def replace_file(path: Path, content: str) -> None:
    """Put `content` where `path` is: whole, or not at all. Raises OSError."""
    temporary = path.with_name(f".{path.name}")
    with temporary.open("w", encoding="utf-8") as file:
        file.write(content)
        flush_to_disk(file.fileno())
    temporary.replace(path)
    flush_folder(path.parent)


def flush_to_disk(descriptor: int) -> None:
    """Have a file outlive a loss of power."""
    os.fsync(descriptor)


def flush_folder(folder: Path) -> None:
    """Have a folder's names outlive a loss of power."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def check_plain(folder: Path) -> None:
    """Raise UserError if a folder holds anything but folders and files of its own.

    A link would have mabl read and write elsewhere, and a pipe would have it wait forever.
    """
    for parent, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(parent, name)
            if path.is_symlink() or not (path.is_dir() or path.is_file()):
                raise UserError(
                    f"{path} is a link or no file: mabl reads and writes run folders that hold "
                    "files of their own alone"
                )
