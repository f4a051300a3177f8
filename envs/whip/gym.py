"""The whipping task for reinforcement learning libraries: a gymnasium environment, and a vector environment.

    gymnasium.make("jaxlfi.envs.whip.gym:jaxlfi/Whip-v0")
    gymnasium.make_vec("jaxlfi.envs.whip.gym:jaxlfi/Whip-v0", num_envs=12, vectorization_mode="vector_entry_point")

Actions are in metres; `gymnasium.wrappers.RescaleAction` brings them to [-1, 1].
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.envs.whip import rules
from jaxlfi.envs.whip.episode import OBSERVATION, Episode, Step, Whip
from jaxlfi.envs.whip.parameters import INITIAL, WhipParameters, check, median, randomised
from jaxlfi.envs.whip.physics.engine import Engine
from jaxlfi.envs.whip.physics.engines import pick
from jaxlfi.envs.whip.render import PALETTE
from jaxlfi.envs.whip.vision.camera import side_camera
from jaxlfi.envs.whip.vision.keypoints import DETECTORS, Detector
from jaxlfi.envs.whip.vision.raster import segmentation

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError("jaxlfi.envs.whip.gym needs gymnasium: pip install 'jaxlfi[whip]'") from error

Domain = Callable[[jax.Array], WhipParameters]
"""Draws the parameters of a scene with a key."""

ACTIONS = spaces.Box(-rules.ACTION_LIMIT, rules.ACTION_LIMIT, (2,), np.float32)
OBSERVATIONS = spaces.Box(
    np.float32([-np.inf] * (OBSERVATION - 6) + [0.0] * 6), np.float32([np.inf] * (OBSERVATION - 6) + [1.0] * 6)
)
"""The gripper and the keypoints are unbounded; see `episode.Step.observation`."""


def initial_domain(key: jax.Array) -> WhipParameters:
    """A scene of the initial support: length, modulus and all nuisances uniform in their ranges (section VI-H)."""
    key_theta, key_rest = jax.random.split(key)
    length, young = jax.random.uniform(key_theta, (2,), minval=INITIAL.low, maxval=INITIAL.high)
    return randomised(key_rest, length, young)


class WhipGym(gymnasium.Env):
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
        nuisances: Literal["fixed", "random"] = "fixed",
    ):
        """Nothing is simulated yet.

        Args:
            parameters: of the scene, by default mu; or a function of a key that draws those of every episode, such as
                `initial_domain`.
            detector: of keypoints, or its name: "clean", "mask", "noisy", "transporter", "learnt" or
                "learnt-transporter".
            engine: the physics, or its name (`physics.engines.pick`).
            render_mode: "rgb_array" for `render`.
            nuisances: "fixed": every episode is in the scene that is given; "random": in one of its length and modulus,
                and all else, stack and camera among it, is drawn anew (section VI-H).

        Raises:
            ValueError: for parameters outside of their ranges, and unknown names.
        """
        self.action_space, self.observation_space = ACTIONS, OBSERVATIONS
        self.render_mode = _mode(render_mode)
        self._parts = _parts(engine, parameters, nuisances)
        self._detector, self._parameters = _detector(detector), _fixed(parameters, ())
        self._key = self._scene = self._episode = None

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """Begin an episode, in a new scene if scenes are drawn; there are no options."""
        super().reset(seed=seed)
        if seed is not None or self._key is None:
            self._key = jax.random.key(_entropy(self.np_random) if seed is None else seed)
        self._key, self._scene, self._episode, now = _begin(self._parts, self._detector, self._parameters, self._key)
        now = _own(now)
        return now.observation, _one(_info(self._scene, now))

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Apply an action (dx, dz), in m.

        Raises:
            ValueError: for what is not two finite numbers.
            ResetNeeded: before the first `reset`.
        """
        if self._episode is None:
            raise gymnasium.error.ResetNeeded("step: expected a reset before it, got none")
        action = _action(action, (2,))
        self._key, self._episode, now = _go_on(
            self._parts.engine, self._detector, self._scene, self._key, self._episode, action
        )
        now = _own(now)
        ends = bool(now.terminated), bool(now.truncated)
        return now.observation, float(now.reward), *ends, _one(_info(self._scene, now))

    def render(self) -> np.ndarray | None:
        """The segmentation image in colours, uint8 [256, 256, 3], where `render_mode` asks for it."""
        if self.render_mode is None:
            return None
        if self._episode is None:
            raise gymnasium.error.ResetNeeded("render: expected a reset before it, got none")
        return np.asarray(_picture(self._parts.engine, self._scene, self._episode))


