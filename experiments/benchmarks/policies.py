"""Where the time of policy training goes: `python -m experiments.benchmarks.policies`.

Trains on the uniform distribution over Theta_0 and, once the policies have begun to hit, prints

* milliseconds of an update, and their parts: MuJoCo's steps of scenes without and with the cubes, building models, the
  rest of the engine's callback, and, by leaving parts out, PPO's gradient steps and everything else (keypoints, acting
  networks, new episodes);
* seconds of training a policy, for one alone and for several side by side in one compiled program.

Compilation is excluded. Times are the best of several calls, since other programs may share the machine.
"""

import argparse
import collections
import functools
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import jax
import jax.numpy as jnp
import mujoco.rollout

from jaxlfi.envs.whip.environment import WhipEnvironment, make
from jaxlfi.envs.whip.episode import Whip
from jaxlfi.envs.whip.physics import native
from jaxlfi.envs.whip.physics.engine import settled
from jaxlfi.rl import domains, ppo
from jaxlfi.rl.settings import QUICK


class Still:
    """Physics in which nothing moves, to measure the parts of a training that are not physics."""

    def __init__(self, scene):
        """Keep the scene."""
        self.scene = scene

    def advance(self, parameters, state, target):
        """One control interval."""
        return settled(state, state.qpos, state.qvel, target, jnp.asarray(False))


UPDATES = 20
"""Number of updates in one call."""
Trainer = Callable[[ppo.Training], tuple[ppo.Training, ppo.Update]]


def prepared(environment: WhipEnvironment, side_by_side: int, settings=QUICK) -> tuple[Trainer, ppo.Training]:
    """`UPDATES` updates of several trainings as one program, and the trainings' start."""

    def start(key):
        key_domain, key_start = jax.random.split(key)
        points = domains.uniform(key_domain, environment.supports["initial"], settings.environments)
        return ppo.init(key_start, environment, settings, points)

    some = functools.partial(ppo.train, environment, settings, updates=UPDATES)
    train = jax.jit(jax.vmap(lambda state: some(training=state), out_axes=(0, 1)))
    return train, jax.jit(jax.vmap(start))(jax.random.split(jax.random.key(0), side_by_side))


@contextmanager
def timed(seconds: collections.Counter) -> Iterator[None]:
    """Accumulate the seconds of the native engine's parts."""

    def of(name: Callable[..., str], function):
        def wrapped(*args, **kwargs):
            begin = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                seconds[name(*args)] += time.perf_counter() - begin

        return wrapped

    whole = lambda rollout, models, *_: "steps with cubes" if models[0].nbody > BARE else "steps without cubes"
    places = (
        (native, "_advance_many", lambda *_: "callback"),
        (native._ModelCache, "_model", lambda *_: "building models"),
        (mujoco.rollout.Rollout, "rollout", whole),
    )
    before = [getattr(owner, name) for owner, name, _ in places]
    for owner, name, label in places:
        setattr(owner, name, of(label, getattr(owner, name)))
    try:
        yield
    finally:
        for (owner, name, _), function in zip(places, before, strict=True):
            setattr(owner, name, function)


def warm(train: Trainer, state: ppo.Training, updates: int) -> tuple[ppo.Training, float]:
    """Trainings after a number of updates, and their return in the last ones."""
    for _ in range(-(-updates // UPDATES)):
        state, made = jax.block_until_ready(train(state))
    return state, float(jnp.nanmean(made.value))


def an_update(train: Trainer, state: ppo.Training, repeats: int = 3) -> float:
    """Seconds of an update, the best of several."""
    seconds = []
    for _ in range(repeats + 1):  # the first call may compile
        begin = time.perf_counter()
        jax.block_until_ready(train(state))
        seconds.append((time.perf_counter() - begin) / UPDATES)
    return min(seconds[1:])


def parts(side_by_side: int, updates: int) -> dict[str, float]:
    """Seconds of the parts of an update, after a number of updates."""
    environment = make(engine="native")
    seconds: collections.Counter = collections.Counter()
    with timed(seconds):  # entered before anything is compiled: programs keep the functions they were compiled with
        train, state = prepared(environment, side_by_side)
        state, value = warm(train, state, updates)
        print(f"after {updates} updates the return is {value:.2f}\n")
        seconds.clear()
        begin = time.perf_counter()
        jax.block_until_ready(train(state))
        total = time.perf_counter() - begin
    still = WhipEnvironment(Whip(Still(environment.whip.engine.scene), environment.whip.detector))
    without_physics = {
        epochs: an_update(*prepared(still, side_by_side, QUICK.replace(epochs=epochs))) * UPDATES
        for epochs in (1, QUICK.epochs)
    }
    gradients = (without_physics[QUICK.epochs] - without_physics[1]) * QUICK.epochs / (QUICK.epochs - 1)
    inside = sum(seconds[name] for name in ("steps with cubes", "steps without cubes", "building models"))
    split = {
        "MuJoCo's steps with cubes": seconds["steps with cubes"],
        "MuJoCo's steps without cubes": seconds["steps without cubes"],
        "building models": seconds["building models"],
        "rest of the engine's callback": seconds["callback"] - inside,
        "gradient steps": gradients,
    }
    rest = total - sum(split.values())
    return {name: value / UPDATES for name, value in {**split, "keypoints, acting, resets": rest}.items()}


BARE = native.bare_model(native.Scene()).nbody
"""Number of bodies of a scene without cubes."""


def main() -> None:
    """Measure and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--warm-up", type=int, default=120, help="updates before the parts are timed (default: 120)")
    parser.add_argument("--side-by-side", type=int, nargs="+", default=[1, 4, 12], help="(default: 1 4 12)")
    arguments = parser.parse_args()
    split = parts(4, arguments.warm_up)
    total = sum(split.values())
    print(f"{'an update of four policies side by side':<42}{'ms':>8}{'%':>6}")
    for name, seconds in sorted(split.items(), key=lambda item: -item[1]):
        print(f"{name:<42}{1e3 * seconds:>8.1f}{100 * seconds / total:>6.0f}")
    print(f"{'in all':<42}{1e3 * total:>8.1f}{100:>6}\n")
    print(f"{'policies side by side':<42}{'s a policy of 60,000 steps':>28}")
    for count in arguments.side_by_side:
        train, state = prepared(make(engine="native"), count)
        seconds = an_update(train, warm(train, state, arguments.warm_up)[0])
        print(f"{count:<42}{seconds / count * QUICK.updates:>28.1f}", flush=True)


if __name__ == "__main__":
    main()
