"""A body's whole inertia in ten numbers, all values of which are physically consistent.

With mass m, centre c and the second moments S of its mass about it, a body's pseudo-inertia is the symmetric matrix J
of the blocks S + m c c^T, m c and m, which is positive definite exactly if the body can exist (Wensing, Kim and
Slotine 2018, doi:10.1109/LRA.2017.2729659). Here J = L U U^T L^T, with L L^T that of the model's own body in its
principal axes, and U made of the log-Cholesky coordinates of Rucker and Wensing (2022, doi:10.1109/LRA.2022.3144517).
All ten are dimensionless, and 0 for the model's own body:

| `body/link/inertial[i]` | what it is |
|---|---|
| 0 | the logarithm of an overall scale: the mass is exp(2 x) times its own |
| 1, 2, 3 | logarithms of stretches along the principal axes |
| 4, 5, 6 | shears: of the first axis by the second, of the second by the third, of the first by the third |
| 7, 8, 9 | how far the centre moves along the principal axes, in root mean square distances of the mass from it |
"""

import dataclasses
import re
from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from jaxlfi.envs.mujoco.parameters import INERTIAL, Parameter, near

COUNT = 10
NAME = re.compile(r"body/(?P<body>[^*?]+)/inertial(?:\[(?P<index>\d+)\])?")
_SHEARS = ((0, 1), (1, 2), (0, 2))


def parameters(
    name: str, spread: float, feasible: tuple[float, float] | None = None, only: Sequence[int] = range(COUNT)
) -> list[Parameter]:
    """The parameters of a body's whole inertia.

    Args:
        name: "body/NAME/inertial".
        spread: half-width of the first guess about the model's own body.
        feasible: bounds in Phi; by default those of the first guess.
        only: indices of those of the ten that are parameters.

    Raises:
        ValueError: for another name or spread, in one line.

    Example:
        >>> [one.name for one in parameters("body/link/inertial", 0.2, only=[0, 9])]
        ['body/link/inertial[0]', 'body/link/inertial[9]']
    """
    if not NAME.fullmatch(name) or name.endswith("]"):
        raise ValueError(f"parameters: {name!r}: spread: expected for body/NAME/inertial only")
    if not 0 < spread < np.inf:
        raise ValueError(f"parameters: {name!r}: spread: expected a number above 0, got {spread!r}")
    return [Parameter(f"{name}[{i}]", (-spread, spread), feasible) for i in only]


@dataclasses.dataclass(frozen=True, eq=False)
class Inertial:
    """A function that gives a body of a model's specification another inertia.

    Attributes:
        body: its name.
        mass: its own, in kg.
        ipos: its own centre, in m.
        rotation: from its own principal axes to its frame.
        moments: second moments of its mass along these axes, in kg m^2, shape [3].
    """

    body: str
    mass: float
    ipos: Float[np.ndarray, " 3"]
    rotation: Float[np.ndarray, "3 3"]
    moments: Float[np.ndarray, " 3"]

    def __call__(self, coordinates: Float[np.ndarray, " 10"]) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        """Mass, centre, principal moments of inertia, and the quaternion of the principal axes."""
        scale, stretches, shears, shift = np.split(np.asarray(coordinates, float), [1, 4, 7])
        upper = np.diag(np.exp(stretches))
        for place, shear in zip(_SHEARS, shears, strict=True):
            upper[place] = shear
        factor = np.exp(2 * scale[0])
        root = np.sqrt(self.moments)[:, None] * upper
        sizes, axes = np.linalg.eigh(factor * root @ root.T)
        sizes = np.maximum(sizes, 0.0)
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, (self.rotation @ axes).ravel())
        centre = self.ipos + self.rotation @ (np.sqrt(self.moments / self.mass) * shift)
        return factor * self.mass, centre, sizes.sum() - sizes, quaternion

    def apply(self, spec: mujoco.MjSpec, coordinates: Float[np.ndarray, " 10"]) -> None:
        """Set the inertia; at 0 the body stays as it is."""
        if not np.any(coordinates):
            return
        target = spec.body(self.body)
        target.mass, target.ipos, target.inertia, target.iquat = self(coordinates)
        target.explicitinertial, target.fullinertia = True, np.full((6, 1), np.nan)


def inertial(model: mujoco.MjModel, body: str, name: str) -> Inertial:
    """The function that changes a body's inertia.

    Args:
        model: as compiled, unchanged.
        body: its name.
        name: of a parameter, for messages.

    Raises:
        ValueError: for a body that does not exist, has no mass, or has no extent, in one line.
    """
    names = [model.body(i).name for i in range(1, model.nbody)]
    if body not in names:
        raise ValueError(f"parameters: {name!r}: expected a body {near(body, names)}, got {body!r}")
    own = {key: np.array(getattr(model.body(body), key)) for key in INERTIAL}
    moments = 0.5 * own["inertia"].sum() - own["inertia"]
    if own["mass"][0] <= 0 or np.sum(moments > 0) < 2:
        raise ValueError(f"parameters: {name!r}: expected a body with a mass that extends in space, got {body}")
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, own["iquat"])
    return Inertial(body, float(own["mass"][0]), own["ipos"], rotation.reshape(3, 3), np.maximum(moments, 0.0))


def component(name: str) -> tuple[str, int] | None:
    """The body and the index of an inertia parameter; None for other parameters.

    Raises:
        ValueError: for no index, and one beyond the ten, in one line.
    """
    match = NAME.fullmatch(name)
    if match is None:
        return None
    if match["index"] is None or int(match["index"]) >= COUNT:
        raise ValueError(f"parameters: {name!r}: expected {name.partition('[')[0]}[0] to [{COUNT - 1}], or a spread")
    return match["body"], int(match["index"])
