"""NPE of BayesFlow 2 (Radev et al. 2023), on its JAX backend, with the defaults of its `BasicWorkflow`.

The defaults are a coupling flow, 100 epochs, batches of 32, and a learning rate with warm-up and decay. Two settings
differ from the defaults, both as BayesFlow's guides advise: summaries are standardised like the parameters, and
parameters with a uniform prior are constrained to their box, so that no draw lies outside. Failed simulations are
dropped.
"""

import logging
import os
import time

os.environ.setdefault("KERAS_BACKEND", "jax")  # before keras is imported

import jax
import numpy as np

from experiments.sota.cases import Case, Simulator
from experiments.sota.measures import DRAWS, Found, points
from jaxlfi.bayessim.keys import key_of, run_keys

try:
    import bayesflow
    import keras
except ImportError as error:
    raise ImportError("methods of BayesFlow: expected bayesflow, got none: pip install -e '.[bench]'") from error

logging.getLogger("bayesflow").setLevel(logging.WARNING)


def infer(method: str, case: Case, simulations: int) -> Found:
    """The posterior of a case; the time covers simulating, building, compiling, training and drawing."""
    key_theta, key_simulate = jax.random.split(jax.random.fold_in(run_keys(key_of(case.seed)).run, 1))
    keras.utils.set_random_seed(case.seed)
    theta = np.asarray(_prior_draws(key_theta, case, simulations))
    simulator = Simulator(case.task, key_simulate)
    simulator.compile(theta)
    began = time.perf_counter()
    x = simulator(theta)
    valid = np.isfinite(x).all(axis=1)
    workflow = bayesflow.BasicWorkflow(
        adapter=_adapter(case), standardize=["inference_variables", "inference_conditions"]
    )
    workflow.fit_offline({"theta": theta[valid], "x": x[valid]}, verbose=0)
    condition = {"x": case.x[None]}
    draws = workflow.sample(num_samples=DRAWS, conditions=condition)["theta"][0]
    seconds = time.perf_counter() - began
    where = points(case)
    log_prob = workflow.log_prob({"theta": where, "x": np.repeat(case.x[None], len(where), axis=0)})
    return Found(np.asarray(draws), _held(case, where, log_prob), seconds, 0.0, simulator.simulated, simulator.failed)


def _prior_draws(key: jax.Array, case: Case, count: int) -> jax.Array:
    if case.prior is None:
        return case.box.sample(key, count)
    return case.prior.sample(seed=key, sample_shape=(count,))


def _adapter(case: Case):
    adapter = bayesflow.Adapter().convert_dtype("float64", "float32")
    if case.prior is None:
        adapter = adapter.constrain("theta", lower=np.array(case.box.low), upper=np.array(case.box.high))
    return adapter.rename("theta", "inference_variables").rename("x", "inference_conditions")


def _held(case: Case, theta: np.ndarray, log_prob: np.ndarray) -> np.ndarray:
    """The log-density, minus infinity outside of the box, where the map to it is not defined."""
    inside = np.all((theta >= np.asarray(case.box.low)) & (theta <= np.asarray(case.box.high)), axis=1)
    return np.where(inside | (case.prior is not None), np.asarray(log_prob).reshape(len(theta)), -np.inf)
