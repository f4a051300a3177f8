"""Every way to draw from a posterior draws from the same distribution: the density that `log_prob` is, truncated."""

import csv
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jaxlfi
from jaxlfi.distributions.support import Support
from jaxlfi.envs import gaussian_linear
from jaxlfi.io import files as atomic
from jaxlfi.runs.load import load
from jaxlfi.tasks.task import Task
from tests.small import command, whole_runs  # noqa: F401 - a fixture

# Each way is tested by itself: in estimators/test_posterior.py, test_load.py, test_export.py.
pytestmark = pytest.mark.slow
N = 4096  # as many as the posterior mean takes
SEED = 3
FLAGS = (
    "--heuristic none --learning-rate 3e-3 --steps 100 --batch-size 50 --ensemble-size 1 --components 2 "
    "--reduction none --no-predictive --rounds 1 --simulations-per-round 100 --simulation-budget 100 --no-figures"
).split()
ESTIMATORS = {
    "mdn": ("--hidden", "16"),
    "maf": ("--hidden", "16", "--transforms", "1"),
    "nsf": ("--hidden", "16", "--transforms", "1"),
}


def task() -> Task:
    """The Gaussian task with one parameter inferred as its logarithm, observed at a corner of the support."""
    box = Support([0.5, -1.0], [3.0, 1.0])
    return Task(
        gaussian_linear.simulate,
        names=("first", "second"),
        supports={"ok": box},
        feasible=box,
        log=("first",),
        observation=gaussian_linear.MIXING @ np.array([0.5, 1.0], np.float32),
        name="corner",
    )


def _sampled(run, path, seed: int) -> np.ndarray:
    """Draws by `jaxlfi sample`, of whatever kind of file."""
    assert command("sample", run, "-n", N, "--seed", seed, "--out", path) == 0
    if path.suffix == ".npz":
        arrays = atomic.read_arrays(path)
        assert arrays["names"].tolist() == ["first", "second"]
        return arrays["theta"]
    if path.suffix == ".csv":
        with path.open(newline="") as file:
            heading, *rows = csv.reader(file)
        assert heading == ["first", "second"]
        return np.array(rows, float)
    posterior = pytest.importorskip("arviz").from_netcdf(str(path)).posterior
    return np.stack([posterior[name].values.ravel() for name in ("first", "second")], axis=1)


@pytest.fixture(scope="module", params=ESTIMATORS)
def ways(request, tmp_path_factory, whole_runs):  # noqa: F811 - the fixture
    """A run, and draws of its posterior in every way."""
    folder = tmp_path_factory.mktemp("draws") / "run"
    own = ("--estimator", request.param, *ESTIMATORS[request.param])
    reference = "tests.runs.test_draws:task"
    assert command("infer", reference, *FLAGS, *own, "--first-seed", SEED, "--out", folder) == 0
    loaded = load(folder)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", jaxlfi.SupportWarning)
        run = jaxlfi.infer(jax.random.key(SEED), task(), heuristic=jaxlfi.Fixed(), settings=loaded.settings)
    draws = {
        "infer": run.posterior.sample(jax.random.key(1), N),
        "inference space": run.space.to_natural(run.posterior.sample(jax.random.key(2), N, space="inference")),
        "load": loaded.posterior.sample(jax.random.key(3), N),
        "posterior_of": loaded.posterior_of(loaded.x).sample(jax.random.key(4), N),
        "posterior.npz": atomic.read_arrays(folder / "posterior.npz")["draws"],
    } | {
        suffix: _sampled(folder, folder.parent / f"draws{suffix}", seed)
        for seed, suffix in enumerate((".csv", ".npz", ".nc"), start=5)
    }
    return run, {name: np.asarray(value, float) for name, value in draws.items()}


