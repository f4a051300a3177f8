"""MJX models of parameter vectors inside compiled programs, with the numbers that MuJoCo compiled.

MuJoCo derives many numbers of a model from the few that an MJCF file holds: from a body's mass its inertia, the masses
of all trees that it belongs to, the inverse weights of constraints. MJX derives none of them. Each parameter vector's
model is therefore compiled by MuJoCo, on the host, and whatever depends on the parameters is put into the MJX model, so
that every parameter is as exact as in MuJoCo itself. Compiling takes about a millisecond, and the numbers are cached:
a policy is trained on few models, each of which serves many episodes. (Deriving these numbers in JAX would have meant
reimplementing MuJoCo's compiler: inverse weights alone are rational functions of all masses.)
"""

import dataclasses
import functools
import threading
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlfi.distributions.support import Support
from jaxlfi.envs.mujoco.forces import UnmodelledForces
from jaxlfi.envs.mujoco.mjx_ignored import OPTIONS, refuse_ignored, warn_of_saturation
from jaxlfi.envs.mujoco.parameters import saved
from jaxlfi.io.quiet_imports import quiet_imports

try:
    with quiet_imports():
        from mujoco import mjx
except ImportError as error:
    raise ImportError(
        "engine=mjx and policies of MuJoCo models need MJX: pip install 'jaxlfi[mujoco,policy]'"
    ) from error

CACHED = 65536
"""Number of models whose numbers are cached, a few hundred bytes each."""
INSIDE = 1e-3
"""Distance from the bounds of Phi at which models are compared, as a fraction of its width: MuJoCo may omit zeros."""
FRICTIONS = ("dof_frictionloss", "tendon_frictionloss")
"""Fields for which MJX treats a joint as locked if they are 0 and were not in the base model."""
OF_HEIGHT_FIELDS = {"geom_rbound_hfield"}
"""Static fields of MJX that only height fields need."""
LEAST_FRICTION = 1e-9
"""Friction in place of none, in N or N m."""
MOST = 4.0
"""Standard deviations within which the forces that a model lacks are probed."""
PROBES = 4
"""Number of further models, at random parameters, that are compared."""


class Models:
    """MJX models of parameter vectors.

    Attributes:
        base: at the nominal parameters.
        varied: names of the model's fields that depend on the parameters.
    """

    def __init__(
        self,
        build: Callable[[np.ndarray], mujoco.MjModel],
        names: Sequence[str],
        nominal: Float[np.ndarray, " dim"],
        feasible: Support,
    ):
        """Find what depends on the parameters, by compiling models with each of them at its bounds.

        Args:
            build: makes the model of a parameter vector [D]; raises ValueError where it cannot.
            names: of the parameters.
            nominal: parameters whose model can be compiled.
            feasible: Phi.

        Raises:
            ValueError: for a model that MJX cannot simulate, and parameters that change what MJX holds fixed.
        """
        self._build, self._dim = build, len(names)
        compiled = build(nominal)
        refuse_ignored(compiled)
        warn_of_saturation(compiled)
        try:
            self.base = mjx.put_model(compiled)
        except (NotImplementedError, ValueError) as error:
            raise ValueError(f"model: MJX cannot simulate it: {' '.join(str(error).split())}") from error
        paths, self._tree = jax.tree_util.tree_flatten_with_path(self.base)
        self._leaves = [leaf for _, leaf in paths]
        own = [tuple(key.name for key in path if key.name != "_impl") for path, _ in paths]
        varied: set[int] = set()
        for theta, name in _probes(names, nominal, feasible):
            try:
                model = build(theta)
            except ValueError:
                continue  # such models are failures, here as in inference
            found = self._differing(model, own, f"parameters: {name}")
            read = [place for place in found if own[place][-1] not in OPTIONS]
            if not read and saved(model) != saved(compiled):
                raise ValueError(f"parameters: {name}: expected numbers that MJX reads, got one that it ignores")
            varied |= found
        self._places = sorted(varied)
        self._paths = [own[place] for place in self._places]
        self.varied = tuple(".".join(path) for path in self._paths)
        self._shapes = [np.shape(self._leaves[place]) for place in self._places]
        self._sizes = [int(np.prod(shape)) for shape in self._shapes]
        self._nominal = self._numbers(compiled)
        self._known = functools.lru_cache(CACHED)(self._of_one)
        self._lock = threading.Lock()

    def numbers(self, theta: Float[Array, " dim"]) -> tuple[Float[Array, " numbers"], Bool[Array, ""]]:
        """All numbers that depend on the parameters, in one vector, and whether MuJoCo refuses the model.

        Args:
            theta: in natural units; a batch of any number of axes by `vmap`.
        """
        shapes = jax.ShapeDtypeStruct(self._nominal.shape, jnp.float32), jax.ShapeDtypeStruct((), jnp.bool_)
        if not self._places:
            return jnp.asarray(self._nominal), jnp.asarray(False)
        return jax.pure_callback(self._compiled, shapes, theta, vmap_method="broadcast_all")

    def model(self, numbers: Float[Array, " numbers"]) -> mjx.Model:
        """The MJX model with these numbers."""
        leaves, begin = list(self._leaves), 0
        for place, shape, size in zip(self._places, self._shapes, self._sizes, strict=True):
            leaves[place] = numbers[begin : begin + size].reshape(shape)
            begin += size
        return jax.tree.unflatten(self._tree, leaves)

    def _differing(self, model: mujoco.MjModel, own: Sequence[tuple[str, ...]], where: str) -> set[int]:
        """Leaves of the MJX model that differ from the nominal model's."""
        try:
            refuse_ignored(model)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from error
        put = mjx.put_model(model)
        if jax.tree.structure(put) != self._tree:
            fixed = _static_differences(self.base, put)
            if set(fixed) != OF_HEIGHT_FIELDS or model.nhfield:
                changed = ", ".join(fixed) or "its structure"
                raise ValueError(f"{where}: expected numbers that MJX can vary, got one that changes {changed}")
        found = set()
        for place, (before, after) in enumerate(zip(self._leaves, jax.tree.leaves(put), strict=True)):
            if np.shape(before) != np.shape(after):
                raise ValueError(f"{where}: expected models of the same sizes, got others of {'.'.join(own[place])}")
            if np.array_equal(before, after, equal_nan=np.asarray(before).dtype.kind == "f"):
                continue
            if not np.array_equal(np.float32(_number(model, own[place])).ravel(), np.ravel(after)):
                raise ValueError(
                    f"{where}: expected numbers that MJX takes from the model as they are, got one that changes "
                    f"{'.'.join(own[place])}"
                )
            found.add(place)
        return found

    def _numbers(self, model: mujoco.MjModel) -> np.ndarray:
        own = [np.zeros(0)]
        for path, place in zip(self._paths, self._places, strict=True):
            number = _number(model, path)
            if path[-1] in FRICTIONS:
                number = np.where(np.asarray(self._leaves[place]) > 0, np.maximum(number, LEAST_FRICTION), number)
            own.append(np.ravel(number))
        return np.concatenate(own).astype(np.float32)

    def _compiled(self, theta: Any) -> tuple[np.ndarray, np.ndarray]:
        """Numbers and refusals of a batch of any number of axes; NumPy in, NumPy out."""
        theta = np.asarray(theta, np.float32)
        with self._lock:
            rows = [self._known(row.tobytes()) for row in theta.reshape(-1, self._dim)]
        numbers = np.stack([row for row, _ in rows]).reshape(*theta.shape[:-1], -1)
        return numbers, np.array([refused for _, refused in rows]).reshape(theta.shape[:-1])

    def _of_one(self, theta: bytes) -> tuple[np.ndarray, bool]:
        try:
            return self._numbers(self._build(np.frombuffer(theta, np.float32))), False
        except ValueError:
            return self._nominal, True


