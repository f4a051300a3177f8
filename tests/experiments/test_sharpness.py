"""The benchmark of sharpness: exact posteriors against closed forms, measures of known draws, and runs that resume."""

import hashlib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special, stats

from experiments.sharpness import __main__ as command
from experiments.sharpness import held_out, measures, oracle, references, runner, series, tables
from experiments.sharpness.catalogue import LATER, PROBLEMS, chosen
from experiments.sharpness.problem import NEAR, Case, case_of
from experiments.sota.measures import Found
from jaxlfi.io import files as atomic
from tests.small import whole_runs  # noqa: F401

LEANING = ("leaning_2", "leaning_4", "leaning_3")
NEW = tuple(problem.name for name, problems in LATER.items() if name != "leaning" for problem in problems)
JUMPS = ("change", "dead_time", "animals")
"""Their likelihoods jump with a parameter, so that scores do not have a mean of zero."""
RESULTS = Path(command.__file__).parents[1] / "results" / "sharpness"
SMALL = oracle.Effort(particles=500, moves=4, centres=200, draws=4000)

# ------------------------------------------------------------------------------------------- exact posteriors


def sampled(log_likelihood, log_prior, low, high, **options):
    """Draws on a box by importance sampling, from particles that are uniform on it."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    start = np.random.default_rng(1).uniform(low, high, (SMALL.particles, len(low)))
    return oracle.importance_draws(log_likelihood, log_prior, start, low, high, count=4000, effort=SMALL, **options)


def flat(theta):
    return np.zeros(len(theta))


def agree(draws, exact, error=0.05):
    """Mean, standard deviation and outer quantiles agree with a distribution's, in its standard deviations."""
    assert abs(draws.mean() - exact.mean()) < error * exact.std()
    assert draws.std() == pytest.approx(exact.std(), rel=error)
    levels = [0.05, 0.25, 0.75, 0.95]
    np.testing.assert_allclose(np.quantile(draws, levels), exact.ppf(levels), atol=2 * error * exact.std())


def test_a_probability_follows_its_beta_distribution():
    """2 of 17, far from a normal distribution, and pressed against zero."""
    found = sampled(lambda theta, seed: stats.binom.logpmf(2, 17, theta[:, 0]), flat, [0.0], [1.0])
    agree(found.theta[:, 0], stats.beta(3, 16))
    assert found.size > oracle.LEAST_SIZE


def test_a_prior_counts():
    """A rate under a gamma prior."""
    prior = stats.gamma(2.0, scale=0.5)
    counts = [0, 3, 1]
    likelihood = lambda theta, seed: sum(stats.poisson.logpmf(count, theta[:, 0]) for count in counts)
    found = sampled(likelihood, lambda theta: prior.logpdf(theta[:, 0]), [0.0], [20.0])
    agree(found.theta[:, 0], stats.gamma(2.0 + sum(counts), scale=1 / (2.0 + len(counts))))


def test_an_unbiased_estimate_may_take_the_place_of_a_likelihood():
    def estimated(theta, seed):
        noise = 0.7 * np.random.default_rng(seed).normal(size=len(theta)) - 0.7**2 / 2
        return stats.norm.logpdf(theta[:, 0], 0.3, 0.1) + noise

    found = sampled(estimated, flat, [-5.0], [5.0])
    agree(found.theta[:, 0], stats.norm(0.3, 0.1), error=0.08)
    exact = sampled(lambda theta, seed: stats.norm.logpdf(theta[:, 0], 0.3, 0.1), flat, [-5.0], [5.0])
    assert found.size < 0.9 * exact.size  # the noise is paid for


def test_two_modes_keep_their_masses():
    def mixture(theta, seed):
        near, far = (stats.norm.logpdf(theta, centre, 0.1).sum(axis=1) for centre in (-2.0, 2.0))
        return np.logaddexp(np.log(0.3) + near, np.log(0.7) + far)

    found = sampled(mixture, flat, [-5.0, -5.0], [5.0, 5.0])
    assert np.mean(found.theta[:, 0] > 0) == pytest.approx(0.7, abs=0.04)
    high = found.theta[found.theta[:, 0] > 0]
    np.testing.assert_allclose(high.std(axis=0), 0.1, rtol=0.06)


def test_too_small_an_effective_size_is_refused():
    with pytest.raises(ValueError, match="expected an effective size of 100000"):
        sampled(lambda theta, seed: stats.norm.logpdf(theta[:, 0]), flat, [-5.0], [5.0], least=1e5)
    assert oracle.effective_size(np.zeros(7)) == pytest.approx(7)
    assert oracle.effective_size(np.array([0.0, -1e9])) == pytest.approx(1)


