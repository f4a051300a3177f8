"""The whipping task for training policies: sections VI-E to VI-H with the interface of `jaxlfi.rl.environment`."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.envs.whip import rewards, rules
from jaxlfi.envs.whip.episode import Episode, Whip
from jaxlfi.envs.whip.frames import COLOURS
from jaxlfi.envs.whip.observer import FLAGS
from jaxlfi.envs.whip.parameters import (
    FEASIBLE,
    INITIAL,
    MEDIAN,
    MILLIMETRES,
    WhipParameters,
    in_task_units,
    randomised,
)
from jaxlfi.envs.whip.physics.engines import pick
from jaxlfi.envs.whip.rig import CONTROL_INTERVAL, KEYPOINTS, ON_DLO
from jaxlfi.envs.whip.settling import aftermath
from jaxlfi.envs.whip.vision.keypoints import DETECTORS
from jaxlfi.rl.deployment import Deployment, Limits
from jaxlfi.rl.environment import EnvState, Signals
from jaxlfi.rl.history import History

_POINTS = (*(f"DLO {i + 1}" for i in range(ON_DLO)), *COLOURS)
OBSERVATIONS = Signals(
    names=(
        "gripper x",
        "gripper z",
        *(f"{point} {axis}" for point in _POINTS for axis in "uv"),
        *(f"{colour} hit" for colour in COLOURS),
    ),
    units=("m", "m", *["image"] * 20, *[""] * 6),
    centre=(*rules.WORKSPACE.mean(axis=0).tolist(), *[0.5] * 20, *[0.0] * 6),
    scale=(0.1, 0.1, *[0.25] * 20, *[1.0] * 6),
)
"""The gripper within its workspace; keypoints in normalised pixels, which span the image from 0 to 1; flags."""
ACTIONS = Signals(("dx", "dz"), ("m", "m"), (0.0, 0.0), (rules.ACTION_LIMIT, rules.ACTION_LIMIT))
"""Displacements of the gripper's set-point."""
LIMITS = Limits(
    step=(rules.ACTION_LIMIT, rules.ACTION_LIMIT),
    speed=2**0.5 * rules.ACTION_LIMIT / CONTROL_INTERVAL,
    low=rules.WORKSPACE[0].astype(float).round(6),
    high=rules.WORKSPACE[1].astype(float).round(6),
)
"""Limits of the set-point: those of the actions, the speed that these imply, and the workspace."""


BOUNDS = np.array([[-np.inf] * FLAGS + [0.0] * 6, [np.inf] * FLAGS + [1.0] * 6])
"""Lower and upper bounds of observations; the gripper and the keypoints may be anywhere."""


class Scene(struct.PyTreeNode):
    """An episode, its scene, and the key of the steps to come.

    Attributes:
        episode: state of the episode.
        parameters: parameters of its scene.
        key: key of the steps to come; None if each step is given its own.
    """

    episode: Episode
    parameters: WhipParameters
    key: jax.Array | None = None


def begun(whip: Whip, key: jax.Array, parameters: WhipParameters) -> EnvState:
    """The DLO at rest in a scene; its facts are those of `episode.Step`."""
    episode, observation = whip.reset(key, parameters)
    no = jnp.asarray(False)
    facts = {"hit": episode.hit, "outside": no, "failed": no, "seen": jnp.ones(KEYPOINTS, bool)}
    return EnvState(Scene(episode, parameters), observation, jnp.asarray(0.0), no, no, facts)


def stepped(whip: Whip, key: jax.Array, scene: Scene, action: Float[Array, "2"]) -> EnvState:
    """The scene after an action (dx, dz), in m."""
    episode, step = whip.step(key, scene.parameters, scene.episode, action)
    facts = {name: getattr(step, name) for name in ("hit", "outside", "failed", "seen")}
    after = scene.replace(episode=episode)
    return EnvState(after, step.observation, step.reward, step.terminated, step.failed, facts)