def with_forces(
    build: Callable[[np.ndarray], mujoco.MjModel],
    forces: UnmodelledForces | None,
    names: Sequence[str],
    nominal: Float[np.ndarray, " dim"],
    feasible: Support,
) -> Models:
    """Models of parameters, followed by the coefficients of the forces that the model lacks, if any.

    Args:
        build: makes the model of a parameter vector.
        forces: that the model lacks.
        names: of the parameters.
        nominal: parameters whose model can be compiled.
        feasible: Phi.

    Raises:
        ValueError: see `Models`.
    """
    if forces is None:
        return Models(build, names, nominal, feasible)
    least, most, dim = _least_friction(forces), MOST * forces.deviations, len(names)

    def lacking(numbers: np.ndarray) -> mujoco.MjModel:
        model = forces.add(build(numbers[:dim]), numbers[dim:])
        # MJX lays out its solver for the degrees of freedom that have friction: here always the same ones.
        model.dof_frictionloss[:] = np.maximum(model.dof_frictionloss, least)
        return model

    box = Support(np.append(feasible.low, -most), np.append(feasible.high, most))
    return Models(lacking, (*names, *forces.names), np.append(nominal, 0.0 * most), box)


def added(model: mjx.Model, forces: UnmodelledForces, numbers: Float[Array, " numbers"]) -> mjx.Model:
    """A model of `with_forces` with these forces added: MuJoCo derives nothing from them (`forces.add`)."""
    stiffness, damping, friction = jnp.split(numbers, np.cumsum([len(forces.stiffness), len(forces.damping)]))
    return model.replace(
        jnt_stiffness=model.jnt_stiffness + stiffness,
        dof_damping=jnp.maximum(model.dof_damping + damping, 0.0),
        dof_frictionloss=jnp.maximum(model.dof_frictionloss + friction, _least_friction(forces)),
    )


def _least_friction(forces: UnmodelledForces) -> Float[np.ndarray, " dofs"]:
    return LEAST_FRICTION * (forces.friction > 0)


def _probes(names: Sequence[str], nominal: np.ndarray, feasible: Support) -> list[tuple[np.ndarray, str]]:
    """Parameters whose models are compared, and what differs in them from the nominal ones."""
    low, high = np.asarray(feasible.low, float), np.asarray(feasible.high, float)
    low, high = low + INSIDE * (high - low), high - INSIDE * (high - low)
    found = []
    for d, name in enumerate(names):
        for number in (low[d], high[d]):
            theta = np.array(nominal, float)
            theta[d] = number
            found.append((theta, repr(name)))
    rng = np.random.default_rng(0)
    return found + [(rng.uniform(low, high), ", ".join(names)) for _ in range(PROBES)]


def _number(model: mujoco.MjModel, path: Sequence[str]) -> np.ndarray:
    """A field of a compiled model, given as ("opt", "gravity")."""
    found = model
    for name in path:
        found = getattr(found, name, np.nan)
    return np.asarray(found)


def _static_differences(one: Any, other: Any) -> list[str]:
    """Names of fields of MJX models that differ."""
    found = []
    for field in dataclasses.fields(one):
        before, after = getattr(one, field.name), getattr(other, field.name)
        if dataclasses.is_dataclass(before):
            found += _static_differences(before, after)
        elif not isinstance(before, jax.Array) and not np.array_equal(np.asarray(before), np.asarray(after)):
            found.append(field.name)
    return found
