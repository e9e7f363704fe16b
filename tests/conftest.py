"""Shared settings: mabl's warnings are errors, rank promotion raises, programs are cached.

They are compiled quickly instead of well, also by the processes that tests start: most compute
next to nothing.
"""

import os
from importlib.metadata import version
from pathlib import Path

os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR",
    str(Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mabl" / "jax-tests"),
)
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
# Ray's workers give way to whoever wants to compute, and never get far beside other tests.
os.environ.setdefault("RAY_worker_niceness", "0")
# As in `join_cluster`: each worker would install the project anew.
os.environ.setdefault("RAY_ENABLE_UV_RUN_RUNTIME_ENV", "0")
# Together with optimisations off, above, this saves a third of the time to compile. Later versions
# of jaxlib do not know the flag, and abort at one that they do not know.
FLAG = "--xla_cpu_use_fusion_emitters=false"
if version("jaxlib").startswith("0.10.") and FLAG not in os.environ.get("XLA_FLAGS", ""):
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {FLAG}"

import jax  # noqa: E402
import pytest  # noqa: E402

jax.config.update("jax_numpy_rank_promotion", "raise")


def pytest_configure(config):
    config.addinivalue_line("filterwarnings", r"error:::mabl(\..*)?")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Tests of a module belong to one worker, which makes their fixtures and programs once."""
    for item in items:
        if not item.get_closest_marker("xdist_group"):
            item.add_marker(pytest.mark.xdist_group(item.module.__name__))


@pytest.fixture(scope="session")
def cluster():
    """A Ray cluster of this machine alone, which workers join."""
    ray = pytest.importorskip("ray")
    ray.init("local", num_cpus=3, include_dashboard=False, log_to_driver=False)
    yield
    ray.shutdown()


@pytest.fixture(scope="module", autouse=True)
def _forget_programs():
    """Programs hold on to thousands of memory maps each, and a process may have 65,530 in all."""
    yield
    from mabl.training.programs import forget_programs  # not before its types are checked

    forget_programs()
    jax.clear_caches()


@pytest.fixture(scope="session", autouse=True)
def _no_settings_of_the_user(tmp_path_factory):
    os.environ["XDG_CONFIG_HOME"] = str(tmp_path_factory.mktemp("settings"))


@pytest.fixture
def mabl(monkeypatch, capsys):
    """Runs a command in this process; returns exit code, stdout, stderr."""
    from mabl import cli  # not before its packages are told to check shapes

    def invoke(*arguments):
        monkeypatch.setattr("sys.argv", ["mabl", *map(str, arguments)])
        with pytest.raises(SystemExit) as exit_:
            cli.main()
        return exit_.value.code, *capsys.readouterr()

    return invoke