class WhipVector(VectorEnv):
    """Many whipping scenes stepped together; scene i is equivalent to a `WhipGym` with the seed `seed + i`.

    A scene whose episode has ended is reset in the next step, whose action it ignores (gymnasium's
    `AutoresetMode.NEXT_STEP`); or in the same one, which is `AutoresetMode.SAME_STEP`: then the observation is that of
    the new episode, and the last one of the old is in the info as `final_obs`, beside `final_info`.

    Example:
        >>> environments = WhipVector(3, initial_domain)
        >>> observations, info = environments.reset(seed=0)
        >>> observations.shape, info["young"].shape
        ((3, 28), (3,))
    """

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int,
        parameters: WhipParameters | Domain | None = None,
        detector: str | Detector = "clean",
        engine: str | Engine = "auto",
        nuisances: Literal["fixed", "random"] = "fixed",
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ):
        """Nothing is simulated yet.

        Args:
            num_envs: number of scenes N.
            parameters: see `WhipGym`; or those of N scenes, with a leading axis.
            detector: see `WhipGym`.
            engine: see `WhipGym`.
            nuisances: see `WhipGym`.
            autoreset_mode: when a new episode begins; see above.

        Raises:
            ValueError: see `WhipGym`, and for other modes.
        """
        if num_envs < 1:
            raise ValueError(f"num_envs: expected at least 1, got {num_envs}")
        self.num_envs, self.render_mode = num_envs, None
        self.single_action_space, self.single_observation_space = ACTIONS, OBSERVATIONS
        self.action_space, self.observation_space = (batch_space(space, num_envs) for space in (ACTIONS, OBSERVATIONS))
        self.metadata = {"autoreset_mode": _autoreset(autoreset_mode)}
        self._parts = _parts(engine, parameters, nuisances, self.metadata["autoreset_mode"])
        self._detector, self._parameters = _detector(detector), _fixed(parameters, (num_envs,))
        self._keys = self._scenes = self._episodes = None
        self._over = np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict | None = None
    ) -> tuple[np.ndarray, dict]:
        """Begin all episodes.

        Args:
            seed: of the first scene, or one per scene.
            options: unused.

        Raises:
            ValueError: for a wrong number of seeds.
        """
        seeds = [None if seed is None else seed + i for i in range(self.num_envs)] if np.ndim(seed) == 0 else [*seed]
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed: expected {self.num_envs} of them, got {len(seeds)}")
        super().reset(seed=seeds[0])
        if self._keys is None:
            self._keys = jax.random.split(jax.random.key(_entropy(self.np_random)), self.num_envs)
        for i, own in enumerate(seeds):
            if own is not None:
                self._keys = self._keys.at[i].set(jax.random.key(own))
        self._keys, self._scenes, self._episodes, now = _begin_many(
            self._parts, self._detector, self._parameters, self._keys
        )
        self._over, now = np.zeros(self.num_envs, bool), _own(now)
        return now.observation, _many(_info(self._scenes, now))

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict]:
        """Apply actions (dx, dz), in m, shape [N, 2].

        Raises:
            ValueError: for a wrong shape, and numbers that are not finite.
            ResetNeeded: before the first `reset`.
        """
        if self._episodes is None:
            raise gymnasium.error.ResetNeeded("step: expected a reset before it, got none")
        actions = _action(actions, (self.num_envs, 2))
        before = self._scenes
        self._keys, self._scenes, self._episodes, now, last = _go_on_many(
            self._parts,
            self._detector,
            self._parameters,
            before,
            self._keys,
            self._episodes,
            actions,
            self._over,
        )
        now, last = _own(now), _own(last)
        info = _many(_info(self._scenes, now))
        if not self._parts.same_step:
            self._over = now.terminated | now.truncated
            return now.observation, now.reward, now.terminated, now.truncated, info
        over = last.terminated | last.truncated
        if over.any():
            final = np.full(self.num_envs, None, object)
            for place in np.flatnonzero(over):
                final[place] = last.observation[place]
            info |= {"final_obs": final, "final_info": _many(_info(before, last), over)}
            info |= {"_final_obs": over, "_final_info": over}
        return now.observation, last.reward, last.terminated, last.truncated, info


