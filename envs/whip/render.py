"""Pictures of rollouts, drawn from our own segmentation images: no graphics driver is needed."""

import functools
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from jaxlfi.envs.whip import rules
from jaxlfi.envs.whip.episode import Step, Whip
from jaxlfi.envs.whip.frames import COLOURS, Frames
from jaxlfi.envs.whip.parameters import WhipParameters
from jaxlfi.envs.whip.physics.engine import Engine, State
from jaxlfi.envs.whip.physics.kinematics import frames
from jaxlfi.envs.whip.physics.scene import RGBA
from jaxlfi.envs.whip.vision.camera import Camera, project, side_camera
from jaxlfi.envs.whip.vision.keypoints import KEYPOINTS, ON_DLO
from jaxlfi.envs.whip.vision.raster import segmentation

BACKGROUND = (1.0, 1.0, 1.0)
PALETTE = np.array([BACKGROUND, *(RGBA[name][:3] for name in (*COLOURS, "dlo"))], np.float32)
"""Colours of the labels of `raster.segmentation`, shape [8, 3]."""
SIZE = 320
"""Of the images, in pixels."""
PIECES = 8
"""Frames of an animation in a control interval, 20 ms each."""
SLOWNESS = 2.0
"""How many times slower than life an animation is."""


@struct.dataclass
class Rollout:
    """One rollout of given actions, which goes on after the episode's end.

    Attributes:
        parameters: of the scene.
        actions: displacements of the set-point, in m, shape [16, 2].
        observations: before each action and after the last, shape [17, 28].
        steps: what each action led to, stacked.
        states: of the physics, before each action and after the last, stacked.
        length: steps of the episode.
        value: its return, the sum of its rewards.
    """

    parameters: WhipParameters
    actions: Float[Array, "16 2"]
    observations: Float[Array, "17 28"]
    steps: Step
    states: State
    length: Int[Array, ""]
    value: Float[Array, ""]


def perform(key: jax.Array, whip: Whip, parameters: WhipParameters, actions: Float[Array, "16 2"]) -> Rollout:
    """Roll out actions to their end.

    Args:
        key: of the detector.
        whip: the task.
        parameters: of the scene.
        actions: to apply, in m.
    """
    first, start = whip.reset(jax.random.fold_in(key, 0), parameters)

    def step(episode, at):
        time, action = at
        episode, now = whip.step(jax.random.fold_in(key, time), parameters, episode, action)
        return episode, (episode.state, now)

    _, (states, steps) = jax.lax.scan(step, first, (jnp.arange(rules.STEPS) + 1, actions))
    length = jnp.argmax(steps.terminated | steps.truncated) + 1  # the last step is always truncated
    earned = jnp.where(jnp.arange(rules.STEPS) < length, steps.reward, 0.0)
    prepend = lambda one, rest: jnp.concatenate([one[None], rest])
    return Rollout(
        parameters=parameters,
        actions=actions,
        observations=prepend(start, steps.observation),
        steps=steps,
        states=jax.tree.map(prepend, first.state, states),
        length=length,
        value=jnp.sum(earned),
    )


def film(engine: Engine, rollout: Rollout, pieces: int) -> Frames:
    """What there is to see between control steps too.

    Every control interval is simulated again in pieces, from the state it began with: they are the rollout's own to
    within rounding, which a simulation of all pieces in one go, after contacts, would not be.

    Args:
        engine: whose control interval is that of the rollout over `pieces`.
        rollout: to be filmed.
        pieces: K.

    Returns:
        Frames at 16 K + 1 instants.
    """

    def interval(state: State, after: State):
        share = (jnp.arange(1, pieces) / pieces)[:, None]
        targets = state.target + share * (after.target - state.target)

        def step(state, target):
            state = engine.advance(rollout.parameters, state, target)
            return state, state.qpos

        _, between = jax.lax.scan(step, state, targets)
        return jnp.concatenate([state.qpos[None], between])

    before = jax.tree.map(lambda leaf: leaf[:-1], rollout.states)
    after = jax.tree.map(lambda leaf: leaf[1:], rollout.states)
    qpos = jax.vmap(interval)(before, after)
    qpos = jnp.concatenate([qpos.reshape(-1, qpos.shape[-1]), rollout.states.qpos[-1:]])
    return jax.vmap(lambda qpos: frames(engine.scene, rollout.parameters, qpos))(qpos)


