"""The programs that a user waits for can be lowered for GPUs and TPUs, and nothing in them needs the host.

Lowering needs no accelerator. What it does not tell is whether a compiler accepts the program, or how fast it is.
"""

import re

import jax
import pytest
from jax import export

pytest.importorskip("mujoco.mjx")
pytest.importorskip("brax")

from experiments.benchmarks import main_programs
from jaxlfi.envs.mujoco import task as mujoco_task
from jaxlfi.envs.mujoco.environment import environment

PLATFORMS = ["cuda", "tpu"]
LIBRARIES = {
    *("cusolver_geqrf_ffi", "cusolver_gesvd_ffi", "cusolver_gesvdj_ffi", "cusolver_potrf_ffi"),
    *("Eigh", "ProductOfElementaryHouseholderReflectors", "Qr"),
}
"""Decompositions of CUDA's library and of the TPU's compiler: calls that are no operations of XLA."""


@pytest.fixture(autouse=True, scope="module")
def keys_of_brax():
    """Brax uses keys in its own way, which the checker takes for a reuse; and few runs are a grid."""
    with jax.debug_key_reuse(False), pytest.MonkeyPatch.context() as patched:
        patched.setattr(main_programs, "GRID_RUNS", 2)
        yield


@pytest.mark.parametrize(
    "group",
    [  # training is a part of the grid's
        pytest.param(name, marks=[pytest.mark.slow] * (name != "mg1"))
        for name in main_programs.MAKERS
        if name != "training"
    ],
)
def test_programs_are_lowered_for_accelerators(group):
    for one in main_programs.MAKERS[group]():
        module = export.export(one.function, platforms=PLATFORMS)(*one.arguments).mlir_module()
        assert "f64" not in module, one.name  # which accelerators emulate, or lack
        assert set(re.findall(r"custom_call @(\w+)", module)) <= LIBRARIES, one.name
        assert "callback" not in module, one.name


def test_what_is_left_on_the_host_is_named():
    """MuJoCo compiles the model of every parameter vector there, in rollouts and when an episode begins."""
    simulator, arm = mujoco_task(main_programs.ARM, engine="mjx").simulate, environment(main_programs.ARM)
    for models in (simulator._physics.models, arm.models):
        program = jax.make_jaxpr(jax.vmap(models.numbers))(jax.ShapeDtypeStruct((2, models._dim), "float32"))
        assert [equation.primitive.name for equation in program.eqns] == ["pure_callback"]
        # jax lowers callbacks for the platform at hand alone: they run on an accelerator's host, and are not exported.
        with pytest.raises(ValueError, match="platform"):
            export.export(jax.jit(models.numbers), platforms=PLATFORMS[:1])(
                jax.ShapeDtypeStruct((models._dim,), "float32")
            )
