"""All benchmarks, each in its own process: `python -m experiments.benchmarks`."""

import subprocess
import sys

for name in ("first_answer", "lotka_volterra", "training", "grid", "policies", "executors", "mujoco"):
    print(f"# {name}\n", flush=True)
    subprocess.run([sys.executable, "-m", f"experiments.benchmarks.{name}"], check=True)
