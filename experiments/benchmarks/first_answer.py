"""Time until a user's first answer: `python -m experiments.benchmarks.first_answer`.

Each row is a separate process, with its wall time from start to end:

* README's spring in Python: on a machine that has never run jaxlfi (no compiled program is cached), in a second
  process, and with another simulator of the same shapes;
* `jaxlfi infer` on it without and with figures, with cached programs;
* refusals: a folder that exists, an unknown task, a wrong argument.

Phases of the Python rows are seconds of: importing; tracing, lowering and compiling, as reported by jax (several
programs compile in parallel, so these may add up to more than the elapsed time); the rounds; the summary; and 1,000
draws. Run it on an otherwise idle machine.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SPRING = """
import time, json, sys
begun = time.perf_counter()
import jax, jaxlfi
import jax.numpy as jnp

def simulate(key, theta):
    stiffness, damping = theta
    times, frequency = jnp.linspace(0.0, 6.0, 40), jnp.sqrt(stiffness - damping**2 / 4)
    clean = AMPLITUDE * jnp.exp(-damping * times / 2) * WAVE(frequency * times)
    return clean + 2 * jax.random.normal(key, times.shape)

task = jaxlfi.Task(simulate, names=("stiffness", "damping"), units=("N/m", "N s/m"),
                   supports={"guess": jaxlfi.Support([1.0, 0.1], [4.0, 1.0])},
                   feasible=jaxlfi.Support([1.0, 0.01], [20.0, 2.0]), truth=jnp.array([6.0, 0.5]))
"""
MEASURED = """
import collections
spent = collections.Counter()
names = {"jaxpr_trace": "trace", "jaxpr_to_mlir_module": "lower", "backend_compile": "compile"}

def count(event, seconds, **_):
    for part, name in names.items():
        if part in event:
            spent[name] += seconds

jax.monitoring.register_event_duration_secs_listener(count)
x_real = simulate(jax.random.key(1), jnp.array([6.0, 0.5]))
times = {"import": time.perf_counter() - begun}

def timed(name, of):
    start = time.perf_counter()
    result = of()
    times[name] = time.perf_counter() - start
    return result

run = timed("infer", lambda: jaxlfi.infer(jax.random.key(0), task, x_real, heuristic=jaxlfi.Edge()))
times["rounds"] = float(run.history["seconds"].sum())
timed("summary", lambda: str(run.summary()))
timed("draws", lambda: jax.block_until_ready(run.posterior.sample(jax.random.key(2), 1000)))
print(json.dumps(times | spent))
"""
COLUMNS = ("import", "infer", "trace", "lower", "compile", "rounds", "summary", "draws")


def spring(amplitude: float = 100.0, wave: str = "jnp.cos") -> str:
    """The first part of the script; other arguments give another simulator of the same shapes."""
    return SPRING.replace("AMPLITUDE", str(amplitude)).replace("WAVE", wave)


def timed(words: list[str], folder: Path) -> tuple[float, str]:
    """Duration of a process in seconds, and its output."""
    environment = os.environ | {"XDG_CACHE_HOME": str(folder / "cache"), "PYTHONPATH": f"{folder}:{Path.cwd()}"}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    begun = time.perf_counter()
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    return time.perf_counter() - begun, done.stdout


def main() -> None:
    """Measure, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=1, help="of the processes that find their programs cached")
    repeats = parser.parse_args().repeats
    rows: list[tuple[str, float, str]] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)

        def row(label: str, *words: str) -> None:
            rows.append((label, *timed([sys.executable, *words], folder)))

        row("Python, nothing cached", "-c", spring() + MEASURED)
        for _ in range(repeats):
            row("Python, second process", "-c", spring() + MEASURED)
        row("Python, another simulator of the same shapes", "-c", spring(90.0, "jnp.sin") + MEASURED)
        (folder / "spring_task.py").write_text(spring())
        infer = ("-m", "jaxlfi", "infer", "spring_task:task", "--heuristic", "edge", "--quiet")
        row("command line, without figures, nothing of its own cached", *infer, "--no-figures", "--out", "a")
        for number in range(repeats):
            row("command line, without figures, again", *infer, "--no-figures", "--out", f"b{number}")
            row("command line, with figures, again", *infer, "--out", f"c{number}")
        row("refused: a folder that exists", *infer, "--out", "a")
        row("refused: an unknown task", "-m", "jaxlfi", "infer", "no_such_task", "--out", "d")
        row("refused: a wrong argument", *infer, "--rounds", "0", "--out", "e")
        row("jaxlfi --help", "-m", "jaxlfi", "--help")
    print("| process | s | " + " | ".join(COLUMNS) + " |")
    print("|---|---|" + "---|" * len(COLUMNS))
    for label, seconds, printed in rows:
        phases = json.loads(printed.splitlines()[-1]) if label.startswith("Python") else {}
        cells = [f"{phases[column]:.2f}" if column in phases else "" for column in COLUMNS]
        print(f"| {label} | {seconds:.1f} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