def test_linear_models_follow_closed_forms():
    """In the middle of a box; a parameter without influence is uniform over it."""
    matrix = np.array([[1.0, 0.4, 0.0], [-0.2, 0.8, 0.0], [0.5, 0.5, 0.0]])
    x, wide = np.array([0.3, -0.1, 0.2]), np.full(3, 10.0)
    found = oracle.linear_draws(matrix, 0.5, x, -wide, wide, count=4000)
    precision = matrix[:, :2].T @ matrix[:, :2] / 0.25
    covariance = np.linalg.inv(precision)
    mean = covariance @ matrix[:, :2].T @ x / 0.25
    for d in range(2):
        agree(found.theta[:, d], stats.norm(mean[d], np.sqrt(covariance[d, d])))
    assert np.corrcoef(found.theta[:, :2], rowvar=False)[0, 1] == pytest.approx(
        covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]), abs=0.05
    )
    agree(found.theta[:, 2], stats.uniform(-10, 20))


def test_linear_models_follow_truncated_ones():
    """Far in a tail, and in a corner of correlated parameters, where importance sampling says the same."""
    far = oracle.linear_draws(np.eye(1), 0.1, np.zeros(1), np.array([1.0]), np.array([3.0]), count=4000)
    agree(far.theta[:, 0], stats.truncnorm(10, 30, scale=0.1))
    matrix, x = np.array([[1.0, 0.9], [0.1, 0.3]]), np.array([0.2, 0.1])
    low, high = np.array([0.3, -1.0]), np.array([2.0, 1.5])
    gibbs = oracle.linear_draws(matrix, 0.3, x, low, high, count=4000)
    likelihood = lambda theta, seed: -0.5 * np.sum(((theta @ matrix.T - x) / 0.3) ** 2, axis=1)
    other = sampled(likelihood, flat, low, high)
    deviation = other.theta.std(axis=0)
    np.testing.assert_allclose(gibbs.theta.mean(axis=0), other.theta.mean(axis=0), atol=0.08 * deviation.min())
    np.testing.assert_allclose(gibbs.theta.std(axis=0), deviation, rtol=0.06)


# ------------------------------------------------------------------------------------------------- likelihoods


# Of the others, the kept references are judged below.
SLOW = [
    pytest.param(name, marks=pytest.mark.slow)
    for name in ("negative_binomial", "ornstein_uhlenbeck", *NEW)
    if name not in JUMPS
]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["friction", "poisson_regression", "epidemic", "ar1", *SLOW])
def test_a_likelihood_is_that_of_its_simulator(name):
    """The gradient of its logarithm is zero in the mean over simulations at the same parameters."""
    problem = PROBLEMS[name]
    theta = jnp.asarray(problem.truth)
    one = lambda key: jax.grad(lambda theta, x: problem.log_likelihood(key, theta, x))(
        theta, problem.simulate(key, theta)
    )
    scores = np.asarray(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), 2000)), float)
    standard_error = scores.std(axis=0) / np.sqrt(len(scores))
    assert np.all(standard_error > 0) and np.all(np.abs(scores.mean(axis=0)) < 4.5 * standard_error)


def test_likelihoods_that_jump_are_those_of_scipy():
    key, x = jax.random.key(0), jnp.array([0.7, 1.9, 0.55])
    shifted = PROBLEMS["dead_time"].log_likelihood
    exact = stats.expon(0.5, 1 / 0.9).logpdf(np.asarray(x, float)).sum()
    np.testing.assert_allclose(shifted(key, jnp.array([0.5, 0.9]), x), exact, rtol=1e-5)
    assert shifted(key, jnp.array([0.56, 0.9]), x) == -np.inf
    change = PROBLEMS["change"]
    found = [change.log_likelihood(key, jnp.array(theta), jnp.full(60, 1.0)) for theta in ([1, 2, 6.3], [1, 1, 6.3])]
    after = np.sum(np.linspace(0, 10, 60) >= 6.3)
    np.testing.assert_allclose(found[0] - found[1], after * np.diff(stats.norm.logpdf([1, 2], 1, 0.5))[0], rtol=1e-5)
    animals, seen = PROBLEMS["animals"].log_likelihood, jnp.array([31.0, 27.0, 40.0])
    found = [animals(key, jnp.array(theta), seen) for theta in ([80.3, 0.4], [64.8, 0.5])]
    exact = [stats.binom.logpmf(np.asarray(seen), *theta).sum() for theta in ((80, 0.4), (65, 0.5))]
    np.testing.assert_allclose(found, exact, rtol=1e-4)
    assert animals(key, jnp.array([39.0, 0.5]), seen) == -np.inf