# ---------------------------------------------------------------------------------------------------- one scene


@dataclasses.dataclass(frozen=True)
class Parts:
    """Static arguments of the compiled programs.

    Attributes:
        engine: the physics.
        draw: the distribution of scenes, if they are drawn.
        nuisances: whether all but length and modulus of given scenes is drawn.
        same_step: whether an episode begins in the step in which one ends.
    """

    engine: Engine
    draw: Domain | None
    nuisances: bool
    same_step: bool


def _start(parts: Parts, detector: Detector, parameters: WhipParameters, key: jax.Array):
    """A scene, the start of an episode in it, and its first observation."""
    key_scene, key_reset = jax.random.split(key)
    if parts.draw is not None:
        scene = parts.draw(key_scene)
    else:
        scene = randomised(key_scene, parameters.length, parameters.young) if parts.nuisances else parameters
    episode, observation = Whip(parts.engine, detector).reset(key_reset, scene)
    no = jnp.asarray(False)
    return scene, episode, Step(observation, jnp.asarray(0.0), no, no, episode.hit, no, no, jnp.ones(10, bool))


@functools.partial(jax.jit, static_argnums=0)
def _begin(parts: Parts, detector: Detector, parameters: WhipParameters, key: jax.Array):
    """The next key, and `_start`."""
    key, key_start, _ = jax.random.split(key, 3)
    return key, *_start(parts, detector, parameters, key_start)


@functools.partial(jax.jit, static_argnums=0)
def _go_on(engine: Engine, detector: Detector, scene: WhipParameters, key: jax.Array, episode: Episode, action):
    """The next key, the episode after an action, and its step."""
    key, _, key_step = jax.random.split(key, 3)
    return key, *Whip(engine, detector).step(key_step, scene, episode, action)


@functools.partial(jax.jit, static_argnums=0)
def _begin_many(parts: Parts, detector: Detector, parameters: WhipParameters, keys: jax.Array):
    return jax.vmap(functools.partial(_begin, parts, detector))(parameters, keys)


@functools.partial(jax.jit, static_argnums=0)
def _go_on_many(parts: Parts, detector: Detector, parameters: WhipParameters, scenes, keys, episodes, actions, over):
    """As `_go_on`, but as `_begin` where the episode was over, or is; also returns the scenes, and the steps alone."""

    def one(parameters, scene, key, episode, action, over):
        key, key_start, key_step = jax.random.split(key, 3)
        idle = episode.replace(state=episode.state.stopped(over))
        went_on = (scene, *Whip(parts.engine, detector).step(key_step, scene, idle, action))
        last = went_on[-1]
        if parts.same_step:  # as a step and a reset of a single scene
            over = last.terminated | last.truncated
            later, key_start, _ = jax.random.split(key, 3)
            chosen = jnp.where(over, jax.random.key_data(later), jax.random.key_data(key))
            key = jax.random.wrap_key_data(chosen)
        started = _start(parts, detector, parameters, key_start)
        return key, *jax.tree.map(lambda yes, no: jnp.where(over, yes, no), started, went_on), last

    return jax.vmap(one)(parameters, scenes, keys, episodes, actions, over)


