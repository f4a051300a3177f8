"""The whipping task for reinforcement learning libraries: a gymnasium environment, and a vector environment.

    gymnasium.make("jaxlfi.envs.whip.gym:jaxlfi/Whip-v0")
    gymnasium.make_vec("jaxlfi.envs.whip.gym:jaxlfi/Whip-v0", num_envs=12, vectorization_mode="vector_entry_point")

Actions are in metres; `gymnasium.wrappers.RescaleAction` scales them to [-1, 1]. All else is as in `jaxlfi.rl.gym`.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.envs.whip.environment import WhipEnvironment, begun, stepped
from jaxlfi.envs.whip.episode import Whip
from jaxlfi.envs.whip.parameters import INITIAL, WhipParameters, check, median, randomised
from jaxlfi.envs.whip.physics.engine import Engine
from jaxlfi.envs.whip.physics.engines import pick
from jaxlfi.envs.whip.render import PALETTE
from jaxlfi.envs.whip.vision.camera import side_camera
from jaxlfi.envs.whip.vision.keypoints import DETECTORS, Detector
from jaxlfi.envs.whip.vision.raster import segmentation
from jaxlfi.rl.course import Course, Episode
from jaxlfi.rl.gym import AutoresetMode, GymEnvironment, GymVector, gymnasium

Domain = Callable[[jax.Array], WhipParameters]
"""Function that draws the parameters of a scene with a key."""
Nuisances = Literal["fixed", "random"]


def initial_domain(key: jax.Array) -> WhipParameters:
    """A scene of the initial support: length, modulus and all nuisances uniform in their ranges (section VI-H)."""
    key_theta, key_rest = jax.random.split(key)
    length, young = jax.random.uniform(key_theta, (2,), minval=INITIAL.low, maxval=INITIAL.high)
    return randomised(key_rest, length, young)


class WhipGym(GymEnvironment):
    """The whipping task as a gymnasium environment.

    `info` contains `hit` [6], `outside`, `failed`, `seen` [10] (see `episode.Step`), and the scene's `length` in m and
    `young` in Pa. Actions beyond their limit are clipped; one that is not two finite numbers is refused, and the
    episode continues.

    Example:
        >>> environment = WhipGym()
        >>> observation, info = environment.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = environment.step([0.0, 0.01])
        >>> float(reward), terminated, truncated
        (0.0, False, False)
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 6}  # noqa: RUF012

    def __init__(
        self,
        parameters: WhipParameters | Domain | None = None,
        detector: str | Detector = "clean",
        engine: str | Engine = "auto",
        render_mode: str | None = None,
        nuisances: Nuisances = "fixed",
    ):
        """Nothing is simulated yet.

        Args:
            parameters: parameters of the scene, by default mu; or a function of a key that draws those of every
                episode, such as `initial_domain`.
            detector: keypoint detector, or its name: "clean", "mask", "noisy", "transporter", "learnt" or
                "learnt-transporter".
            engine: the physics, or its name (`physics.engines.pick`).
            render_mode: "rgb_array" for `render`.
            nuisances: "fixed": every episode uses the given scene; "random": every episode keeps its length and
                modulus, and all else, including the stack and the camera, is redrawn (section VI-H).

        Raises:
            ValueError: for parameters outside of their ranges, and unknown names.
        """
        self._set(_course(parameters, detector, engine, nuisances), parameters, render_mode)

    def render(self) -> np.ndarray | None:
        """The segmentation image in colours, uint8 [256, 256, 3], if `render_mode` asks for it."""
        if self.render_mode is None:
            return None
        return np.asarray(_picture(self._course.environment.whip, self._required("render").state.inner))


