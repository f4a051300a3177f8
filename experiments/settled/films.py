"""Animations of the best and of the median policy on each object, side by side, until the scene has settled."""

import functools
from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from experiments.settled import training
from experiments.settled.domains import BROAD, OBJECTS, truths
from experiments.settled.report import PRIMARY, kilopascals
from jaxlfi.envs.whip.aftermath import retreat
from jaxlfi.envs.whip.figures import save_gif
from jaxlfi.envs.whip.parameters import WhipParameters
from jaxlfi.envs.whip.physics import engine as physics
from jaxlfi.envs.whip.physics.engine import State
from jaxlfi.envs.whip.physics.engines import pick
from jaxlfi.envs.whip.physics.scene import Scene
from jaxlfi.envs.whip.render import PALETTE, SLOWNESS, film
from jaxlfi.envs.whip.rig import CONTROL_INTERVAL
from jaxlfi.envs.whip.settling import asleep
from jaxlfi.envs.whip.vision.camera import side_camera
from jaxlfi.envs.whip.vision.raster import segmentation
from jaxlfi.figures import style
from jaxlfi.rl.evaluation import acting, layers_of
from jaxlfi.rl.policy import Policy

ARMS = ("oracle", "posterior", "guess", "wide")
"""Arms whose policies are shown; those that see a history act in another environment."""
PLACE = 0
"""Index of the place of stack and camera, the same for all policies and chosen before any result was seen."""
PIECES, SIZE, COLUMNS = 4, 120, 4
"""Number of frames per control interval, side of a picture in pixels, and number of pictures in a row."""


def shown(episodes: Mapping[str, np.ndarray]) -> dict[str, list[tuple[str, int]]]:
    """Arm and seed of the best and of the median policy on each object, by the rate of the top cube alone.

    The settled return breaks ties; for an even number of policies, the median is the lower one.
    """
    found: dict[str, list[tuple[str, int]]] = {"best": [], "median": []}
    for name in OBJECTS:
        fared = []
        for arm in (arm for arm in ARMS if f"{arm}/{name}/{PRIMARY}" in episodes):
            rates, values = (episodes[f"{arm}/{name}/{what}"].mean(axis=1) for what in (PRIMARY, "value"))
            fared += [(rate, value, arm, seed) for seed, (rate, value) in enumerate(zip(rates, values, strict=True))]
        ranked = sorted(fared, reverse=True)
        found["best"].append(ranked[0][2:])
        found["median"].append(ranked[len(ranked) // 2][2:])
    return found


@functools.cache
def _episode():
    """The compiled function from a policy's layers and an object to the scene, its states, and whether it is over."""
    environment = training.environment()
    key = jax.random.split(training.places(), training.PLACES)[PLACE]

    def play(layers, theta):
        first, act = environment.reset(key, theta), acting(layers)

        def step(state, _):
            state = environment.step(state, act(state.observation))
            return state, (state.inner.episode.state, state.terminated | state.truncated)

        _, (states, over) = jax.lax.scan(step, first, length=environment.steps)
        prepend = lambda one, rest: jnp.concatenate([one[None], rest])
        return first.inner.parameters, jax.tree.map(prepend, first.inner.episode.state, states), over

    return jax.jit(play)


@jax.jit
def _afterwards(parameters: WhipParameters, state: State) -> State:
    """States of the scene from the end of an episode until it has settled, as for outcomes."""
    engine = training.environment().whip.engine
    step = lambda state, action: asleep(physics.act(engine, parameters, state, action))
    return physics.scan_states(step, state, retreat(state.target))


@jax.jit
def _labels(parameters: WhipParameters, states: State) -> Int[Array, "frames size size"]:
    finer = pick("auto", Scene(control_interval=CONTROL_INTERVAL / PIECES))
    camera = side_camera(parameters)
    draw = lambda frame: segmentation(camera, frame, parameters.cube_side, size=SIZE).astype(jnp.uint8)
    return jax.lax.map(draw, film(finer, parameters, states, PIECES), batch_size=8)


def play(policy: Policy, theta: Float[np.ndarray, "2"]) -> tuple[Int[np.ndarray, "frames size size"], int]:
    """An episode of a policy on an object (mm, Pa), until the scene has settled.

    Returns:
        Labels of all frames, where short episodes rest at the end so that all have equally many; and the index of the
        frame in which the episode ends.
    """
    parameters, states, over = jax.device_get(_episode()(layers_of(policy), jnp.asarray(theta, jnp.float32)))
    end = int(np.argmax(over)) + 1 if over.any() else len(over)
    until = jax.tree.map(lambda leaf: leaf[: end + 1], states)
    then = jax.device_get(_afterwards(parameters, jax.tree.map(lambda leaf: leaf[-1], until)))
    rest = len(over) - end
    whole = jax.tree.map(lambda one, two: np.concatenate([one, two[1:], *[two[-1:]] * rest]), until, then)
    return np.asarray(_labels(parameters, whole)), end * PIECES


def write(out: Path, episodes: Mapping[str, np.ndarray], trainings: Path) -> list[Path]:
    """Write best.gif and median.gif.

    Args:
        out: folder of the study.
        episodes: arrays as in `training.Played`.
        trainings: folder of the trainings of all arms.
    """
    written = []
    for title, chosen in shown(episodes).items():
        played, captions = [], []
        for name, (arm, seed), theta in zip(OBJECTS, chosen, truths(), strict=True):
            domain = arm if arm in BROAD else f"{arm}-{name}"
            played.append(play(training.policies(trainings, domain)[seed], theta))
            rate = episodes[f"{arm}/{name}/{PRIMARY}"][seed].mean()
            captions.append(f"{theta[0]:.0f} mm, {kilopascals(theta[1])} kPa\n{arm}, seed {seed}: {rate:.2f}")
        written.append(_draw(out / f"{title}.gif", played, captions))
    return written


def _draw(path: Path, played: list[tuple[np.ndarray, int]], captions: list[str]) -> Path:
    rows = -(-len(played) // COLUMNS)
    with style.context():
        figure = style.new_figure(COLUMNS * (SIZE + 10) / 100, rows * (SIZE + 32) / 100)
        panels = figure.subplots(rows, COLUMNS).ravel()
        images = []
        for axes, (labels, _), caption in zip(panels, played, captions, strict=True):
            images.append(axes.imshow(PALETTE[labels[0]], interpolation="nearest"))
            axes.set(xticks=[], yticks=[])
            axes.set_title(caption, fontsize=5.5)

        def show(t: int) -> None:
            for axes, image, (labels, end) in zip(panels, images, played, strict=True):
                image.set_data(PALETTE[labels[t]])
                for spine in axes.spines.values():
                    spine.set_color("C1" if t > end else "black")  # the episode is over, and the scene settles

        return save_gif(path, figure, len(played[0][0]), show, SLOWNESS * CONTROL_INTERVAL / PIECES)
