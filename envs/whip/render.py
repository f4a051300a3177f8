"""Pictures of rollouts, drawn from segmentation images by ray casting: no graphics driver is needed."""

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
from jaxlfi.envs.whip.parameters import MILLIMETRES, WhipParameters, median
from jaxlfi.envs.whip.physics import engine as physics
from jaxlfi.envs.whip.physics.engine import Engine, State
from jaxlfi.envs.whip.physics.engines import pick
from jaxlfi.envs.whip.physics.kinematics import frames
from jaxlfi.envs.whip.rig import RGBA
from jaxlfi.envs.whip.trajectory import seen
from jaxlfi.envs.whip.vision.camera import Camera, project, side_camera
from jaxlfi.envs.whip.vision.keypoints import KEYPOINTS, ON_DLO
from jaxlfi.envs.whip.vision.raster import segmentation
from jaxlfi.runs.run import Run

BACKGROUND = (1.0, 1.0, 1.0)
PALETTE = np.array([BACKGROUND, *(RGBA[name][:3] for name in (*COLOURS, "dlo"))], np.float32)
"""Colours of the labels of `raster.segmentation`, shape [8, 3]."""
SIZE = 320
"""Side of the images, in pixels."""
PIECES = 8
"""Number of frames of an animation per control interval, 20 ms each."""
SLOWNESS = 2.0
"""How many times slower than real time an animation is."""


class Rollout(struct.PyTreeNode):
    """One rollout of given actions, which continues after the end of the episode.

    Attributes:
        parameters: parameters of the scene.
        actions: displacements of the set-point, in m, shape [16, 2].
        observations: observations before each action and after the last, shape [17, 28].
        steps: the step of each action, stacked.
        states: states of the physics before each action and after the last, stacked.
        length: number of steps of the episode.
        value: return of the episode, the sum of its rewards.
    """

    parameters: WhipParameters
    actions: Float[Array, "16 2"]
    observations: Float[Array, "17 28"]
    steps: Step
    states: State
    length: Int[Array, ""]
    value: Float[Array, ""]


def perform(key: jax.Array, whip: Whip, parameters: WhipParameters, actions: Float[Array, "16 2"]) -> Rollout:
    """Roll out all actions, even after the end of the episode.

    Args:
        key: key of the detector's errors.
        whip: the task.
        parameters: parameters of the scene.
        actions: displacements of the set-point, in m.
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


def film(engine: Engine, parameters: WhipParameters, states: State, pieces: int) -> Frames:
    """Frames of a motion, at its control steps and in between.

    Every control interval is simulated again in pieces, from its first state. The frames therefore agree with the
    states to rounding; a simulation of all pieces from the start would not, after contacts.

    Args:
        engine: the physics, whose control interval is that of the motion divided by `pieces`.
        parameters: parameters of the scene.
        states: states at T + 1 control steps, stacked.
        pieces: number of pieces K per control interval.

    Returns:
        T K + 1 frames.
    """

    def interval(state: State, after: State):
        fraction = (jnp.arange(1, pieces) / pieces)[:, None]
        targets = state.target + fraction * (after.target - state.target)
        return physics.scan_states(functools.partial(engine.advance, parameters), state, targets).qpos

    before, after = jax.tree.map(lambda leaf: leaf[:-1], states), jax.tree.map(lambda leaf: leaf[1:], states)
    qpos = jax.vmap(interval)(before, after)
    qpos = jnp.concatenate([qpos.reshape(-1, qpos.shape[-1]), states.qpos[-1:]])
    return jax.vmap(lambda qpos: frames(engine.scene, parameters, qpos))(qpos)


def lines(camera: Camera) -> dict[str, Float[Array, "points 2"]]:
    """Lines of the table and the gripper's workspace in the plane of motion, as seen, in normalised pixels."""
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
    camera = side_camera(rollout.parameters)
    shot = film(engine, rollout.parameters, rollout.states, PIECES)
    draw = lambda frame: segmentation(camera, frame, rollout.parameters.cube_side, size=SIZE).astype(jnp.uint8)
    return jax.lax.map(draw, shot, batch_size=8), project(camera, _in_plane(shot.gripper)), lines(camera)


