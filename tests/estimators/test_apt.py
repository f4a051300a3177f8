"""Automatic posterior transformation: Algorithm 1 with an atomic loss and flows."""

import csv
import json
import shutil
from pathlib import Path

import chex
import distrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import ks_2samp

import jaxlfi
from jaxlfi.bayessim import algorithm
from jaxlfi.bayessim.presets import METHODS, QUICK
from jaxlfi.bayessim.settings import Settings
from jaxlfi.cli import parser as cli
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.envs import gaussian_linear
from jaxlfi.estimators.base import Network, untrained
from jaxlfi.estimators.density import EnsembleDensity
from jaxlfi.estimators.flow_estimators import FlowEstimator, MaskedFlow
from jaxlfi.heuristics import Fixed
from jaxlfi.runs.result import DRAWS
from jaxlfi.tasks.task import Task
from tests.bayessim.test_algorithm import EXACT, MODEST, TASK, X, infer, run_of, whitened
from tests.small import read_ledger

ATOMIC = MODEST.replace(hidden=(16, 16), steps=1000, batch_size=100, loss="atomic")
# --------------------------------------------------------------------------------------- the proposals cancel


@pytest.mark.slow  # test_atomic.py tests in the quick suite that the posterior minimises the loss under any proposal
def test_the_atomic_loss_needs_no_correction_for_its_proposals():
    """Two later rounds have proposals like the posterior: with the likelihood as the loss they count the data again
    and halve the covariance; the atomic loss keeps it. Measured for sixteen runs: traces of 1.9 to 2.4, and of 0.9 to
    1.1 with the likelihood.
    """
    settings = Settings(
        estimator=ATOMIC, rounds=3, simulations_per_round=500, simulation_budget=500, restriction="reject"
    )
    state, info = infer(settings, ("ok",) * 2, 1)
    np.testing.assert_allclose(info.correction.mass_inside[:, -1], 1.0, atol=0.02)
    for i in range(2):
        mean, covariance = whitened(run_of(state.belief.mixture, i))
        np.testing.assert_allclose(mean, 0, atol=0.35)
        assert 1.5 < np.trace(covariance) < 2.8


@pytest.mark.slow
def test_a_prior_of_the_tasks_own_is_the_posteriors():
    """The prior is Gaussian, and so is the posterior; the proposals of later rounds are far from the prior."""
    prior_scale = np.array([0.5, 0.8], np.float32)
    box = Support([-3.0, -4.0], [3.0, 4.0])
    task = Task(
        gaussian_linear.simulate,
        names=("first", "second"),
        supports={"ok": box},
        feasible=box,
        prior=distrax.MultivariateNormalDiag(jnp.zeros(2), jnp.asarray(prior_scale)),
    )
    settings = Settings(
        estimator=ATOMIC, rounds=3, simulations_per_round=500, simulation_budget=500, restriction="reject"
    )

    def one(key):
        return algorithm.run(key, task, settings, Fixed(), X, box)[0].belief.mixture

    learnt = jax.jit(one)(jax.random.key(2))
    precision = np.linalg.inv(np.asarray(EXACT.covariance, np.float64)) + np.diag(prior_scale.astype(np.float64) ** -2)
    covariance = np.linalg.inv(precision)
    mean = covariance @ np.linalg.inv(np.asarray(EXACT.covariance, np.float64)) @ np.asarray(EXACT.mean)
    # Without the prior the mean would be off by this much; the test must see it.
    scale = np.sqrt(np.diag(covariance))
    assert np.abs((np.asarray(EXACT.mean) - mean) / scale).max() > 1.0
    np.testing.assert_allclose((np.asarray(learnt.mean) - mean) / scale, 0, atol=0.4)
    np.testing.assert_allclose(np.diag(np.asarray(learnt.covariance)) / scale**2, 1.0, atol=0.5)


# -------------------------------------------------------------------------------------- flows in the same loop