def test_a_particle_filter_estimates_what_a_kalman_filter_knows():
    memory, deviation, error = 0.8, 0.5, 0.7
    x = np.array([0.3, -0.5, 0.9, 1.4, 0.2])

    def move(key, particles, observation):
        particles = memory * particles + deviation * jax.random.normal(key, particles.shape)
        return particles, jax.scipy.stats.norm.logpdf(observation, particles, error)

    estimate = lambda key: series.particle_filter(key, jnp.zeros(200), move, jnp.asarray(x), 200)
    estimates = np.asarray(jax.jit(jax.vmap(estimate))(jax.random.split(jax.random.key(0), 200)), float)
    mean, variance, exact = 0.0, 0.0, 0.0
    for value in x:
        mean, variance = memory * mean, memory**2 * variance + deviation**2
        exact += stats.norm.logpdf(value, mean, np.sqrt(variance + error**2))
        gain = variance / (variance + error**2)
        mean, variance = mean + gain * (value - mean), (1 - gain) * variance
    likelihoods = np.exp(estimates - exact)
    assert abs(likelihoods.mean() - 1) < 4 * likelihoods.std() / np.sqrt(200) < 0.1


def test_the_queue_s_likelihood_is_a_density_of_departures(monkeypatch):
    """For two departures it integrates to one, and the mean of the second agrees with simulations."""
    monkeypatch.setattr(series, "QUEUE_PARTICLES", 20)
    theta = jnp.array([1.0, 4.0, 0.4])
    grid = np.linspace(0.05, 30.0, 150)
    pairs = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1).reshape(-1, 2)
    density = jax.jit(jax.vmap(lambda x: series._mg1_likelihood(jax.random.key(3), theta, x)))(jnp.asarray(pairs))
    mass = np.exp(np.asarray(density, float)) * (grid[1] - grid[0]) ** 2
    assert mass.sum() == pytest.approx(1, abs=0.05)
    departures = jax.jit(jax.vmap(lambda key: series._mg1(key, theta)[:2]))
    simulated = departures(jax.random.split(jax.random.key(0), 4000))
    np.testing.assert_allclose(mass @ pairs / mass.sum(), np.mean(simulated, axis=0), rtol=0.05)


# -------------------------------------------------------------------------------------- problems and the held-out


def test_the_held_out_are_those_of_the_smallest_digests():
    assert len(held_out.NAMES) == 22 and tuple(PROBLEMS) == (*held_out.NAMES, *LEANING, *NEW)
    assert held_out.HELD_OUT == (
        *("thermocouple", "decay_offset", "linear_20", "negative_binomial", "ornstein_uhlenbeck", "ridge"),
    )
    digest = lambda name: hashlib.sha256(name.encode()).hexdigest()
    assert max(map(digest, held_out.HELD_OUT)) < min(map(digest, held_out.TUNING))
    assert [problem.name for problem in chosen(["held-out"])] == list(held_out.HELD_OUT)
    assert {problem.name for problem in chosen(["tuning", "ridge"])} == {*held_out.TUNING, "ridge"}
    with pytest.raises(ValueError, match="got 'rigde'"):
        chosen(["rigde"])


@pytest.mark.slow
@pytest.mark.parametrize("name", [*held_out.NAMES, *NEW])
def test_boxes_are_right_or_wrong_as_they_say(name):
    problem = PROBLEMS[name]
    truth = np.asarray(problem.task.inference.truth, float)
    (low, high), (phi_low, phi_high) = problem.box, problem.phi
    rounding = 1e-5 * (phi_high - phi_low)
    assert np.all((truth >= low) & (truth <= high) & (low >= phi_low) & (high <= phi_high))
    informed = problem.dim if problem.informed is None else len(problem.informed)
    for seed in range(4):
        for bounds, count in (("one", 1), ("all", informed)):
            low, high = problem.wrong_box(truth, seed, bounds)
            assert np.sum((truth < low) | (truth > high)) == count
            assert np.all((low < high) & (low >= phi_low - rounding) & (high <= phi_high + rounding))
    near = case_of(problem, "near", 5).truth
    fraction = np.abs(near - truth) / (problem.box[1] - problem.box[0])
    assert np.all((fraction <= NEAR + 1e-6) | np.isin(problem.names, problem.open))
    assert np.all((near >= problem.box[0]) & (near <= problem.box[1]))


