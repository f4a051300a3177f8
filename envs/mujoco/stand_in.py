"""Models of parameter vectors without recompiling their meshes, where that gives the same numbers.

MuJoCo's compiler finds hull, volume and inertia of each mesh every time, which can take longer than a simulation. Here
a stand-in is compiled instead: the same model with spheres for meshes, and with the inertias that the meshes gave their
bodies. What it has in common with the model is put into a copy of the compiled one. That this is the same model, number
for number, is checked by compiling both at many parameter vectors.
"""

import copy
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from jaxlfi.envs.mujoco.effects import Effects, built
from jaxlfi.envs.mujoco.parameters import INERTIAL, make_explicit

RANDOM = 4
"""Number of random parameter vectors at which models are compared, besides those with a parameter at a bound."""
OF_SLEEP = ("dof_length",)
"""Fields that matter only to sleep, with which models are compiled whole."""
Build = Callable[[np.ndarray], mujoco.MjModel]


class StandIn:
    """Makes models with a stand-in."""

    def __init__(self, model: mujoco.MjModel, build: Build, rows: Mapping[str, np.ndarray], options: Sequence[str]):
        """Nothing is compiled yet.

        Args:
            model: at some parameters.
            build: makes the stand-in of a parameter vector.
            rows: rows of each field that it has in common with the model.
            options: fields of `opt` that it has in common with the model.
        """
        self._model, self._build = model, build
        whole = slice(None)
        self._rows = {name: whole if len(own) == len(getattr(model, name)) else own for name, own in rows.items()}
        self._options = tuple(options)

    def __call__(self, theta: Float[np.ndarray, " dim"]) -> mujoco.MjModel:
        """The model of a parameter vector.

        Raises:
            ValueError: where MuJoCo refuses it.
        """
        other, model = self._build(theta), copy.copy(self._model)
        for name, rows in self._rows.items():
            getattr(model, name)[rows] = getattr(other, name)[rows]
        for name in self._options:
            setattr(model.opt, name, getattr(other.opt, name))
        model.stat.meaninertia = other.stat.meaninertia
        return model


def builder(
    spec: mujoco.MjSpec, does: Effects, low: Float[np.ndarray, " dim"], high: Float[np.ndarray, " dim"]
) -> Build:
    """The function that makes models of parameter vectors: by a stand-in, or by compiling them whole.

    Args:
        spec: of the model.
        does: what parameters do.
        low: smallest values of the parameters.
        high: largest values.
    """
    whole: Build = functools.partial(built, spec, does)
    if not any(geom.type == mujoco.mjtGeom.mjGEOM_MESH for geom in spec.geoms):
        return whole
    try:
        model = spec.copy().compile()
        if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
            return whole
        stand_in: Build = functools.partial(built, _without_meshes(spec, model), does)
        found = _compared(whole, stand_in, _points(low, high))
    except ValueError:  # something refers to a mesh, or only one of both is refused
        return whole
    return whole if found is None else StandIn(found.model, stand_in, found.rows, found.options)


class _Common(NamedTuple):
    """A model, with the rows of its fields and the options that it has in common with its stand-in."""

    model: mujoco.MjModel
    rows: Mapping[str, np.ndarray]
    options: Sequence[str]


def _compared(whole: Build, stand_in: Build, points: Sequence[np.ndarray]) -> _Common | None:
    """What models have in common with stand-ins at parameter vectors; None if more depends on the parameters.

    Raises:
        ValueError: where MuJoCo refuses one of both.
    """
    first, common, fixed = None, {}, {}
    for one, other in _compiled(whole, stand_in, points):
        if first is None:
            first = one
            common = {name: np.ones(len(getattr(one, name)), bool) for name in _arrays(one)}
            fixed = {name: own.copy() for name, own in common.items()}
        for name, own in common.items():
            own &= _same_rows(getattr(one, name), getattr(other, name))
            fixed[name] &= _same_rows(getattr(one, name), getattr(first, name))
        options = _numbers(one.opt)
        if one.stat.meaninertia != other.stat.meaninertia or not all(
            np.array_equal(getattr(one.opt, name), getattr(other.opt, name)) for name in options
        ):
            return None
    if first is None or any(not (own | fixed[name]).all() for name, own in common.items() if name not in OF_SLEEP):
        return None
    rows = {name: np.flatnonzero(own) for name, own in common.items() if own.any()}
    return _Common(first, rows, _numbers(first.opt))


def _without_meshes(spec: mujoco.MjSpec, model: mujoco.MjModel) -> mujoco.MjSpec:
    """A specification with spheres for meshes, whose bodies keep their inertias."""
    own, mesh = spec.copy(), mujoco.mjtGeom.mjGEOM_MESH
    for body in own.bodies:
        if body.name and not body.explicitinertial and any(geom.type == mesh for geom in body.geoms):
            compiled = model.body(body.name)
            make_explicit(body, {key: np.array(getattr(compiled, key)) for key in INERTIAL})
    for geom in own.geoms:
        if geom.type == mesh:
            geom.type, geom.meshname, geom.size = mujoco.mjtGeom.mjGEOM_SPHERE, "", np.full(3, 0.1)
    for one in own.meshes:
        own.delete(one)
    return own


def _points(low: np.ndarray, high: np.ndarray) -> list[np.ndarray]:
    """The middle, points with one parameter at a bound, and random ones."""
    middle = 0.5 * (low + high)
    bounds = [np.where(np.arange(len(low)) == d, end, middle) for d in range(len(low)) for end in (low, high)]
    return [middle, *bounds, *np.random.default_rng(0).uniform(low, high, (RANDOM, len(low)))]


def _compiled(
    whole: Build, stand_in: Build, points: Sequence[np.ndarray]
) -> Iterator[tuple[mujoco.MjModel, mujoco.MjModel]]:
    """Models and stand-ins of parameter vectors, except where MuJoCo refuses both.

    Raises:
        ValueError: where it refuses one of both.
    """
    for theta in points:
        one, other = _or_none(whole, theta), _or_none(stand_in, theta)
        if (one is None) != (other is None):
            raise ValueError("one of both is refused")
        if one is not None and other is not None:
            yield one, other


def _or_none(build: Build, theta: np.ndarray) -> mujoco.MjModel | None:
    try:
        return build(theta)
    except ValueError:
        return None


def _arrays(model: mujoco.MjModel) -> list[str]:
    """Fields that are arrays of numbers."""
    values = {name: getattr(model, name, None) for name in dir(model) if not name.startswith("_")}
    return [name for name, value in values.items() if isinstance(value, np.ndarray) and value.size]


def _same_rows(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Which rows two arrays have in common."""
    found, shared = np.zeros(len(one), bool), min(len(one), len(other))
    if one.shape[1:] == other.shape[1:]:
        found[:shared] = (one[:shared] == other[:shared]).all(axis=tuple(range(1, one.ndim)))
    return found


def _numbers(options: mujoco.MjOption) -> list[str]:
    values = {name: getattr(options, name) for name in dir(options) if not name.startswith("_")}
    return [name for name, value in values.items() if isinstance(value, np.ndarray | int | float)]