def test_all_draws_are_of_one_distribution(ways):
    run, draws = ways
    assert 0.02 < float(run.posterior.mass_inside) < 0.99  # clipping would leave tens of draws on a bound
    assert draws["posterior.npz"].shape == (1000, 2)
    expected = draws["infer"]
    assert expected.shape == (N, 2) and len(draws) == 8
    for name, other in draws.items():
        for d in range(2):
            assert stats.ks_2samp(other[:, d], expected[:, d]).pvalue > 1e-4, (name, d)


def test_no_draws_lie_on_a_bound(ways):
    """Clipped ones would by the hundred; one of a density that is not zero there may come as near by chance."""
    _, draws = ways
    low, high = np.array([0.5, -1.0]), np.array([3.0, 1.0])
    gap = 1e-6 * (high - low)
    for name, theta in draws.items():
        assert np.sum((theta <= low + gap) | (theta >= high - gap)) <= 2, name
        assert np.all((theta > low - gap) & (theta < high + gap)), name


@pytest.mark.parametrize("space", ["natural", "inference"])
def test_the_draws_have_the_density_that_log_prob_says(ways, space):
    run, draws = ways
    theta = draws["infer"] if space == "natural" else np.asarray(run.space.to_inference(jnp.asarray(draws["infer"])))
    box = run.final_support(space)
    low, high, cells = np.asarray(box.low, float), np.asarray(box.high, float), 240
    edges = np.linspace(low, high, cells + 1)
    middle = 0.5 * (edges[1:] + edges[:-1])
    grid = np.stack(np.meshgrid(middle[:, 0], middle[:, 1], indexing="ij"), axis=-1)
    mass = np.exp(np.asarray(run.posterior.log_prob(jnp.asarray(grid), space=space), float)) * np.prod(
        (high - low) / cells
    )
    np.testing.assert_allclose(mass.sum(), 1.0, atol=0.03)
    for d in range(2):
        distribution = np.concatenate([[0.0], np.cumsum(mass.sum(axis=1 - d))])
        cdf = lambda values, d=d, distribution=distribution: np.interp(
            values, edges[:, d], distribution / distribution[-1]
        )
        assert stats.kstest(theta[:, d], cdf).statistic < 2.3 / np.sqrt(N), d
    outside = np.stack([low - 0.01, high + 0.01, [low[0] - 0.01, middle[0, 1]]])
    assert np.isneginf(np.asarray(run.posterior.log_prob(jnp.asarray(outside), space=space))).all()


def test_the_mean_and_the_maximum_are_those_of_the_draws(ways):
    run, draws = ways
    posterior, theta = run.posterior, draws["infer"]
    np.testing.assert_allclose(posterior.mean(), theta.mean(0), atol=5 * theta.std(0).max() / np.sqrt(N))
    best = posterior.map()
    assert float(posterior.log_prob(best)) >= float(np.max(posterior.log_prob(jnp.asarray(theta)))) - 1e-3


@pytest.mark.parametrize("n", [-1, 0, 2.5, True, "10"])
def test_a_number_of_draws_is_whole_and_positive(ways, n):
    run, _ = ways
    with pytest.raises(ValueError, match=r"^n: expected a whole number of at least 1, got ") as refused:
        run.posterior.sample(jax.random.key(0), n)
    assert "\n" not in str(refused.value)


def test_bad_arguments_are_named(ways):
    posterior = ways[0].posterior
    with pytest.raises(ValueError, match=r"^theta: expected shape \[\.\.\., 2\], got \[3\]$"):
        posterior.log_prob([0.5, 0.5, 0.5])
    with pytest.raises(ValueError, match=r"^theta: expected shape \[\.\.\., 2\], got \[\]$"):
        posterior.log_prob(0.5)
    with pytest.raises(ValueError, match=r"^key: expected one key such as jax\.random\.key\(0\), or a seed, got -1$"):
        posterior.sample(-1, 10)
    with pytest.raises(ValueError, match=r"^space: expected 'natural' or 'inference', got 'log'$"):
        posterior.sample(jax.random.key(0), N, space="log")
    assert np.isneginf(posterior.log_prob([-1.0, 0.0]))  # a log parameter that is not positive has no density
