"""MuJoCo models whose motor plays chirps: a Furuta pendulum, and a cart pulled by an elastic belt."""

import functools
import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from experiments.design import tempered
from jaxlfi.envs.mujoco.logs import Log
from jaxlfi.envs.mujoco.model_task import mujoco_task
from jaxlfi.envs.mujoco.parameters import Parameter
from jaxlfi.tasks.design import Design
from jaxlfi.tasks.experiments import single
from jaxlfi.tasks.task import Task

EXAMPLES = Path(__file__).parents[2] / "examples/mujoco"
DURATION, INTERVAL = 2.0, 0.02
"""Duration of a recording, and time between its samples, in s."""
STEP = 0.01
"""Time step of the models, in s."""
SAFE_FOR = 8
"""Number of posterior draws that an expert's or a random experiment must be safe for."""
STRENGTHS = (1.0, 0.8, 0.6, 0.4, 0.2, 0.1)
"""Fractions of the largest amplitude that an expert tries in turn."""


BELT = """
<mujoco model="belt">
  <!-- A motor's pulley, as a mass on a rail, pulls a cart by an elastic belt. -->
  <option integrator="implicitfast"/>
  <worldbody>
    <body name="pulley">
      <joint name="pulley" type="slide" axis="1 0 0" damping="2.0"/>
      <geom type="box" size="0.02 0.02 0.02" mass="0.4" contype="0" conaffinity="0"/>
    </body>
    <body name="cart" pos="0 0.1 0">
      <joint name="cart" type="slide" axis="1 0 0" frictionloss="0.3"/>
      <geom type="box" size="0.04 0.03 0.02" mass="1.0" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <tendon>
    <fixed name="belt" stiffness="1000" damping="3" springlength="0">
      <joint joint="cart" coef="1"/>
      <joint joint="pulley" coef="-1"/>
    </fixed>
  </tendon>
  <actuator>
    <motor name="motor" joint="pulley" ctrllimited="true" ctrlrange="-10 10"/>
  </actuator>
  <sensor>
    <jointpos name="place" joint="cart"/>
  </sensor>
</mujoco>
"""


def furuta(step: float = STEP, duration: float = DURATION) -> Task:
    """The example's pendulum, with its noise and truth; the pendulum may be released at an angle up to 1 rad."""
    spec = mujoco.MjSpec.from_file(str(EXAMPLES / "furuta.xml"))
    parameters = [
        Parameter("joint/pendulum/damping", (2e-5, 2e-2), unit="N m s/rad", log=True, truth=3e-4),
        Parameter("joint/arm/frictionloss", (0.0, 0.03), unit="N m", truth=0.006),
        Parameter("body/arm/mass", (0.01, 0.5), unit="kg", log=True, truth=0.09),
    ]
    table = {
        "controls": {"motor": {"kind": "chirp", "amplitude": [0.0, 0.06], "frequency": [0.2, 3.0]}},
        "initial": {"pendulum/qpos": [-1.0, 1.0]},
        "limits": {"arm angle": [-2.0, 2.0]},
    }
    return _task(spec, parameters, {"arm angle": 0.002, "pendulum angle": 0.002}, table, step, duration)


def belt() -> Task:
    """A cart whose position is measured to half a millimetre, and must not leave its rail."""
    parameters = [
        Parameter("tendon/belt/stiffness", (200.0, 3000.0), unit="N/m", log=True, truth=1000.0),
        Parameter("tendon/belt/damping", (0.3, 30.0), unit="N s/m", log=True, truth=3.0),
        Parameter("body/cart/mass", (0.3, 3.0), unit="kg", log=True, truth=1.0),
        Parameter("joint/cart/frictionloss", (0.0, 1.5), unit="N", truth=0.3),
    ]
    table = {
        "controls": {"motor": {"kind": "chirp", "amplitude": [0.0, 10.0], "frequency": [0.5, 15.0]}},
        "limits": {"place": [-0.5, 0.5]},
    }
    return _task(mujoco.MjSpec.from_string(BELT), parameters, {"place": 0.0005}, table)


