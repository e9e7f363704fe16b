"""Films of episodes: making one at a time with `mabl play`, and finding what was made."""

import asyncio
import os
import sys
from asyncio.subprocess import DEVNULL, PIPE, STDOUT, Process
from contextlib import suppress
from pathlib import Path

NICENESS = 10
"""Films leave the processors to what is trained."""


class Studio:
    """Films episodes with `mabl play`, one at a time."""

    def __init__(self) -> None:
        self.filming: Path | None = None
        self.failed: dict[Path, str] = {}
        """What it last said of runs that it could not film."""
        self._process: Process | None = None

    async def film(self, run: Path) -> None:
        """Film an episode of a run, unless something is being filmed."""
        if self.filming:
            return
        self.filming = run
        self.failed.pop(run, None)
        try:
            self._process = await asyncio.create_subprocess_exec(
                *(sys.executable, "-m", "mabl", "play", str(run), "--episodes", "1"),
                stdin=DEVNULL,
                stdout=PIPE,
                stderr=STDOUT,
                env=os.environ | {"JAX_PLATFORMS": "cpu"},  # accelerators are for training
            )
            with suppress(ProcessLookupError):  # it has ended already
                os.setpriority(os.PRIO_PROCESS, self._process.pid, os.nice(0) + NICENESS)
            said, _ = await self._process.communicate()
            if self._process.returncode:
                lines = said.decode(errors="replace").strip().splitlines()
                self.failed[run] = lines[-1] if lines else f"exit code {self._process.returncode}"
        finally:
            self.filming = self._process = None

    def close(self) -> None:
        """Leave a film that is being made."""
        if self._process:
            with suppress(ProcessLookupError):
                self._process.terminate()


def films(run: Path) -> list[Path]:
    """Of a run's episodes, the newest first; links are left out."""
    folder = run / "videos"
    found = []
    try:
        for path in () if folder.is_symlink() else folder.iterdir():
            whole = path.suffix in (".gif", ".mp4") and not path.name.startswith("unfinished-")
            if whole and path.is_file() and not path.is_symlink():
                found.append((path.stat().st_mtime, path))
    except OSError:  # there is none, or it was replaced meanwhile
        pass
    return [path for _, path in sorted(found, reverse=True)]


def film_at(logdir: Path, where: str) -> Path | None:
    """The film at a path below a folder that is no link itself; None for any other file."""
    path = logdir / where
    try:
        inside = path.is_relative_to(logdir) and path.resolve() == path
    except (ValueError, OSError):
        return None
    run = path.parent.parent
    return path if inside and (run / "config.yaml").is_file() and path in films(run) else None
