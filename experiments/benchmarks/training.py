"""Speed of training and of whole runs: `python -m experiments.benchmarks.training`.

Prints

* milliseconds per gradient step (batch of 100, four full-covariance Gaussians in four dimensions), for the network of
  each preset, ours and PyTorch's (needs the `bench` extra), compared with the lower bound of its matrix products: their
  operations, divided by the rate at which this machine multiplies large matrices;
* a whole inference run of `quick` compiled as one program, compared with its rounds called one by one, and with its
  parts (proposals, simulation, update) called one by one;
* seconds of compilation, cold and from the cache on disk.

Best and median of several calls are shown, since other programs may share the machine. One device, all its cores.
"""

import importlib.util
import itertools
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.bayessim import algorithm
from jaxlfi.bayessim.keys import init_key, round_keys
from jaxlfi.bayessim.presets import PRESETS
from jaxlfi.envs.lotka_volterra import task as lotka_volterra
from jaxlfi.estimators import dataset
from jaxlfi.estimators.base import untrained
from jaxlfi.estimators.mixture_network import MixtureNetwork
from jaxlfi.estimators.training import fit
from jaxlfi.heuristics import Edge
from jaxlfi.tasks.simulation import simulate, within_budget

BATCH, DIM, OBS = 100, 4, 9
ROWS = 1000
REPEATS = 5


def measure(calls: dict[str, Callable[[], object]], repeats: int = REPEATS) -> dict[str, tuple[float, float]]:
    """Best and median seconds of calls, made in turn so that other load affects all, after one warm-up call."""
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for repeat in range(repeats + 1):
        for name, call in calls.items():
            start = time.perf_counter()
            call()
            if repeat:
                seconds[name].append(time.perf_counter() - start)
    return {name: (min(of), statistics.median(of)) for name, of in seconds.items()}