def belt_response(theta: Float[Array, "4"], design: Float[Array, "3"]) -> Float[Array, " time"]:
    """The cart's position by MuJoCo's own steps, in JAX: hundreds of times faster for thousands of particles.

    The constants are MuJoCo's default `solref` and `solimp` for dry friction: a damper up to the friction's limit. The
    integrator `implicitfast` treats dampers implicitly, but not their coupling of two bodies.
    """
    stiffness, damping, mass, friction = theta
    amplitude, first, last = design
    times = INTERVAL * jnp.arange(round(DURATION / INTERVAL))
    turns = first * times + 0.5 * (last - first) * times**2 / DURATION
    impedance, rate = 0.9, 2 / (0.95 * 0.02)
    softness = (1 - impedance) / impedance / mass

    def advance(state, force):
        pulley, pulley_speed, cart, cart_speed = state
        pull = stiffness * (pulley - cart) + damping * (pulley_speed - cart_speed)
        rub = jnp.clip(-(pull / mass + rate * cart_speed) / (softness + 1 / mass), -friction, friction)
        pulley_speed += STEP * (force - 2.0 * pulley_speed - pull) / (0.4 + STEP * (2.0 + damping))
        cart_speed += STEP * (pull + rub) / (mass + STEP * damping)
        return pulley + STEP * pulley_speed, pulley_speed, cart + STEP * cart_speed, cart_speed

    def sample(state, force):
        for _ in range(round(INTERVAL / STEP)):
            state = advance(state, force)
        return state, state[2]

    _, places = jax.lax.scan(sample, (0.0,) * 4, amplitude * jnp.sin(2 * jnp.pi * turns))
    return jnp.concatenate([jnp.zeros(1), places])


@functools.lru_cache
def belt_in_jax() -> Task:
    """The belt's task with `belt_response` in MuJoCo's place; one signal, so that trajectories have the shape [T]."""
    task = belt()
    (noise,) = task.design.noise
    variables = dict(zip(task.design.names, zip(task.design.low, task.design.high, strict=True), strict=True))

    def simulate(key, theta, design):
        clean = belt_response(theta, design)
        return clean + noise * jax.random.normal(key, clean.shape)

    return Task(
        simulate,
        task.names,
        {"guess": task.feasible},
        task.feasible,
        log=[name for name, log in zip(task.names, task.space.log, strict=True) if log],
        name="belt in JAX",
        design=Design(variables, response=belt_response, noise=noise),
    )


def belt_posterior(
    rng: np.random.Generator,
    task: Task,
    recorded: np.ndarray,
    designs: np.ndarray,
    before: np.ndarray | None = None,
) -> np.ndarray:
    """Draws [N, D] in inference space of a belt's recordings [E, T, 1]; see `tempered.posterior`.

    If the cart sticks and slips, the likelihood has kinks and local maxima, about which normals are too narrow.
    """
    del task
    return tempered.posterior(rng, belt_in_jax(), recorded[:, :, 0], designs, before)


def _task(
    spec: mujoco.MjSpec,
    parameters: list[Parameter],
    noise: dict[str, float],
    table: dict[str, Any],
    step: float = STEP,
    duration: float = DURATION,
) -> Task:
    """The task of one experiment with a model."""
    spec.option.timestep = step
    times = INTERVAL * np.arange(round(duration / INTERVAL) + 1)
    rest = Log(times, {name: np.zeros(len(times)) for name in ("motor", *noise)})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # nothing has been recorded yet
        return single(mujoco_task(spec, parameters, rest, list(noise), noise, design=table, name=spec.modelname))


def experts_and_random(
    rng: np.random.Generator, task: Task, draws: np.ndarray, experiments: int = 3
) -> list[tuple[str, np.ndarray]]:
    """Three chirps of an expert, and three random ones.

    The expert plays the whole range of frequencies, its lower half and its upper half, each from rest and as strong as
    is safe. Random experiments are uniform among safe designs. A design is safe if it keeps within the limits for some
    draws of the posterior.
    """
    natural = np.asarray(task.space.to_natural(draws[:SAFE_FOR]), float)

    def fine(design: np.ndarray) -> bool:
        rows = task.design.response(natural, design)
        return bool(np.isfinite(rows).all()) and (task.design.safe is None or all(map(task.design.safe, rows)))

    names = list(task.design.names)
    least, most = (dict(zip(names, map(float, bounds), strict=True)) for bounds in (task.design.low, task.design.high))
    slow, fast = least["motor frequency first"], most["motor frequency first"]
    middle = np.sqrt(slow * fast)
    expert = []
    for first, last in ((slow, fast), (slow, middle), (middle, fast)):
        for strength in STRENGTHS:
            amplitude = strength * most["motor amplitude"]
            own = {"motor amplitude": amplitude, "motor frequency first": first, "motor frequency last": last}
            design = np.array([own.get(name, 0.0) for name in names])
            if fine(design):
                break
        expert.append(design)
    found: list[np.ndarray] = []
    while len(found) < experiments:
        design = task.design.of_unit(rng.random(len(names)))
        if fine(design):
            found.append(design)
    return [("expert", np.stack(expert)), ("at random", np.stack(found))]
