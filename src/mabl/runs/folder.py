"""A run's folder: LOGDIR/ENV/ALGO/seed_N/TIMESTAMP with config, versions, metrics, checkpoints.

config.yaml      every field of the configuration that the algorithm reads, signed by this user
versions.yaml    package versions, git commit, machine
metrics.jsonl    one JSON object a line, `step` in environment steps
curves.png       refreshed during training
tensorboard/     the same metrics
checkpoints/     the newest last
.lock            held by whoever writes
"""

import dataclasses
import importlib.metadata
import platform
import subprocess
from dataclasses import replace
from datetime import datetime
from math import gcd
from pathlib import Path

import yaml

from mabl import plain_yaml
from mabl.algorithms.config import Config, from_dict
from mabl.algorithms.registry import ALGORITHMS, unread
from mabl.envs.registry import names_code
from mabl.errors import UserError
from mabl.runs.files import check_plain, replace_file
from mabl.runs.trust import is_own, signed

CONFIG_SIZE = 1_000_000
"""Characters of a config, at most."""

RECORDED_PACKAGES = ("mabl", "jax", "jaxlib", "equinox", "optax", "jaxmarl")


def create(config: Config, seed: int) -> Path:
    """Make the folder of one seed's run and write its config and versions.

    Raises UserError where it cannot be written, and for a label that is another algorithm's name.
    """
    if config.label in ALGORITHMS and config.label != config.algo:
        raise UserError(f"--label {config.label} is an algorithm, but not {config.algo}: change it")
    devices = config.num_devices // gcd(config.num_devices, config.num_seeds)  # of one seed
    config = replace(config, seed=seed, num_seeds=1, num_devices=devices)
    parent = Path(config.logdir) / config.env / config.name / f"seed_{seed}"
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    try:
        parent.mkdir(parents=True, exist_ok=True)
        folder = make_unused(parent, stamp)
        write_config(folder, config)
        replace_file(folder / "versions.yaml", as_yaml(versions()))
    except OSError as error:
        raise UserError(
            f"cannot write to {parent} ({error.strerror}): choose another --logdir"
        ) from error
    return folder


def make_unused(parent: Path, stamp: str) -> Path:
    """Make `parent/stamp`, with a suffix if other runs start within the same second."""
    folder, n = parent / stamp, 1
    while True:
        try:
            folder.mkdir()
            return folder
        except FileExistsError:
            n += 1
            folder = parent / f"{stamp}-{n}"


def read_config(folder: Path, trust: bool = False) -> Config:
    """The configuration of a run.

    Raises UserError if the folder is not a run, or holds links; and unless `trust`, if this user's
    mabl did not write it, and it names code or arguments of an environment.
    """
    path = folder / "config.yaml"
    if not path.is_file():
        raise UserError(f"{folder} is not a run folder (no config.yaml): give one of mabl train's")
    check_plain(folder)
    try:
        with path.open(encoding="utf-8") as file:
            text = file.read(CONFIG_SIZE)
        data = plain_yaml.load(text)
    except ValueError as error:
        raise UserError(f"{path} is not readable YAML: restore it or train again") from error
    try:
        config = from_dict(Config, data)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    if (names_code(config.env) or config.env_kwargs) and not trust and not is_own(text):
        with_what = f" with {' '.join(config.env_kwargs)}" if config.env_kwargs else ""
        raise UserError(
            f"{folder} was not written by your mabl, and would have {config.env} made{with_what}: "
            "look at its config.yaml, then add --trust"
        )
    return config


def write_config(folder: Path, config: Config) -> None:
    """Record a changed configuration, e.g. more steps after a resume. It is signed."""
    data = dataclasses.asdict(config)
    for name in unread(config.algo):
        del data[name]
    replace_file(folder / "config.yaml", signed(as_yaml(data)))


def as_yaml(data: dict) -> str:
    """Plain YAML in the given order."""
    return yaml.safe_dump(data, sort_keys=False)


def versions() -> dict[str, str]:
    """What the numbers of this run depend on besides its config."""
    found = {name: importlib.metadata.version(name) for name in RECORDED_PACKAGES}
    return {
        **found,
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
        "git": git_commit(),
    }


def git_commit() -> str:
    """The commit of mabl's source tree, or `unknown` outside a checkout."""
    checkout = Path(__file__).parents[3]
    if not (checkout / ".git").exists():  # an installed package may lie in someone else's tree
        return "unknown"
    try:
        return subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=12"],
            cwd=checkout,
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
