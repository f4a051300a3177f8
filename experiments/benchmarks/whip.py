"""Speed and agreement of the whipping task's engines: `python -m experiments.benchmarks.whip`.

Prints

* physics steps and episodes per second, of random episodes in random scenes, for each engine and several batch sizes,
  and the number that failed; compared with MuJoCo called in a plain Python loop on one core, and with its own loop in
  C on one core, the lower bound, for the same models and actions. On CPU, MJX's batches are divided among as many
  devices as there are cores, and larger ones are limited to the first control steps;
* seconds of tracing and compiling an episode of MJX, cold and from the cache on disk;
* how well MJX agrees with MuJoCo: of sixty DLOs, eight at the corners of Phi and Theta_0 and the others random, each
  moved in five ways, how many knock the same cubes off. After contact, motions are chaotic, so the reference is MuJoCo
  compared with itself for set-points that differ by 10 micrometres, twelve times. If nothing is touched, the distance
  of the DLOs' points;
* whether a chain without damping, in long steps, is reported as failed.

`--out` saves the results as JSON. Times are the best of several calls, since other programs may share the machine.
"""

import argparse
import functools
import importlib.metadata
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

if "XLA_FLAGS" not in os.environ:  # read once, when jax starts
    os.environ["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={os.cpu_count() or 1}"

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np

from experiments.whip_physics.rollouts import random_scene, random_targets
from jaxlfi.envs.whip import rules
from jaxlfi.envs.whip.exploration import exploratory_actions
from jaxlfi.envs.whip.parameters import FEASIBLE, INITIAL, WhipParameters, median
from jaxlfi.envs.whip.physics.chain import Chain
from jaxlfi.envs.whip.physics.edits import edited_model
from jaxlfi.envs.whip.physics.engine import Engine, State, ramp, rollout
from jaxlfi.envs.whip.physics.engines import NAMES, pick
from jaxlfi.envs.whip.physics.kinematics import frames
from jaxlfi.envs.whip.physics.native import NativeEngine
from jaxlfi.envs.whip.physics.scene import CUBES, Scene
from jaxlfi.envs.whip.rig import HIT_DISTANCE, START
from jaxlfi.io import files as atomic
from jaxlfi.io.provenance import command_line, environment

SCENE = Scene()
EPISODE = rules.STEPS * SCENE.substeps
"""Number of physics steps of an episode."""
PATIENCE = 20_000
"""Maximum number of physics steps of MJX in a timed call on a processor."""


def random_batch(count: int) -> tuple[WhipParameters, jax.Array]:
    """Scenes over all of Phi and their set-points, shape [count, 16, 2]; every other one has saturated actions."""
    keys = jax.random.split(jax.random.key(0), 2 * count)
    targets = jax.vmap(random_targets)(keys[count:], jnp.arange(count) % 2 == 1)
    return jax.vmap(random_scene)(keys[:count]), targets


def best(call: Callable[[], object], repeats: int) -> float:
    """Seconds of the fastest call."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(call())
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def by_engine(engine: Engine, batch: int, controls: int, repeats: int) -> dict[str, float]:
    """Steps per second of rollouts of `controls` control steps, number of failures, and seconds of the first call."""
    scenes, targets = random_batch(batch)
    run = jax.vmap(functools.partial(rollout, engine))
    if not isinstance(engine, NativeEngine) and jax.device_count() > 1 and batch % jax.device_count() == 0:
        run = jax.shard_map(run, mesh=_all_devices(), in_specs=ALONG, out_specs=ALONG, check_vma=False)
    run = jax.jit(run)
    start = time.perf_counter()
    failed = int(run(scenes, targets[:, :controls]).failed[:, -1].sum())
    first = time.perf_counter() - start
    seconds = best(lambda: run(scenes, targets[:, :controls]), repeats)
    return {"steps/s": batch * controls * SCENE.substeps / seconds, "failed": failed, "first call, s": first}


def by_mujoco(count: int, repeats: int) -> dict[str, float]:
    """Steps per second of MuJoCo on one core, called from Python for every step, or once for all episodes."""
    scenes, targets = jax.device_get(random_batch(count))
    models = [edited_model(SCENE, jax.tree.map(lambda leaf, i=i: np.float64(leaf[i]), scenes)) for i in range(count)]
    before = np.concatenate([np.broadcast_to(START, (count, 1, 2)), targets[:, :-1]], axis=1)
    controls = ramp(before[:, :, None], targets[:, :, None], SCENE.substeps, np).reshape(count, EPISODE, 2)

    def in_python():
        for model, episode in zip(models, controls, strict=True):
            data = mujoco.MjData(model)
            for control in episode:
                data.ctrl[:] = control
                mujoco.mj_step(model, data)

    start = np.stack([np.concatenate([[0.0], model.qpos0, np.zeros(model.nv)]) for model in models])
    pool, data = mujoco.rollout.Rollout(nthread=0), [mujoco.MjData(models[0])]
    in_c = lambda: pool.rollout(models, data, start, controls)
    calls = {"MuJoCo, a loop in Python, one core": in_python, "MuJoCo, its loop in C, one core (floor)": in_c}
    return {name: count * EPISODE / best(call, 1 + repeats) for name, call in calls.items()}  # the first warms up


ALONG = jax.sharding.PartitionSpec("scenes")


def _all_devices() -> jax.sharding.Mesh:
    return jax.make_mesh((jax.device_count(),), ("scenes",), axis_types=(jax.sharding.AxisType.Auto,))


def speed(engines: list[str], batches: list[int], repeats: int) -> dict[str, dict[str, dict[str, float]]]:
    """Steps per second, by engine and batch."""
    print(f"{jax.devices()[0].device_kind}, {len(os.sched_getaffinity(0))} cores\n")
    print(f"{'':<42}{'batch':>6}{'steps/s':>12}{'episodes/s':>12}{'failed':>8}{'first call, s':>15}")
    rates: dict[str, dict[str, dict[str, float]]] = {}
    if "native" in engines:
        for name, rate in by_mujoco(12, repeats).items():
            _line(name, 12, rate)
            rates[name] = {"12": {"steps/s": rate}}
    made = {f"{name}{threads}": engine for name in engines for threads, engine in _made(name).items()}
    patient = jax.default_backend() != "cpu"
    for name, engine in made.items():
        rates[name] = {}
        for batch in batches:
            most = rules.STEPS if patient or name != "mjx" else max(1, PATIENCE // (batch * SCENE.substeps))
            controls = min(rules.STEPS, most)
            rates[name][str(batch)] = rate = by_engine(engine, batch, controls, repeats)
            rate["control steps"] = controls
            shown = name if controls == rules.STEPS else f"{name}, {controls} control steps"
            _line(shown, batch, rate["steps/s"], f"{rate['failed']:>8}{rate['first call, s']:>15.1f}")
    print()
    return rates


def _made(name: str) -> dict[str, Engine]:
    return {", one thread": NativeEngine(SCENE, threads=1), "": pick(name)} if name == "native" else {"": pick(name)}


def _line(name: str, batch: int, rate: float, more: str = "") -> None:
    print(f"{name:<42}{batch:>6}{rate:>12,.0f}{rate / EPISODE:>12.1f}{more}", flush=True)


_COMPILE_AN_EPISODE = """
import time
from jaxlfi.io import compile_cache
compile_cache.enable()
import jax
from jaxlfi.envs.whip.physics.engine import rollout
from jaxlfi.envs.whip.physics.engines import NAMES, pick
from experiments.benchmarks.whip import random_batch
engine = pick("mjx")
scenes, targets = random_batch(12)
start = time.perf_counter()
lowered = jax.jit(jax.vmap(lambda *one: rollout(engine, *one))).lower(scenes, targets)
traced = time.perf_counter()
lowered.compile()
print(traced - start, time.perf_counter() - traced)
"""


def compiling() -> dict[str, float]:
    """Seconds of tracing and compiling twelve episodes of MJX, in fresh processes with an initially empty cache."""
    seconds = {}
    with tempfile.TemporaryDirectory() as cache:
        environment = {**os.environ, "XDG_CACHE_HOME": cache}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        for name in ("compiling", "from the cache on disk"):
            done = subprocess.run(
                [sys.executable, "-c", _COMPILE_AN_EPISODE], env=environment, capture_output=True, text=True, check=True
            )
            seconds["tracing"], seconds[name] = map(float, done.stdout.splitlines()[-1].split())
    print(f"{'twelve episodes of MJX':<42}{'s':>10}")
    for name, value in seconds.items():
        print(f"{name:<42}{value:>10.1f}")
    print()
    return seconds


def dlos(count: int) -> WhipParameters:
    """The corners of Phi and Theta_0, and random scenes over all of Phi."""
    corners = [(length, young) for box in (FEASIBLE, INITIAL) for length in _ends(box, 0) for young in _ends(box, 1)]
    keys = jax.random.split(jax.random.key(7), count - len(corners))
    parts = median(*np.array(corners).T), jax.vmap(random_scene)(keys)
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def _ends(box, axis) -> tuple[float, float]:
    return float(box.low[axis]), float(box.high[axis])


def movements() -> dict[str, np.ndarray]:
    """Set-points of five ways of moving a DLO, shape [16, 2] each."""
    back = np.array([[-0.04, 0.02]] * 2)
    whip = np.concatenate([back, [[0.06, 0.0]] * 4, [[0.0, 0.0]] * 10])
    lash = np.concatenate([back, [[0.06, 0.01]] * 4, [[-0.05, 0.0]] * 3, [[0.05, -0.01]] * 4, [[0.0, 0.0]] * 3])
    drop = np.concatenate([[[0.05, 0.0]] * 3, [[0.0, -0.06]] * 3, [[0.0, 0.06]] * 4, [[0.0, 0.0]] * 6])
    displaced = {"explore": np.asarray(exploratory_actions()), "whip": whip, "lash": lash, "drop": drop}
    targets = {name: np.asarray(START) + np.cumsum(actions, axis=0) for name, actions in displaced.items()}
    return targets | {"random": np.asarray(random_targets(jax.random.key(3), saturated=True))}


def knocked(states: State) -> np.ndarray:
    """Which cubes have moved by more than the distance of a hit in the plane of the picture, shape [..., 6]."""
    cubes = np.asarray(states.qpos)[..., SCENE.first_cube :].reshape(*states.qpos.shape[:-1], CUBES, 7)[..., [0, 2]]
    moved = np.linalg.norm(cubes - cubes[..., :1, :, :], axis=-1)
    return (moved > 0.6 * HIT_DISTANCE).any(axis=-2)  # the picture is 0.6 m wide there


def agreement() -> dict[str, dict[str, float]]:
    """Compare MJX with MuJoCo, and MuJoCo with itself."""
    scenes, moves = dlos(60), movements()
    count, names = len(scenes.length), list(moves)
    targets = np.stack(list(moves.values())).astype(np.float32)
    nudges = np.random.default_rng(0).normal(size=(12, *targets.shape), scale=1e-5)

    def program(engine):
        every = jax.jit(jax.vmap(jax.vmap(functools.partial(rollout, engine), (None, 0)), (0, None)))
        return lambda targets: jax.device_get(every(scenes, targets))

    native, mjx = program(NativeEngine(SCENE)), program(pick("mjx"))
    reference, others = native(targets), {"mjx": mjx(targets)}
    others |= {f"native, nudged {i + 1}": native(targets + nudge) for i, nudge in enumerate(nudges)}
    look = jax.jit(jax.vmap(jax.vmap(jax.vmap(functools.partial(frames, SCENE), (None, 0)), (None, 0))))
    first, found = look(scenes, reference.qpos), {}
    lowest = np.asarray(first.dlo)[..., 2].min(axis=(-1, -2))
    free = (np.abs(np.asarray(first.cubes - first.cubes[:, :, :1])).max(axis=(2, 3, 4)) < 1e-5) & (lowest > 0.01)
    print(f"{'same cubes knocked off, of ' + str(count):<30}" + "".join(f"{name:>9}" for name in names) + f"{'all':>7}")
    for name, states in others.items():
        same = (knocked(states) == knocked(reference)).all(axis=-1)
        per = {move: int(same[:, i].sum()) for i, move in enumerate(names)}
        distance = np.abs(np.asarray(look(scenes, states.qpos).dlo - first.dlo))[free].max()
        found[name] = per | {"all": int(same.sum()), "failed": int(states.failed[..., -1].sum())}
        found[name]["free motion, m"] = float(distance)
        print(f"{name:<30}" + "".join(f"{value:>9}" for value in per.values()) + f"{same.sum():>7}")
    hit = knocked(reference).any(axis=-1)
    found["scenes"] = {"all": hit.size, "cubes knocked off": int(hit.sum()), "nothing touched": int(free.sum())}
    print(f"cubes were knocked off in {hit.sum()}, nothing was touched in {free.sum()} of {hit.size}; there the DLOs")
    print(f"differ by at most {found['mjx']['free motion, m'] * 1e3:.4f} mm")
    print()
    return found


def failures() -> dict[str, list[bool]]:
    """Scenes that are reported as failed, of twelve undamped ones in steps of 5 ms, moved at random."""
    scene = Scene(chain=Chain(elements=16, retardation=0.0, viscosity=0.0), timestep=0.005)
    targets = movements()["random"].astype(np.float32)
    found = {}
    for name, engine in (("native", NativeEngine(scene)), ("mjx", pick("mjx", scene))):
        states = jax.jit(jax.vmap(functools.partial(rollout, engine), (0, None)))(dlos(12), targets)
        found[name] = np.asarray(states.failed[:, -1]).tolist()
        finite = bool(jnp.isfinite(states.qpos).all())
        print(f"undamped, {name}: {sum(found[name])} of 12 reported as failed; all states are finite: {finite}")
    print()
    return found


PARTS = {"speed": speed, "compiling": compiling, "agreement": agreement, "failures": failures}


def main() -> None:
    """Measure, print and save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", default=list(PARTS), help=f"of {', '.join(PARTS)} (default: all)")
    parser.add_argument("--engines", nargs="+", choices=NAMES[1:], default=["native", "mjx"], help="of `speed`")
    parser.add_argument("--batches", nargs="+", type=int, default=[1, 12, 100, 1024])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--out", type=Path, help="folder for a JSON file of each part")
    arguments = parser.parse_args()
    if unknown := set(arguments.parts) - set(PARTS):
        parser.error(f"parts: expected some of {', '.join(PARTS)}, got {', '.join(sorted(unknown))}")
    parts = PARTS | {"speed": functools.partial(speed, arguments.engines, arguments.batches, arguments.repeats)}
    made = environment()
    made["command_line"] = command_line(["python", "-m", "experiments.benchmarks.whip", *sys.argv[1:]])
    made["versions"] |= {name: importlib.metadata.version(name) for name in ("mujoco", "mujoco-mjx")}
    for name in arguments.parts:
        result = parts[name]()
        if arguments.out:
            arguments.out.mkdir(parents=True, exist_ok=True)
            atomic.write_json(arguments.out / f"{name}.json", {"measured": result} | made)


if __name__ == "__main__":
    main()