class WhipVector(GymVector):
    """Many whipping scenes stepped together; scene i is equivalent to a `WhipGym` with the seed `seed + i`.

    Example:
        >>> environments = WhipVector(3, initial_domain)
        >>> observations, info = environments.reset(seed=0)
        >>> observations.shape, info["young"].shape
        ((3, 28), (3,))
    """

    def __init__(
        self,
        num_envs: int,
        parameters: WhipParameters | Domain | None = None,
        detector: str | Detector = "clean",
        engine: str | Engine = "auto",
        nuisances: Nuisances = "fixed",
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ):
        """Nothing is simulated yet.

        Args:
            num_envs: number of scenes N.
            parameters: see `WhipGym`; or those of N scenes, with a leading axis.
            detector: see `WhipGym`.
            engine: see `WhipGym`.
            nuisances: see `WhipGym`.
            autoreset_mode: when a new episode begins; see `GymVector`.

        Raises:
            ValueError: see `WhipGym`, and for other modes.
        """
        self._set(num_envs, _course(parameters, detector, engine, nuisances), parameters, autoreset_mode)


@dataclasses.dataclass(frozen=True)
class WhipCourse(Course):
    """Episodes whose theta is a whole scene.

    Attributes:
        nuisances: whether all parameters of given scenes but length and modulus are redrawn.
    """

    nuisances: bool = False

    def points(self, theta: Any, batch: tuple[int, ...] = ()) -> WhipParameters:
        """Scenes of a batch shape; a placeholder if they are drawn."""
        one = median()
        given = one if theta is None or callable(theta) else check(theta)
        batched = {}
        for name, like in vars(one).items():
            value = jnp.asarray(getattr(given, name), jnp.float32)
            own = value.shape[: value.ndim - like.ndim]
            if own not in ((), batch):
                raise ValueError(f"parameters: expected one scene's or {list(batch)}, got {list(own)} for {name}")
            batched[name] = jnp.broadcast_to(value, (*batch, *like.shape))
        return WhipParameters(**batched)

    def theta(self, key, given):
        """The scene of an episode."""
        if self.draw is None and self.nuisances:
            return randomised(key, given.length, given.young)
        return super().theta(key, given)

    def reset(self, key, theta):
        """The start of an episode in a scene."""
        return begun(self.environment.whip, key, theta)

    def go_on(self, key, state, action, over):
        """A step, whose noise is drawn with this key; an episode that is over is not simulated."""
        episode = state.inner.episode
        stopped = episode.replace(state=episode.state.stopped(over))
        return stepped(self.environment.whip, key, state.inner.replace(episode=stopped), action)

    def facts(self, episode: Episode) -> dict[str, jax.Array]:
        """The facts of a step, and the scene's length and modulus."""
        return {**episode.state.facts, "length": episode.theta.length, "young": episode.theta.young}


def _course(parameters: Any, detector: str | Detector, engine: str | Engine, nuisances: str) -> WhipCourse:
    if nuisances not in ("fixed", "random"):
        raise ValueError(f"nuisances: expected fixed or random, got {nuisances!r}")
    if isinstance(detector, str) and detector not in DETECTORS:
        raise ValueError(f"detector: expected one of {', '.join(DETECTORS)}, got {detector!r}")
    found = DETECTORS[detector] if isinstance(detector, str) else detector
    plain = {name: np.asarray(number).tolist() for name, number in vars(found).items()}
    if plain["places"] is not None:
        plain["places"] = tuple(plain["places"])
    whip = Whip(pick(engine) if isinstance(engine, str) else engine, Detector(**plain))  # which can be hashed
    return WhipCourse(WhipEnvironment(whip), parameters if callable(parameters) else None, nuisances == "random")


@functools.partial(jax.jit, static_argnums=0)
def _picture(whip: Whip, scene):
    labels = segmentation(
        side_camera(scene.parameters), whip.frames(scene.parameters, scene.episode), scene.parameters.cube_side
    )
    return jnp.round(255 * jnp.asarray(PALETTE)[labels]).astype(jnp.uint8)


gymnasium.register(
    "jaxlfi/Whip-v0", entry_point="jaxlfi.envs.whip.gym:WhipGym", vector_entry_point="jaxlfi.envs.whip.gym:WhipVector"
)
