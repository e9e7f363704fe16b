"""Several devices compute the numbers of one: eight virtual ones, in processes of their own."""

import os
import subprocess
import sys

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from tests.tiny import tiny

from mabl.runs.checkpoint import Checkpoints, named
from mabl.training.programs import programs

EIGHT = "--xla_force_host_platform_device_count=8"


def trained(folder, algo, n_seeds, n_devices):
    folder.mkdir()
    flags = f"{os.environ.get('XLA_FLAGS', '')} {EIGHT}"
    arguments = (algo, n_seeds, n_devices, folder)
    subprocess.run(
        [sys.executable, "-m", "tests.training.on_devices", *map(str, arguments)],
        env=os.environ | {"XLA_FLAGS": flags},
        check=True,
        timeout=300,
    )
    return dict(np.load(folder / "numbers.npz"))


@pytest.mark.parametrize(
    ("algo", "n_seeds", "n_devices"),
    [("mabl", 2, 8), ("mabl-qmix", 1, 3)],  # 3 do not divide the batch
)
def test_devices_share_batches_and_seeds(tmp_path, algo, n_seeds, n_devices):
    many = trained(tmp_path / "many", algo, n_seeds, n_devices)
    one = trained(tmp_path / "one", algo, n_seeds, 1)
    assert one.pop("devices") == 1 and many.pop("devices") == n_devices
    assert one.pop("compiled") == many.pop("compiled") == 0  # states stay where they lay
    assert set(one) == set(many) and len(one) > 30
    for name in one:
        assert_allclose(many[name], one[name], rtol=2e-3, atol=2e-4, err_msg=name)

    shape = programs(tiny(algo)).init.eval_shape(jax.random.key(0)[None])
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), shape)
    _, restored = Checkpoints(tmp_path / "many" / "checkpoints", 1).restore("state", like)
    for name, leaf in named(restored.learner):  # on the one device that is here
        assert_array_equal(leaf, many[name][0])


def test_more_devices_than_there_are_is_one_line(mabl, tmp_path):
    code, _, err = mabl("train", "--num-devices=64", f"--logdir={tmp_path}")
    assert code == 2 and "--num-devices is 64: give a number up to" in err
    assert "Traceback" not in err and not any(tmp_path.iterdir())