def lines(camera: Camera) -> dict[str, Float[Array, "points 2"]]:
    """The table's line and the gripper's workspace in the plane of motion, as they are seen, in normalised pixels."""
    (x0, z0), (x1, z1) = rules.WORKSPACE
    drawn = {
        "table": [[-2.0, 0.0], [2.0, 0.0]],
        "workspace of the gripper": [[x0, z0], [x1, z0], [x1, z1], [x0, z1], [x0, z0]],
    }
    return {name: project(camera, _in_plane(jnp.array(points))) for name, points in drawn.items()}


def _in_plane(points: Float[Array, "*n 2"]) -> Float[Array, "*n 3"]:
    return jnp.stack([points[..., 0], jnp.zeros_like(points[..., 0]), points[..., 1]], axis=-1)


@functools.partial(jax.jit, static_argnums=0)
def _shoot(engine: Engine, rollout: Rollout):
    """The labels [F, SIZE, SIZE] and the gripper's places [F, 2] in a film, and the lines."""
    camera, shot = side_camera(rollout.parameters), film(engine, rollout, PIECES)
    draw = lambda frame: segmentation(camera, frame, rollout.parameters.cube_side, size=SIZE).astype(jnp.uint8)
    return jax.lax.map(draw, shot, batch_size=8), project(camera, _in_plane(shot.gripper)), lines(camera)


def save_pictures(folder: Path, engine: Engine, rollout: Rollout, title: Sequence[str]) -> list[Path]:
    """Draw a sheet of the 17 instants and an animation, with what the detector saw.

    Keypoints fade between control steps, as nothing is detected there.

    Args:
        folder: for sheet.png and film.gif.
        engine: for the film: its control interval is that of the rollout over `PIECES`.
        rollout: to be drawn.
        title: lines of it.

    Returns:
        What was written.
    """
    from jaxlfi.envs.whip import figures

    labels, places, still = jax.device_get(_shoot(engine, rollout))
    at = np.arange(len(labels))
    step = at // PIECES
    keypoints = np.asarray(rollout.observations[:, 2:22]).reshape(-1, KEYPOINTS, 2)[step]
    seen = np.concatenate([np.ones((1, KEYPOINTS), bool), rollout.steps.seen])[step]
    instants = figures.Instants(
        labels=labels,
        dlo=keypoints[:, :ON_DLO],
        cubes=keypoints[:, ON_DLO:],
        seen=seen[:, :ON_DLO],
        gripper=places,
        captions=_captions(engine.scene.control_interval, rollout, at),
        over=step > int(rollout.length),
        palette=PALETTE,
        lines=still,
    )
    interval = SLOWNESS * engine.scene.control_interval
    return [
        figures.save_sheet(folder / "sheet.png", instants.every(PIECES), ": ".join(title)),
        figures.save_animation(folder / "film.gif", instants, "\n".join(title), interval, 0.6 ** (at % PIECES)),
    ]


def _captions(interval: float, rollout: Rollout, at: np.ndarray) -> list[str]:
    """Time, and what the last step was rewarded with, if with anything before the end of the episode."""
    rewards = np.concatenate([[0.0], rollout.steps.reward])
    told = [f"r = {reward:.2f}" if reward else "" for reward in rewards]
    told = [text if t <= rollout.length else "over" for t, text in enumerate(told)]
    return [f"{i * interval:.2f} s   {told[i // PIECES]}".strip() for i in at]


def arrays(engine: Engine, rollout: Rollout) -> dict[str, np.ndarray]:
    """A rollout as named arrays, for rollout.npz.

    `states` [16, 28] before each `actions` [16, 2]; `rewards`, `outside`, `failed` [16] after it; `hits` [17, 6] and
    `frames/...` [17, ...] before each action and after the last, in m; `parameters/...` in SI units; `length` in steps
    and `return` of the episode.
    """
    see = jax.jit(jax.vmap(lambda qpos: frames(engine.scene, rollout.parameters, qpos)))
    named = {
        "states": rollout.observations[:-1],
        "actions": rollout.actions,
        "rewards": rollout.steps.reward,
        "hits": np.concatenate([np.zeros((1, 6), bool), rollout.steps.hit]),
        "outside": rollout.steps.outside,
        "failed": rollout.steps.failed,
        "length": rollout.length,
        "return": rollout.value,
    }
    for prefix, tree in (("frames", see(rollout.states.qpos)), ("parameters", rollout.parameters)):
        named |= {f"{prefix}/{name}": value for name, value in vars(tree).items()}
    return {name: np.asarray(value) for name, value in named.items()}