@dataclasses.dataclass(frozen=True)
class WhipEnvironment:
    """Episodes in scenes of a given length (mm) and modulus (Pa), with redrawn nuisances, stack and camera.

    Attributes:
        whip: physics and detector.
    """

    whip: Whip
    name: str = "whip"
    space: Space = Space(("length", "young"), log=(False, True))
    units: tuple[str, ...] = ("mm", "Pa")
    nominal: tuple[float, ...] = (MEDIAN.length * MILLIMETRES[0], MEDIAN.young * MILLIMETRES[1])
    observations: Signals = OBSERVATIONS
    actions: Signals = ACTIONS
    steps: int = rules.STEPS
    bounds = BOUNDS

    @property
    def reward(self) -> str:
        """The name of the reward, which trainings and their policies record."""
        return self.whip.reward

    @property
    def supports(self) -> Mapping[str, Support]:
        """Theta_0 of section VI-B, and Phi."""
        return {"initial": in_task_units(INITIAL), "feasible": self.feasible}

    @property
    def deployment(self) -> Deployment:
        """What is needed to control a robot with a policy that was trained here."""
        detector = self.whip.detector
        name = next((name for name, known in DETECTORS.items() if known == detector), "own")
        return Deployment(
            control_interval=CONTROL_INTERVAL,
            steps=rules.STEPS,
            moved=("gripper x", "gripper z"),
            limits=LIMITS,
            detector={"name": name, **{key: np.asarray(x).tolist() for key, x in vars(detector).items()}},
        )

    @property
    def feasible(self) -> Support:
        """Phi."""
        return in_task_units(FEASIBLE)

    def reset(self, key: jax.Array, theta: Float[Array, "2"]) -> EnvState:
        """The DLO at rest in a scene of this length (mm) and modulus (Pa)."""
        key_scene, key_reset, key = jax.random.split(key, 3)
        return _outlined(begun(self.whip, key_reset, randomised(key_scene, *(theta / MILLIMETRES))), key)

    def step(self, state: EnvState, action: Float[Array, "2"]) -> EnvState:
        """Apply an action (dx, dz), in m."""
        key, key_step = jax.random.split(state.inner.key)
        return _outlined(stepped(self.whip, key_step, state.inner, action), key)

    def concluded(self, state: EnvState) -> dict[str, Array | np.ndarray]:
        """What the episode leaves behind once the gripper has retracted and the cubes have come to rest."""
        scene = state.inner
        found = aftermath(self.whip.engine, scene.parameters, scene.episode.state)
        return {"settled_hit": found.hit, "settled_clean": found.clean, "displaced": jnp.sum(found.displaced, axis=-1)}


def with_history(history: int = 6, detector: str = "mask", engine: str = "auto", reward: str = "paper") -> History:
    """The whipping task for policies that see the last observations and actions, and act only in simulation.

    Args:
        history: number of observations that policies see, one more than actions.
        detector: see `make`.
        engine: see `make`.
        reward: see `make`.

    Raises:
        ValueError: as `make`, and for an invalid number of observations.
    """
    whip: Any = make(detector, engine, reward)  # frozen, which the protocol's attributes are not
    return History(whip, history)


def make(detector: str = "mask", engine: str = "auto", reward: str = "paper") -> WhipEnvironment:
    """The whipping task.

    Args:
        detector: keypoint detector: "clean", "mask", "noisy", "transporter", "learnt" or "learnt-transporter".
        engine: the physics: "auto", "native", "mjx" or "warp".
        reward: name of the reward: "paper", "ordered" or "settled" (`jaxlfi.envs.whip.rewards`).

    Raises:
        ValueError: for unknown names.
    """
    if detector not in DETECTORS:
        raise ValueError(f"detector: expected one of {', '.join(DETECTORS)}, got {detector!r}")
    return WhipEnvironment(Whip(pick(engine), DETECTORS[detector], rewards.check(reward)))


def _outlined(state: EnvState, key: jax.Array) -> EnvState:
    """The state with the key of the steps to come, and only the facts that policies are judged by."""
    hit, outside, failed = (state.facts[name] for name in ("hit", "outside", "failed"))
    clean = hit[rules.TOP] & ~jnp.any(hit[: rules.TOP])
    facts = {"hit": hit[rules.TOP], "clean_hit": clean, "outside": outside, "failed": failed}
    return state.replace(inner=state.inner.replace(key=key), facts=facts)
