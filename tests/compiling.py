"""How tests compile: their programs run for milliseconds and would be optimised for seconds."""

import jax

QUICK = {"xla_backend_optimization_level": 0}
"""Options of `jax.jit` for programs with little to fuse."""

_UNFUSED = {"xla_cpu_use_fusion_emitters": False} if jax.__version_info__ < (0, 10) else {}

PLAIN = QUICK | _UNFUSED
"""The same without the processor's newer fusions, which later XLA cannot do without."""

BRISK = {"xla_backend_optimization_level": 1} | _UNFUSED
"""For programs that train for long: compiled in a third of the time, and hardly slower than by default."""
