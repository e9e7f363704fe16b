"""How much memory there is, and how much a run takes."""

from pathlib import Path

import jax

from mabl.errors import UserError


def free_memory() -> int | None:
    """Free bytes on the default device; None where the system does not say."""
    stats = jax.devices()[0].memory_stats()
    if stats and "bytes_limit" in stats:
        return stats["bytes_limit"] - stats["bytes_in_use"]
    meminfo = Path("/proc/meminfo")
    if not meminfo.exists():
        return None
    lines = dict(line.split(":") for line in meminfo.read_text().splitlines())
    return int(lines["MemAvailable"].split()[0]) * 1024


def check_memory(needed: int, free: int | None) -> None:
    """Raise UserError if `needed` bytes exceed the `free` bytes (None: unknown, no check)."""
    if free is not None and needed > free:
        raise UserError(
            f"the replay needs {needed / 2**30:.1f} GiB and {free / 2**30:.1f} GiB are free: "
            "lower --training.replay-capacity, --training.num-envs or --num-seeds"
        )
