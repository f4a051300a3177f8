"""Batches on several devices whose callbacks are given more than XLA hands over without a copy."""

import subprocess
import sys

import pytest

pytest.importorskip("mujoco")

SCRIPT = """
from jaxlfi.io import host_devices

host_devices.divide(2)

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxlfi.envs.whip.parameters import median
from jaxlfi.envs.whip.physics import engine as physics
from jaxlfi.envs.whip.physics.native import NativeEngine
from jaxlfi.envs.whip.rig import START

engine, scenes = NativeEngine(), 1400


def one(length):
    targets = jnp.tile(jnp.asarray(START), (3, 1))
    return physics.rollout(engine, median(length, 8e3), targets).failed[-1]


over = PartitionSpec("devices")
mesh = Mesh(np.array(jax.devices()), ("devices",))
many = jax.jit(jax.shard_map(jax.vmap(one), mesh=mesh, in_specs=over, out_specs=over, check_vma=False))
print(len(jax.devices()), int(np.sum(~np.asarray(many(jnp.linspace(0.2, 0.3, scenes))))))
"""


@pytest.mark.slow
def test_callbacks_on_all_devices_do_not_wait_for_ever():
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=240, check=True)
    assert done.stdout.split() == ["2", "1400"]