@functools.partial(jax.jit, static_argnums=0)
def _picture(engine: Engine, scene: WhipParameters, episode: Episode):
    labels = segmentation(side_camera(scene), Whip(engine).frames(scene, episode), scene.cube_side)
    return jnp.round(255 * jnp.asarray(PALETTE)[labels]).astype(jnp.uint8)


# -------------------------------------------------------------------------------------------------- arguments


def _parts(
    engine: str | Engine,
    parameters: WhipParameters | Domain | None,
    nuisances: str,
    mode: AutoresetMode = AutoresetMode.NEXT_STEP,
) -> Parts:
    if nuisances not in ("fixed", "random"):
        raise ValueError(f"nuisances: expected fixed or random, got {nuisances!r}")
    return Parts(
        engine=pick(engine) if isinstance(engine, str) else engine,
        draw=parameters if callable(parameters) else None,
        nuisances=nuisances == "random",
        same_step=mode is AutoresetMode.SAME_STEP,
    )


def _autoreset(mode: AutoresetMode | str) -> AutoresetMode:
    modes = {known: known for known in (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)}
    modes |= {known.value: known for known in modes}
    if mode not in modes:
        raise ValueError(f"autoreset_mode: expected NextStep or SameStep, got {mode!r}")
    return modes[mode]


def _fixed(parameters: WhipParameters | Domain | None, batch: tuple[int, ...]) -> WhipParameters:
    """Scenes of a batch shape; a placeholder if they are drawn."""
    one = median()
    given = one if parameters is None or callable(parameters) else check(parameters)
    batched = {}
    for name, like in vars(one).items():
        value = jnp.asarray(getattr(given, name), jnp.float32)
        own = value.shape[: value.ndim - like.ndim]
        if own not in ((), batch):
            raise ValueError(f"parameters: expected one scene's or {list(batch)}, got {list(own)} for {name}")
        batched[name] = jnp.broadcast_to(value, (*batch, *like.shape))
    return WhipParameters(**batched)


def _detector(detector: str | Detector) -> Detector:
    if isinstance(detector, str) and detector not in DETECTORS:
        raise ValueError(f"detector: expected one of {', '.join(DETECTORS)}, got {detector!r}")
    return DETECTORS[detector] if isinstance(detector, str) else detector


def _mode(mode: str | None) -> str | None:
    if mode not in (None, *WhipGym.metadata["render_modes"]):
        raise ValueError(f"render_mode: expected rgb_array or none, got {mode!r}")
    return mode


def _action(action, shape: tuple[int, ...]) -> np.ndarray:
    try:
        checked = np.asarray(action, np.float32)
    except (TypeError, ValueError):
        raise ValueError(f"action: expected numbers of shape {list(shape)}, got {action!r}") from None
    if checked.shape != shape:
        raise ValueError(f"action: expected numbers of shape {list(shape)}, got shape {list(checked.shape)}")
    if not np.isfinite(checked).all():
        raise ValueError(f"action: expected finite numbers, got {checked.tolist()}")
    return checked


def _own(now: Step) -> Step:
    """NumPy arrays that may be written to."""
    return jax.tree.map(np.array, now)


def _entropy(random: np.random.Generator) -> int:
    return int(random.integers(2**31))


def _info(scene: WhipParameters, now: Step) -> dict[str, np.ndarray]:
    of_step = {name: getattr(now, name) for name in ("hit", "outside", "failed", "seen")}
    return {
        name: np.asarray(value) for name, value in {**of_step, "length": scene.length, "young": scene.young}.items()
    }


def _one(info: dict[str, np.ndarray]) -> dict:
    """The info of one scene, with Python's scalars."""
    return {name: value if value.ndim else value.item() for name, value in info.items()}


def _many(info: dict[str, np.ndarray], those: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """The info of many scenes, with masks of those that report it, by default all, as in gymnasium."""
    masks = {f"_{name}": np.ones(len(value), bool) if those is None else those for name, value in info.items()}
    return {**info, **masks}


gymnasium.register(
    "jaxlfi/Whip-v0", entry_point="jaxlfi.envs.whip.gym:WhipGym", vector_entry_point="jaxlfi.envs.whip.gym:WhipVector"
)