def test_references_that_are_kept_are_large_enough_and_calibrated():
    """Truths lie among draws of their posteriors as those of a calibrated one would."""
    paths = sorted(path for path in (RESULTS / "references").glob("*/*.npz") if path.parent.name in PROBLEMS)
    ranks = []
    for path in paths:
        arrays = atomic.read_arrays(path)
        kind, _, seed = path.stem.partition("-")
        case = references.referenced_case(PROBLEMS[path.parent.name], kind, int(seed))
        np.testing.assert_array_equal(arrays["x"], case.x)
        assert arrays["size"] >= oracle.LEAST_SIZE and len(arrays["draws"]) <= 2000
        ranks.append(np.mean(arrays["draws"] < case.truth, axis=0))
    assert {path.parent.name for path in paths} == {name for name, one in PROBLEMS.items() if one.kept}
    ranks = np.concatenate(ranks)
    assert np.mean((ranks > 0.25) & (ranks < 0.75)) == pytest.approx(0.5, abs=0.15)
    assert np.mean((ranks > 0.05) & (ranks < 0.95)) == pytest.approx(0.9, abs=0.1)


# ----------------------------------------------------------------------------------------------------- measures


def rows(**arrays):
    return {name: np.asarray(values, float) for name, values in arrays.items()}


def test_measures_of_known_widths():
    """Twice and half as wide on two parameters; means off by 1 and 3 exact standard deviations."""
    one = rows(
        sd=[[2.0, 0.5], [2.0, 0.5]], exact_sd=[[1.0, 1.0], [1.0, 1.0]], mean=[[1.0, 0.0], [1.0, 3.0]],
        exact_mean=np.zeros((2, 2)),
    )  # fmt: skip
    assert measures.geometric_mean(measures.ratios(one)) == pytest.approx(1.0)
    assert measures.worst({**one, "sd": np.array([[2.0, 0.9], [4.0, 0.9]])}) == pytest.approx(np.sqrt(8))
    np.testing.assert_allclose(measures.distances(one), [[1, 0], [1, 3]])
    unknown = {**one, "exact_sd": np.array([[1.0, 1.0], [np.nan, np.nan]])}
    assert measures.geometric_mean(measures.ratios(unknown)) == pytest.approx(1.0)
    assert np.isnan(measures.geometric_mean(np.full(3, np.nan)))


def test_runs_are_lost_kept_and_recovered():
    one = rows(
        truth=[[0.0]] * 4, low=[[-1.0]] * 4, high=[[1.0]] * 4, end_low=[[-1.0], [-1.09], [-1.2], [0.1]],
        end_high=[[1.0]] * 4, sd=[[0.1]] * 4, exact_sd=[[0.1]] * 4, mean=[[0.0], [0.29], [0.31], [0.2]],
        exact_mean=[[0.0]] * 4,
    )  # fmt: skip
    assert measures.kept(one).tolist() == [True, True, False, False]
    assert measures.holds_truth(one).tolist() == [True, True, True, False]
    assert measures.lost(one).tolist() == [False, False, True, True]


def test_regions_hold_what_they_say():
    """A correct posterior covers at all levels; one half as wide covers less."""
    rng = np.random.default_rng(0)
    truth = rng.normal(size=(400, 2))
    for width, expected in (
        (1.0, (0.5, 0.9)),
        (0.5, [stats.chi2.cdf(0.25 * stats.chi2.ppf(p, 2), 2) for p in (0.5, 0.9)]),
    ):
        draws = width * rng.normal(size=(400, 500, 2))
        ranks = np.array([measures.ellipsoid_rank(*pair) for pair in zip(draws, truth, strict=True)])
        found = [measures.covered(ranks, level) for level in measures.LEVELS]
        np.testing.assert_allclose(found, expected, atol=0.08)
    below = special.ndtr(truth)
    found = [measures.covered_each(below, level) for level in measures.LEVELS]
    np.testing.assert_allclose(found, measures.LEVELS, atol=0.06)


def test_a_run_is_judged_by_the_exact_posterior_on_its_own_box():
    case = case_of(PROBLEMS["linear_2"], "near", 0)
    assert isinstance(case, Case)
    low, high = case.truth - 0.05, case.truth + 0.3
    exact = references.on_box(case, references.made(case, *case.problem.phi), low, high)
    assert np.all((exact.draws >= low) & (exact.draws <= high))
    found = measures.judged(case, 2.0 * exact.draws, 0.3, (low, high), exact)
    np.testing.assert_allclose(found["sd"] / found["exact_sd"], 2.0)
    assert 0 < found["exact_density_rank"] < 1 and np.isnan(found["c2st"]) and found["density_rank"] == 0.3
    nothing = measures.judged(case, exact.draws, 1.0, (low, high), None)
    assert np.isnan(nothing["exact_sd"]).all() and nothing.keys() == found.keys()