def save_pictures(folder: Path, engine: Engine, rollout: Rollout, title: Sequence[str]) -> list[Path]:
    """Draw a sheet of the 17 frames at control steps and an animation, with the detected keypoints.

    Keypoints fade between control steps, where nothing is detected.

    Args:
        folder: folder for sheet.png and film.gif.
        engine: the physics, whose control interval is that of the rollout divided by `PIECES`.
        rollout: the rollout to draw.
        title: lines of the title.

    Returns:
        The files that were written.
    """
    from jaxlfi.envs.whip import figures

    labels, places, still = jax.device_get(_shoot(engine, rollout))
    at = np.arange(len(labels))
    step = at // PIECES
    keypoints, seen = keypoints_of(rollout.observations)[step], _seen(rollout)[step]
    film = figures.Film(
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
        figures.save_sheet(folder / "sheet.png", film.every(PIECES), ": ".join(title)),
        figures.save_animation(folder / "film.gif", film, "\n".join(title), interval, 0.6 ** (at % PIECES)),
    ]


def save_predictive(path: Path, run: Run) -> Path:
    """Draw keypoints of simulations of a posterior over the observed ones (`figures.draw_predictive`).

    Args:
        path: the .png file.
        run: a run of `real2sim.task`; of several rollouts, the first is shown. The scene is that of mu, seen by the
            side camera.
    """
    from jaxlfi.envs.whip import figures

    steps = rules.STEPS
    observed, simulated = np.asarray(run.observed), np.asarray(run.history["final_trajectory"])
    simulated = simulated[np.isfinite(run.history["sample_trajectory_error"][-1])]
    engine, parameters = pick(), median(*np.median(np.asarray(run.draws()), axis=0) / MILLIMETRES)
    view, _ = seen(engine, parameters, jnp.asarray(observed[: steps - 1, -2:], jnp.float32))
    camera = side_camera(parameters)
    draw = lambda frame: segmentation(camera, frame, parameters.cube_side, size=SIZE).astype(jnp.uint8)
    shown = figures.Predictive(
        observed=keypoints_of(jnp.asarray(observed[:steps])),
        simulated=np.stack([keypoints_of(jnp.asarray(one[:steps])) for one in simulated]),
        labels=np.asarray(jax.lax.map(draw, view, batch_size=8)),
        gripper=np.asarray(project(camera, _in_plane(view.gripper))),
        palette=PALETTE,
        times=engine.scene.control_interval * np.arange(steps),
        lines=jax.device_get(lines(camera)),
    )
    return figures.save_predictive(path, shown)


def _captions(interval: float, rollout: Rollout, at: np.ndarray) -> list[str]:
    """The time of each frame, and the last reward if it is not zero and the episode is not over."""
    rewards = np.concatenate([[0.0], rollout.steps.reward])
    texts = [f"r = {reward:.2f}" if reward else "" for reward in rewards]
    texts = [text if t <= rollout.length else "over" for t, text in enumerate(texts)]
    return [f"{i * interval:.2f} s   {texts[i // PIECES]}".strip() for i in at]


def keypoints_of(observations: Float[Array, "time 28"]) -> np.ndarray:
    """The keypoints in observations, in normalised pixels, shape [T, 10, 2]."""
    return np.asarray(observations[:, 2 : 2 + 2 * KEYPOINTS]).reshape(-1, KEYPOINTS, 2)


def _seen(rollout: Rollout) -> np.ndarray:
    """Keypoints that were seen, shape [17, 10]: in the first frame, all are."""
    return np.concatenate([np.ones((1, KEYPOINTS), bool), rollout.steps.seen])


def arrays(engine: Engine, rollout: Rollout) -> dict[str, np.ndarray]:
    """A rollout as named arrays, for rollout.npz.

    Before each action and after the last: `times` [17], `gripper` [17, 2], `keypoints` [17, 10, 2], `seen` [17, 10] and
    `hits` [17, 6] as in a recording (`recording`), and `frames/...` [17, ...] in m. For each of the `actions` [16, 2]:
    `rewards`, `outside` and `failed` [16] after it. `parameters/...` in SI units; `length` in steps and `return` of the
    episode.
    """
    see = jax.jit(jax.vmap(lambda qpos: frames(engine.scene, rollout.parameters, qpos)))
    named = {
        "times": engine.scene.control_interval * np.arange(rules.STEPS + 1),
        "gripper": rollout.observations[:, :2],
        "keypoints": keypoints_of(rollout.observations),
        "seen": _seen(rollout),
        "hits": np.concatenate([np.zeros((1, 6), bool), rollout.steps.hit]),
        "actions": rollout.actions,
        "rewards": rollout.steps.reward,
        "outside": rollout.steps.outside,
        "failed": rollout.steps.failed,
        "length": rollout.length,
        "return": rollout.value,
    }
    for prefix, tree in (("frames", see(rollout.states.qpos)), ("parameters", rollout.parameters)):
        named |= {f"{prefix}/{name}": value for name, value in vars(tree).items()}
    return {name: np.asarray(value) for name, value in named.items()}
