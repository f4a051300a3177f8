"""All measurements of the chains, as named arrays."""

import jax.numpy as jnp
import numpy as np

from experiments.whip_physics import beam, energy, models, rollouts, statics
from jaxlfi.envs.whip.parameters import MEDIAN, WhipParameters, median
from jaxlfi.envs.whip.physics.chain import SECOND_MOMENT, Chain
from jaxlfi.envs.whip.physics.engine import Engine
from jaxlfi.envs.whip.physics.scene import Scene
from jaxlfi.envs.whip.reference_objects.elastica import heavy_elastica
from jaxlfi.envs.whip.rig import GRAVITY, SECTION

ELEMENTS = (8, 10, 12, 16, 24)
"""Numbers of elements N."""
DEFAULT = Chain().elements
NUMBERS = (0.5, 5.8, 24.5, 100.0, 400.0, 1113.0, 4486.0)
"""Elasto-gravity numbers: a rod, ..., the median DLO, ..., the limpest of the initial support, the limpest of Phi."""
SMALL = 1e-3
"""Small load at the tip, in units of E I / L^2."""
ARC = np.linspace(0, 1, 201)
"""Arc lengths at which shapes of beams are saved, in lengths of the beam."""
TIMESTEPS = (4e-3, 2e-3, 1e-3, 5e-4, 2.5e-4)
"""Time steps of the physics, in s."""
SWINGS = ((0.05, 5e5), (0.25, 2.5e4), (0.305, 1e3), (0.35, 5e5), (0.35, 5e2))
"""Length (m) and modulus (Pa) of swinging DLOs: corners of Phi, the limpest of the initial support, the median."""
AIR = (0.0, Scene().air)
"""Densities of air, in kg/m^3."""
CUBES = {"median": {}, "small": {"cube_side": 0.020, "cube_density": 80.0}, "large": {"cube_side": 0.030}}
"""Stacks at rest, by their differences from the median scene."""


def against_theory(parameters: WhipParameters = MEDIAN) -> dict[str, np.ndarray]:
    """Relative errors of every kind of chain, shape [kinds, N], and of frequencies [kinds, N, 2].

    References are P L^3 / (3 E I) for the tip's deflection, the Euler-Bernoulli beam for frequencies (for `rotary`, one
    with rotary inertia), and the declared values for mass and length.
    """
    rigidity = parameters.young * SECOND_MOMENT
    line_density = parameters.density * SECTION**2
    load = SMALL * rigidity / parameters.length**2
    deflection = beam.tip_deflection(load, parameters.length, rigidity)
    beams = [
        np.array([beam.frequency(mode, parameters.length, rigidity, line_density, gyration) for mode in (1, 2)])
        for gyration in (0.0, SECTION / 12**0.5)
    ]
    errors = {name: [] for name in ("tip", "frequency", "rotary", "mass", "length")}
    for kind in models.KINDS:
        for elements in ELEMENTS:
            model = models.model(kind, elements, parameters)
            slowest = statics.frequencies(model)[:2]
            line = statics.nodes(model, statics.bent(model, np.zeros(model.nv)))
            errors["tip"].append(statics.tip_deflection(model, load) / deflection - 1)
            errors["frequency"].append(slowest / beams[0] - 1)
            errors["rotary"].append(slowest / beams[1] - 1)
            errors["mass"].append(statics.mass(model) / (line_density * parameters.length) - 1)
            errors["length"].append(np.linalg.norm(np.diff(line, axis=0), axis=1).sum() / parameters.length - 1)
    grid = (len(models.KINDS), len(ELEMENTS))
    return {name: np.reshape(values, (*grid, *np.shape(values)[1:])) for name, values in errors.items()}


def sags(parameters: WhipParameters = MEDIAN) -> dict[str, np.ndarray]:
    """Chains and beams held horizontally, over elasto-gravity numbers, in lengths of the DLO.

    Returns:
        Distances of points from the clamp and below it: `elastica`, shape [numbers, 201, 2]; `sag N`, nodes of the
        chain of N elements with hinges, shape [numbers, N + 2, 2]; `balls` and `plain`, nodes of the chain with ball
        joints and of MuJoCo's cable, with 12 elements.
    """

    def shapes(kind, elements):
        made = [models.model(kind, elements, models.with_number(parameters, number)) for number in NUMBERS]
        return np.stack([statics.sagged(model, GRAVITY) for model in made]) / parameters.length

    return {
        "elastica": np.stack([heavy_elastica(number, ARC) for number in NUMBERS]),
        **{f"sag {elements}": shapes("planar hinges", elements) for elements in ELEMENTS},
        "plain": shapes("plain cable", DEFAULT),
        "balls": shapes("ball joints", DEFAULT),
    }


def energies(kind: str = "planar hinges") -> dict[str, np.ndarray]:
    """Energy of chains of 12 elements that swing for 2 s, as fractions of their initial value.

    Returns:
        For damped chains without and with air, over `SWINGS` and `TIMESTEPS`, shape [2, swings, timesteps]: the
        `highest` energy after the first step, the `greatest_rise` in a step and the energy at the `end`. For the median
        chain without damping and air: the greatest change, `drift`, with time steps from 1 ms down, by Euler's and by
        the Runge-Kutta method, shape [2, timesteps - 2].
    """
    highest, rise, end = np.empty((3, 2, len(SWINGS), len(TIMESTEPS)))
    for air, density in enumerate(AIR):
        for dlo, (length, young) in enumerate(SWINGS):
            for step, timestep in enumerate(TIMESTEPS):
                model = models.model(kind, DEFAULT, MEDIAN.replace(length=length, young=young))
                model.opt.density = density
                curve = energy.swing(model, timestep)
                at = (air, dlo, step)
                highest[at], rise[at], end[at] = curve[1:].max(), np.diff(curve).max(), curve[-1]
    drift = np.empty((2, len(TIMESTEPS) - 2))
    for method in (0, 1):
        for step, timestep in enumerate(TIMESTEPS[2:]):
            model = models.model(kind, DEFAULT, MEDIAN)
            model.dof_damping[:] = 0
            drift[method, step] = np.abs(energy.swing(model, timestep, runge_kutta=bool(method)) - 1).max()
    return {"highest": highest, "greatest_rise": rise, "end": end, "drift": drift}


def scenes(engine: Engine, count: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Random episodes (`rollouts.random_episodes`) and stacks at rest for 5 s (`stack NAME`, shape [3])."""
    rest = {}
    for name, changes in CUBES.items():
        parameters = median().replace(**{name: jnp.float32(value) for name, value in changes.items()})
        rest[f"stack {name}"] = np.array(list(rollouts.stack_at_rest(engine, parameters).values()))
    return rest | rollouts.random_episodes(engine, seed, count)