# --------------------------------------------------------------------------------------------------------- runs

TINY = '{"hidden": [8], "epochs": 2, "ensemble_size": 1, "components": 1, "rounds": 2}'


@pytest.fixture
def tiny(tmp_path, monkeypatch):
    monkeypatch.setattr(references, "CACHE", tmp_path / "references")
    words = ["--settings", TINY, "--out", str(tmp_path / "out"), "--simulations", "200"]
    return lambda *more: command.main([*words, *more])


@pytest.mark.slow
def test_runs_are_kept_and_not_made_again(tiny, tmp_path, monkeypatch, capsys):
    """All boxes and heuristics, from the command to the table."""
    words = ("--problems", "polynomial", "--seeds", "1", "--truths", "1")
    tiny(*words)
    text = (tmp_path / "out" / "table.md").read_text()
    found = atomic.read_arrays(tmp_path / "out" / "polynomial" / "bayessim-200.npz")
    assert sorted(found["label"].tolist()) == sorted(
        [f"right/{rule}/{case}" for rule in ("fixed", "edge") for case in ("own-0", "near-0")]
        + ["one/edge/own-0", "all/edge/own-0"]
    )
    known = np.isfinite(found["exact_sd"]).all(axis=1)
    assert known[found["box"] == "right"].all() and np.isfinite(found["sd"]).all()
    np.testing.assert_array_equal(found["made"], 40)  # two rounds, each a tenth of the budget
    fixed = found["heuristic"] == "fixed"
    np.testing.assert_array_equal(found["end_low"][fixed], found["low"][fixed].astype(np.float32))
    assert text.count("| polynomial |") == 4
    capsys.readouterr()
    monkeypatch.setattr(runner, "program", lambda *arguments: pytest.fail("a run was made again"))
    tiny(*words)
    assert (tmp_path / "out" / "table.md").read_text() == text
    with pytest.raises(ValueError, match="take another --out"):
        command.main(
            ["--problems", "polynomial", "--seeds", "2", "--simulations", "200", "--out", str(tmp_path / "out")]
        )


def test_other_libraries_are_run_by_the_adapters_there_are(tmp_path, monkeypatch):
    seen = []

    def infer(method, case, simulations):
        seen.append((method, case.seed, simulations, np.asarray(case.box.low, float).round(3).tolist()))
        if case.seed == 1:
            raise RuntimeError("no")
        draws = np.random.default_rng(0).normal(case.truth, 0.2, (1000, len(case.truth)))
        return Found(draws, None, 2.0, 0.0, simulations, 0)

    monkeypatch.setattr(runner, "inference", lambda method: infer)
    monkeypatch.setattr(references, "CACHE", tmp_path / "references")
    words = ["--problems", "polynomial", "oscillator", "--seeds", "2", "--truths", "0", "--methods", "sbi-npe-c"]
    with pytest.warns(UserWarning, match="sbi-npe-c, right/fixed/own-1: no"):
        command.main([*words, "--out", str(tmp_path)])
    assert seen == [("sbi-apt", seed, 1000, low) for low in ([0.2, 0.5], [-3.0] * 5) for seed in (0, 1)]
    found = atomic.read_arrays(tmp_path / "polynomial" / "sbi-npe-c-1000.npz")
    assert found["label"].tolist() == ["right/fixed/own-0"] and found["seconds"].tolist() == [2.0]
    assert "| sbi-npe-c | 1,000 | 1 |" in tables.table(tmp_path, ["oscillator"])


def test_the_belts_likelihood_is_that_of_noise_on_all_that_was_recorded():
    """Beside the steps of MuJoCo, written in JAX."""
    pytest.importorskip("mujoco")
    from experiments.design import machines
    from experiments.sharpness import models

    problem = models.problem("mujoco_belt")
    case = case_of(problem, "own", 0)
    theta = np.asarray(problem.truth) * np.random.default_rng(0).uniform(0.98, 1.02, (8, 4))
    places = jax.vmap(machines.belt_response, (0, None))(jnp.asarray(theta, jnp.float32), jnp.asarray(models.CHIRP))
    expected = -0.5 * np.sum(((np.asarray(places) - case.x[:, 0]) / 0.0005) ** 2, axis=1)
    np.testing.assert_allclose(problem.host_log_likelihood(theta, case.x), expected, rtol=5e-3, atol=0.5)
    assert case.x.shape == (101, 1) and len(problem.task.summary(case.x)) == 30