def products(estimator: MixtureNetwork) -> int:
    """Floating-point operations of a step's matrix products: forward, and twice that backward."""
    heads = estimator.components * (1 + DIM + DIM * (DIM + 1) // 2)
    layers = (OBS, *estimator.hidden, heads)
    return 3 * 2 * BATCH * sum(a * b for a, b in itertools.pairwise(layers))


def matrix_rate() -> float:
    """Operations per second of a large float32 matrix product."""
    a = jnp.ones((2048, 2048))
    multiply = jax.jit(jnp.matmul)
    ((best, _),) = measure({"": lambda: jax.block_until_ready(multiply(a, a))}).values()
    return 2 * 2048**3 / best


def our_steps(estimator: MixtureNetwork, steps: int) -> Callable[[], object]:
    """A function that runs a number of our gradient steps, as one fit."""
    estimator = estimator.replace(epochs=steps * BATCH // ROWS, steps=0, ensemble_size=1)
    task = lotka_volterra()
    key = jax.random.key(0)
    data = dataset.Dataset(
        theta=task.feasible.sample(key, ROWS),
        x=jax.random.normal(key, (ROWS, OBS)),
        round=jnp.zeros(ROWS, jnp.int32),
        weight=jnp.ones(ROWS),
        size=jnp.asarray(ROWS),
    )
    network = untrained(key, estimator, OBS, task.inference.feasible, task.space).begun(data)[0]
    run = jax.jit(lambda key: fit(key, network, data, jnp.ones(ROWS), ROWS)[1].loss)
    return lambda: jax.block_until_ready(run(key))


def torch_steps(estimator: MixtureNetwork, steps: int, fused: bool) -> Callable[[], object]:
    """The same steps as a PyTorch user would write them, with Adam's default or fused kernel."""
    import torch

    components, below = estimator.components, DIM * (DIM - 1) // 2
    activation = {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU, "silu": torch.nn.SiLU}[estimator.activation]
    layers: list[torch.nn.Module] = []
    width = OBS
    for units in estimator.hidden:
        layers += [torch.nn.Linear(width, units), activation()]
        width = units
    network = torch.nn.Sequential(*layers, torch.nn.Linear(width, components * (1 + 2 * DIM + below)))
    optimiser = torch.optim.Adam(network.parameters(), lr=float(estimator.learning_rate), fused=fused)
    x, theta = torch.randn(ROWS, OBS), torch.rand(ROWS, DIM) * 2 - 1
    row, column = torch.tril_indices(DIM, DIM, -1)

    def loss_of(x, theta):
        parts = torch.split(network(x), [components, components * DIM, components * DIM, components * below], dim=-1)
        logits, means, diagonal, lower = parts
        factor = torch.diag_embed(torch.exp(diagonal.view(-1, components, DIM)))
        factor[..., row, column] = lower.view(-1, components, below)
        mixture = torch.distributions.MixtureSameFamily(
            torch.distributions.Categorical(logits=logits),
            torch.distributions.MultivariateNormal(
                means.view(-1, components, DIM), scale_tril=factor, validate_args=False
            ),
        )
        return -mixture.log_prob(theta).mean()

    def train():
        for _ in range(steps):
            rows = torch.randint(ROWS, (BATCH,))
            optimiser.zero_grad()
            loss_of(x[rows], theta[rows]).backward()
            optimiser.step()

    return train


def step_table() -> None:
    """Print the milliseconds per gradient step."""
    rate = matrix_rate()
    print(f"Large matrix products run at {rate / 1e9:.0f} GFLOP/s here.\n")
    torch_is_here = importlib.util.find_spec("torch") is not None
    print(f"{'gradient step, ms':<24}{'best':>12}{'median':>10}")
    for preset, steps in (("quick", 500), ("paper", 40)):
        estimator = PRESETS[preset].estimator
        calls = {"ours": our_steps(estimator, steps)}
        if torch_is_here:
            calls["PyTorch"] = torch_steps(estimator, steps, fused=False)
            calls["PyTorch, fused Adam"] = torch_steps(estimator, steps, fused=True)
        print(f"{preset}, {'x'.join(map(str, estimator.hidden))}; floor {products(estimator) / rate * 1e3:.3f}")
        for name, (best, median) in measure(calls).items():
            print(f"  {name:<22}{best / steps * 1e3:>12.3f}{median / steps * 1e3:>10.3f}")
    if not torch_is_here:
        print("PyTorch is not installed: pip install 'jaxlfi[bench]'")
    print()


def run_table() -> None:
    """Print the seconds of a whole run, as one program or several."""
    task, settings, heuristic = lotka_volterra(), PRESETS["quick"], Edge()
    support = task.support("misspecified")
    observed = jax.jit(lambda key: task.summary(task.simulate(key, task.truth)[0]))(jax.random.key(1))
    key = jax.random.key(0)

    whole = jax.jit(lambda key: algorithm.run(key, task, settings, heuristic, observed, support))
    start = jax.jit(lambda key: algorithm.init(key, task, support, settings, observed))
    step = jax.jit(lambda keys, state, i: algorithm.step(keys, task, settings, heuristic, observed, state, i))
    propose = jax.jit(lambda key, belief: algorithm.propose(key, task.inference.prior, settings, belief))
    attempt = jax.jit(lambda key, theta: simulate(key, task, theta))

    @jax.jit
    def update(key, state, i, theta, x, failure):
        simulations = within_budget(theta, x, failure, settings.simulations_per_round)
        return algorithm.update(key, task, settings, heuristic, observed, state, i, simulations)

    spent = dict.fromkeys(("proposals", "simulation", "update"), 0.0)

    def stepwise():
        state = start(init_key(key))
        for i in range(settings.rounds):
            state, _ = step(round_keys(key, i), state, i)
        jax.block_until_ready(state)

    def timed(name, call, *arguments):
        begin = time.perf_counter()
        result = jax.block_until_ready(call(*arguments))
        spent[name] += time.perf_counter() - begin
        return result

    def by_parts():
        spent.update(dict.fromkeys(spent, 0.0))
        state = start(init_key(key))
        for i in range(settings.rounds):
            keys = round_keys(key, i)
            theta = timed("proposals", propose, keys.propose, state.belief)
            x, failure = timed("simulation", attempt, keys.simulate, theta)
            state, _ = timed("update", update, keys.update, state, i, theta, x, failure)

    print(f"{'a whole run of quick, by itself':<40}{'best, s':>10}{'median, s':>11}")
    calls = {
        "one compiled program": lambda: jax.block_until_ready(whole(key)),
        "its rounds, one call each": stepwise,
        "its parts, one call each": by_parts,
    }
    for name, (best, median) in measure(calls).items():
        print(f"{name:<40}{best:>10.2f}{median:>11.2f}")
    print("parts of the last: " + ", ".join(f"{name} {seconds:.2f} s" for name, seconds in spent.items()) + "\n")


_COMPILE_ONE_RUN = """
import time
from jaxlfi.io import compile_cache
compile_cache.enable()
import jax, jax.numpy as jnp
from jaxlfi.envs.lotka_volterra import task as factory
from jaxlfi.bayessim import algorithm
from jaxlfi.heuristics import Edge
from jaxlfi.bayessim.presets import QUICK
task = factory()
run = jax.jit(lambda key: algorithm.run(key, task, QUICK, Edge(), jnp.zeros(9), task.support("ok")))
lowered = run.lower(jax.random.key(0))
start = time.perf_counter()
lowered.compile()
print(time.perf_counter() - start)
"""


def compile_table() -> None:
    """Print the seconds of compiling a whole run, in fresh processes that share an initially empty cache."""
    print(f"{'compiling a whole run of quick':<40}{'s':>10}")
    with tempfile.TemporaryDirectory() as cache:
        environment = {**os.environ, "XDG_CACHE_HOME": cache}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        for name in ("cold", "from the cache on disk"):
            done = subprocess.run(
                [sys.executable, "-c", _COMPILE_ONE_RUN], env=environment, capture_output=True, text=True, check=True
            )
            print(f"{name:<40}{float(np.float64(done.stdout.strip())):>10.2f}")
    print()


def main() -> None:
    """Print all three tables."""
    step_table()
    run_table()
    compile_table()


if __name__ == "__main__":
    main()
