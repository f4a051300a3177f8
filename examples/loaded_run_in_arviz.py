"""A run that is saved, loaded again, and passed to ArviZ for its summaries and plots.

pip install 'jaxlfi[arviz]'
python examples/loaded_run_in_arviz.py
"""

import tempfile
from pathlib import Path

import arviz
import jax

import jaxlfi
from jaxlfi.envs.gaussian_linear import task
from jaxlfi.runs.export import to_inference_data

# The posterior is a single Gaussian, so one component is enough.
ESTIMATOR = jaxlfi.QUICK.estimator.replace(components=1, ensemble_size=2, prune=0.0, learning_rate=3e-3)
SETTINGS = jaxlfi.QUICK.replace(
    estimator=ESTIMATOR, rounds=1, simulations_per_round=4000, simulation_budget=4000, predictive=False
)


def main():
    """Save, load, export."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "gaussian"
        run = jaxlfi.infer(jax.random.key(0), task(), heuristic=jaxlfi.Fixed(), settings=SETTINGS)
        run.save(folder)  # `jaxlfi infer ... --out DIR` writes the same files
        print("kept:", ", ".join(sorted(path.name for path in folder.iterdir())))

        loaded = jaxlfi.load(folder, task())
        print("the same mixture:", run.mixture.mean, loaded.mixture.mean)
        data = to_inference_data(folder, n=1000)  # on the command line: jaxlfi sample DIR -n 1000 --out draws.nc
    summary = arviz.summary(data, kind="stats")
    print(f"truth: {dict(zip(task().names, task().truth.tolist(), strict=True))}\n{summary}")
    return run, loaded, summary


if __name__ == "__main__":
    main()