SMALL_RUN = (
    "infer gaussian_linear --method apt --estimator maf --transforms 1 --hidden 8 8 --epochs 3 --batch-size 10 "
    "--learning-rate 1e-2 --validation 0.2 --patience 0 --rounds 2 --simulations-per-round 30 --simulation-budget 30 "
    "--support ok --heuristic edge --no-predictive --no-figures --no-cache --out"
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run of a small flow, made on the command line."""
    path = tmp_path_factory.mktemp("apt") / "run"
    assert cli.main([*SMALL_RUN.split(), str(path)]) == 0
    return path


KEPT = Path(__file__).parents[1] / "golden/formats/4/flow"
"""A run of a flow, to test which requests are refused."""


@pytest.fixture(scope="module")
def flow_run(folder):
    """Runs of X with those settings, whose rounds use the program that the command line compiled."""
    settings = jaxlfi.load(folder).settings
    run = lambda: jaxlfi.infer(jax.random.key(0), TASK, X, support="ok", heuristic=jaxlfi.Edge(), settings=settings)
    return run, run()


@pytest.fixture(scope="module")
def network(flow_run):
    """The flow after two rounds."""
    return jax.tree.map(jnp.asarray, flow_run[1].network)


SUPPORT = Support([-1.0, -2.0], [2.0, 1.5])
condition = jax.jit(Network.condition)


@pytest.fixture(scope="module")
def free_draws(network) -> np.ndarray:
    """40000 draws of the flow, not truncated."""
    flow = condition(network, X, SUPPORT, jax.random.key(0)).density
    return np.asarray(jax.jit(lambda flow: flow.sample(jax.random.key(4), 40000))(flow))


@pytest.mark.slow
def test_a_flow_runs_in_the_same_loop_and_repeats(flow_run):
    run, first = flow_run
    again = run()
    estimator = first.settings.estimator
    assert isinstance(estimator, MaskedFlow) and estimator.loss == "combined"
    same = lambda run: (run.belief, run.network, run.dataset, run.history | {"seconds": None})
    chex.assert_trees_all_equal(same(again), same(first))
    chex.assert_tree_all_finite(first.belief)
    assert first.belief.mixture.means.shape == (estimator.ensemble_size * estimator.components, 2)
    loss, mass = first.history["loss"], first.history["mass_inside"]
    assert loss.shape == (2, estimator.ensemble_size, estimator.epochs) and np.isfinite(loss).all()
    assert np.all((mass > 0) & (mass <= 1))


@pytest.mark.slow
def test_a_flows_mixture_has_the_moments_of_its_draws_inside(network, free_draws):
    posterior = condition(network, X, SUPPORT, jax.random.key(1))
    kept = free_draws[np.asarray(SUPPORT.contains(free_draws))]
    # Both are Monte Carlo estimates, of 10000 and of 40000 draws.
    assert float(posterior.mass_inside) == pytest.approx(
        len(kept) / 40000, abs=5 * 0.5 * np.sqrt(1 / 10000 + 1 / 40000)
    )
    assert 0.05 < float(posterior.mass_inside) < 0.95  # a test without draws outside would test nothing
    scale = kept.std(0)
    np.testing.assert_allclose((np.asarray(posterior.mixture.mean) - kept.mean(0)) / scale, 0, atol=0.2)
    np.testing.assert_allclose(np.sqrt(np.diag(np.asarray(posterior.mixture.covariance))) / scale, 1, atol=0.15)


def sampled(posterior, seed: int) -> np.ndarray:
    """4000 draws, made as many at a time as are saved with a run."""
    keys = jax.random.split(jax.random.key(seed), 4000 // DRAWS)
    return np.concatenate([posterior.sample(key, DRAWS) for key in keys])


@pytest.mark.slow
def test_draws_of_the_posterior_are_the_flows_own_truncated_to_the_box(network, free_draws):
    posterior = condition(network, X, SUPPORT, jax.random.key(0))
    draws = sampled(posterior, 3)
    assert draws.shape == (4000, 2) and np.asarray(SUPPORT.contains(draws)).all()
    assert len(np.unique(draws, axis=0)) == 4000
    kept = free_draws[np.asarray(SUPPORT.contains(free_draws))]
    for d in range(2):
        assert ks_2samp(draws[:, d], kept[:, d]).pvalue > 1e-4
    # In a box that the flow never reaches, draws are picked from those of its truncated mixture.
    far = condition(network, X, Support([8.0, 8.0], [9.0, 9.0]), jax.random.key(0))
    there = np.asarray(far.sample(jax.random.key(3), DRAWS))
    assert float(far.mass_inside) < 1e-3 and np.asarray(far.support.contains(there)).all()
    assert len(np.unique(there, axis=0)) > 0.9 * DRAWS and (there > 8.0).all(1).mean() > 0.99


def test_networks_of_an_ensemble_are_scaled_alike():
    estimator = MaskedFlow(hidden=(8, 8), transforms=1, ensemble_size=2)
    scale = Support([-10.0, -10.0], [10.0, 10.0])

    @jax.jit
    def drawn(key_start, key_draw):
        network = untrained(key_start, estimator, 2, scale, TASK.space)
        narrow = network.theta_normaliser.replace(mean=jnp.array([0.5, -0.5]), scale=jnp.array([0.01, 0.02]))
        return estimator.density(network.replace(theta_normaliser=narrow), jnp.zeros(2)).sample(key_draw, 2000)

    draws = np.asarray(drawn(jax.random.key(0), jax.random.key(1)))
    # Both start as standard normals, which the normaliser and the box shift and scale.
    np.testing.assert_allclose(draws.mean(0), [5.0, -5.0], atol=0.03)
    np.testing.assert_allclose(draws.std(0), [0.1, 0.2], rtol=0.1)


def test_networks_of_an_ensemble_take_part_in_random_order():
    one = GaussianMixture(jnp.zeros(1), jnp.zeros((1, 1)), jnp.ones((1, 1, 1)))
    each = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), one).replace(means=jnp.array([[[-50.0]], [[50.0]]]))
    ensemble = EnsembleDensity(each, jnp.zeros(1), jnp.ones(1), jnp.log(jnp.array([0.5, 0.5])))
    draws = jax.jit(lambda key: ensemble.sample(key, 2000))(jax.random.key(1))
    first = np.asarray(draws)[:, 0] < 0
    assert abs(first.mean() - 0.5) < 5 * 0.5 / np.sqrt(2000)
    assert abs((first[1:] == first[:-1]).mean() - 0.5) < 5 * 0.5 / np.sqrt(1999)


# ------------------------------------------------------------------------------------------ methods and folders


def test_methods_keep_the_budget():
    apt, npe, tsnpe = (METHODS[name](QUICK) for name in ("apt", "npe", "tsnpe"))
    assert (apt.rounds, apt.simulations_per_round, apt.estimator.loss) == (10, 100, "combined")
    assert (npe.rounds, npe.simulations_per_round, npe.estimator.loss) == (1, 1000, "likelihood")
    assert (tsnpe.rounds, tsnpe.simulations_per_round, tsnpe.estimator.loss) == (10, 100, "likelihood")
    for settings in (apt, npe, tsnpe):
        assert isinstance(settings.check().estimator, FlowEstimator)
        assert (settings.inflation, settings.min_rounds) == (1.0, 0)
    assert METHODS["bayessim"](QUICK) is QUICK
    assert METHODS["npe"](QUICK.replace(rounds=3)).simulations_per_round == 300


@pytest.mark.slow  # test_formats.py draws from flows of golden folders, and test_draws.py with the command
def test_a_run_can_be_sampled(folder, tmp_path):
    n = str(DRAWS)
    assert cli.main(["sample", str(folder), "-n", n, "--out", str(tmp_path / "draws.csv")]) == 0
    with open(tmp_path / "draws.csv") as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["first", "second"] and len(rows) == DRAWS + 1
    assert cli.main(["sample", str(folder), "-n", n, "--out", str(tmp_path / "draws.npz")]) == 0
    with np.load(tmp_path / "draws.npz") as arrays:
        np.testing.assert_allclose(np.array(rows[1:], float), arrays["theta"], rtol=1e-6)
        belief = jaxlfi.load(folder).belief
        assert np.asarray(belief.support.contains(jnp.asarray(arrays["theta"], jnp.float32))).all()
        first = arrays["theta"]
    posterior = jaxlfi.load(folder).posterior
    np.testing.assert_allclose(posterior.sample(jax.random.key(0), DRAWS), first, rtol=1e-5, atol=1e-6)
    other = np.asarray(posterior.sample(jax.random.key(1), DRAWS))
    assert np.abs(first - other).max() > 1e-3


@pytest.mark.slow
def test_a_library_run_draws_from_the_flow_and_saves_it(flow_run, tmp_path):
    run = flow_run[1]
    draws = np.asarray(run.posterior.sample(jax.random.key(0), DRAWS))
    run.save(tmp_path / "run")
    loaded = jaxlfi.load(tmp_path / "run", task=TASK).posterior
    np.testing.assert_allclose(loaded.sample(jax.random.key(0), DRAWS), draws, rtol=1e-5, atol=1e-5)
    assert loaded.space.names == ("first", "second") and 0 < float(loaded.mass_inside) <= 1
    theta = draws[:20]
    np.testing.assert_allclose(loaded.log_prob(theta), run.posterior.log_prob(theta), rtol=1e-4, atol=1e-4)


@pytest.mark.slow  # tests/runs/test_folder.py tests this with a mixture
def test_the_ledger_says_how_much_of_the_posterior_is_inside(folder):
    ledger = read_ledger(folder)
    assert all(0 <= line["mass_inside"] <= 1 for line in ledger)


@pytest.mark.parametrize("number", ["0", "-3"])
def test_no_draws_are_refused(number, tmp_path, capsys):
    out = tmp_path / "none.csv"
    assert cli.main(["sample", str(KEPT), "-n", number, "--out", str(out)]) == 2
    assert "at least 1" in capsys.readouterr().err and not out.exists()


def test_bad_files_and_names_are_one_line(tmp_path, capsys):
    out = tmp_path / "there.csv"
    out.write_text("mine")
    for arguments, message in (
        (["sample", str(KEPT), "--out", str(out)], "exists"),
        (["sample", str(KEPT), "--out", str(tmp_path / "draws.txt")], ".csv or .npz"),
        (["sample", str(tmp_path)], "config.json"),
    ):
        assert cli.main(arguments) == 2
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1
    assert out.read_text() == "mine"


@pytest.mark.parametrize("damage", ["cut", "foreign", "missing"])
def test_a_damaged_network_is_reported(tmp_path, capsys, damage):
    copy = tmp_path / "copy"
    shutil.copytree(KEPT, copy)
    network = copy / "network.npz"
    if damage == "cut":
        network.write_bytes(network.read_bytes()[:100])
    elif damage == "foreign":
        config = json.loads((copy / "config.json").read_text())
        config["settings"]["estimator"]["hyperparameters"]["hidden"] = [9, 9]
        (copy / "config.json").write_text(json.dumps(config))
    else:
        network.unlink()
    assert cli.main(["sample", str(copy)]) == 2
    error = capsys.readouterr().err
    assert "network.npz" in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--estimator", "glow"], "estimator"),
        (["--loss", "hinge"], "loss"),
        (["--method", "apt", "--hidden", "8", "9"], "equal width"),
    ],
)
def test_unknown_parts_are_refused(arguments, message, tmp_path, capsys):
    out = tmp_path / "none"
    assert cli.main(["infer", "gaussian_linear", *arguments, "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1 and not out.exists()
