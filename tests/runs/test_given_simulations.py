"""Simulations that were made before: they take the place of the first round's, with weights for how they were drawn."""

import dataclasses
import json

import jax
import numpy as np
import pytest
from scipy import stats

import jaxlfi
from jaxlfi.distributions.support import Support
from jaxlfi.envs.gaussian_linear import MIXING, NOISE, posterior
from jaxlfi.io import files as atomic
from jaxlfi.io.workfolder import StoreError
from jaxlfi.runs.load import load
from jaxlfi.studies.calibration import read_run
from jaxlfi.tasks.host import HostSimulator
from jaxlfi.tasks.presimulated import presimulated, read_simulations
from tests.small import FLAGS, SETTINGS, command, gaussian, read_ledger, settings, whole_runs  # noqa: F401 - a fixture

OBSERVED = np.array([0.8, -0.6], np.float32)
BOX = np.array([[-3.0, -3.0], [3.0, 3.0]])


def pairs(n: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Parameters uniform over a box, and what they simulate."""
    rng = np.random.default_rng(seed)
    theta = rng.uniform(*BOX, (n, 2))
    return {"theta": theta, "trajectory": theta @ MIXING.T + NOISE * rng.normal(size=(n, 2))}


def never(rng, theta):
    """A simulator that must not be called."""
    raise AssertionError("it simulated")


def host_task():
    """The Gaussian task, whose simulations are all made before."""
    return dataclasses.replace(gaussian(), simulate=HostSimulator(never), truth=None, observation=OBSERVED)


ONE = settings(rounds=1, predictive=False)
TRAINED = ONE.replace(
    estimator=SETTINGS.estimator.replace(steps=1500, batch_size=100, learning_rate=1e-2, components=1)
)
"""Trained well; 600 pairs are one program."""


@pytest.mark.slow
def test_one_round_of_given_simulations_simulates_nothing():
    run = jaxlfi.infer(jax.random.key(0), host_task(), simulations=pairs(60), settings=ONE)
    assert int(run.dataset.size) == 60 and run.history["attempted"].tolist() == [60]
    assert run.history["predictive_simulations"].tolist() == [0]
    np.testing.assert_allclose(run.dataset.theta[:60], pairs(60)["theta"], rtol=1e-6)
    np.testing.assert_allclose(run.dataset.weight, 1.0)
    np.testing.assert_allclose(run.support.low, pairs(60)["theta"].min(0), rtol=1e-6)  # the box that they fill
    summaries = {"theta": pairs(60)["theta"], "x": pairs(60)["trajectory"]}
    same = jaxlfi.infer(jax.random.key(0), host_task(), simulations=summaries, settings=ONE)
    np.testing.assert_array_equal(same.mixture.means, run.mixture.means)
    with pytest.raises(ValueError, match="it simulated"):
        jaxlfi.infer(jax.random.key(0), host_task(), simulations=pairs(60), settings=settings(rounds=2))


@pytest.mark.slow
def test_their_posterior_is_the_exact_one():
    given = pairs(600) | {"low": BOX[0], "high": BOX[1]}
    run = jaxlfi.infer(jax.random.key(1), host_task(), simulations=given, settings=TRAINED, heuristic=jaxlfi.Fixed())
    np.testing.assert_allclose([run.support.low, run.support.high], BOX)
    exact = posterior(OBSERVED)
    deviation = np.sqrt(np.diag(exact.covariance))
    assert np.all(np.abs(run.mixture.mean - exact.mean) < 0.6 * deviation)
    np.testing.assert_allclose(np.sqrt(np.diag(run.mixture.covariance)), deviation, rtol=0.4)


def test_arrays_that_are_not_those_of_the_task_are_refused():
    given = pairs(20)
    with pytest.raises(ValueError, match=r"expected arrays among theta, .*, got log_densities"):
        presimulated(gaussian(), given | {"log_densities": np.zeros(20)})
    with pytest.raises(
        ValueError, match=r"expected trajectories of shape \[2\], as the task's simulator makes, got \[3\]"
    ):
        presimulated(gaussian(), given | {"trajectory": np.zeros((20, 3))})


@pytest.mark.slow
def test_later_rounds_simulate_as_ever(tmp_path):
    given = pairs(60)
    given["trajectory"][:7] = np.nan
    arguments = {"simulations": given, "settings": settings(predictive=False), "heuristic": jaxlfi.Edge()}
    seen = []
    run = jaxlfi.infer(
        jax.random.key(2), gaussian(), OBSERVED, out=tmp_path / "run",
        callback=lambda index, row: seen.append(int(row["attempted"])), **arguments,
    )  # fmt: skip
    assert seen[0] == 60 and 20 <= seen[1] <= 25
    assert run.history["failed"][0].tolist() == [0, 7] and run.history["succeeded"].tolist() == [53, 20]
    assert int(run.dataset.size) == 73 and run.history["theta"].shape[1] == 60
    assert [line["failed"]["non_finite"] for line in read_ledger(tmp_path / "run")] == [7, 0]

    def stop(index, row):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        jaxlfi.infer(jax.random.key(2), gaussian(), OBSERVED, out=tmp_path / "stopped", callback=stop, **arguments)
    others = given | {"theta": given["theta"][::-1].copy()}  # which fill the same box
    for folder in ("stopped", "run"):
        with pytest.raises(StoreError, match=r"^out: expected a new folder or one of the same run, .*simulations\)$"):
            jaxlfi.infer(
                jax.random.key(2), gaussian(), OBSERVED, out=tmp_path / folder, **arguments | {"simulations": others}
            )
    resumed = jaxlfi.infer(jax.random.key(2), gaussian(), OBSERVED, out=tmp_path / "stopped", **arguments)
    np.testing.assert_array_equal(resumed.mixture.means, run.mixture.means)
    loaded = load(tmp_path / "run", gaussian())
    assert loaded.origin.given_simulations == run.origin.given_simulations == 60
    with pytest.raises(StoreError, match=r"^out: expected a new folder or one of the same run, .*simulations\)$"):
        jaxlfi.infer(
            jax.random.key(2), gaussian(), OBSERVED, out=tmp_path / "run", support=loaded.support,
            **arguments | {"simulations": None},
        )  # fmt: skip
    with pytest.raises(StoreError, match=r"that made all of its simulations, got one with 60 supplied ones"):
        read_run(tmp_path / "run", gaussian())
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    del config["given_simulations"]  # as an earlier version wrote it
    (tmp_path / "run" / "config.json").write_text(json.dumps(config))
    assert read_run(tmp_path / "run", gaussian()).origin.given_simulations is None
    again = jaxlfi.infer(jax.random.key(2), gaussian(), OBSERVED, out=tmp_path / "run", **arguments)
    np.testing.assert_array_equal(again.mixture.means, run.mixture.means)
    for name in ("theta", "x", "round", "weight"):
        np.testing.assert_array_equal(getattr(loaded.dataset, name)[:73], getattr(run.dataset, name)[:73])


@pytest.mark.slow
def test_a_file_of_simulations_enters_by_the_command_line(tmp_path):
    given = pairs(60)
    np.savez(tmp_path / "simulations.npz", **given)
    reference = "tests.runs.test_given_simulations:host_task"
    flags = (*FLAGS, "--rounds", "1", "--no-predictive", "--simulations", tmp_path / "simulations.npz")
    assert command("infer", reference, *flags, "--out", tmp_path / "run") == 0
    run = jaxlfi.infer(
        jax.random.key(0),
        host_task(),
        simulations=tmp_path / "simulations.npz",
        settings=load(tmp_path / "run").settings,
    )
    np.testing.assert_array_equal(load(tmp_path / "run").mixture.means, run.mixture.means)
    assert len(atomic.read_arrays(tmp_path / "run" / "dataset.npz")["theta"]) == 60


def test_a_file_that_is_none_is_refused(tmp_path, capsys):
    (tmp_path / "no.npz").write_text("text")
    np.savez(tmp_path / "foreign.npz", theta=np.zeros((3, 2)), weights=np.ones(3))
    with pytest.raises(ValueError, match=r"^simulations: .*no.npz: expected a complete .npz file"):
        read_simulations(tmp_path / "no.npz")
    with pytest.raises(ValueError, match=r"^simulations: expected arrays among .*, got weights$"):
        presimulated(gaussian(), read_simulations(tmp_path / "foreign.npz"))
    reference = "tests.runs.test_given_simulations:host_task"
    assert command("infer", reference, *FLAGS, "--simulations", tmp_path / "missing.npz", "--out", tmp_path / "x") == 2
    message = capsys.readouterr().err
    assert (
        message.count("\n") == 1
        and "missing.npz: expected a complete .npz file" in message
        and not (tmp_path / "x").exists()
    )


# ------------------------------------------------------------------------------------------------------- weights


def logarithmic(**changes):
    """The Gaussian task with its first parameter, which is then positive, inferred as its logarithm."""
    box = Support([0.1, -3.0], [3.0, 3.0])
    return dataclasses.replace(gaussian(), supports={"own": box}, feasible=box, log=("first",), truth=None, **changes)


def drawn(n: int):
    """Parameters from a gamma and a normal distribution, and their log-density over natural units."""
    rng = np.random.default_rng(5)
    theta = np.stack([rng.gamma(4.0, 0.3, n), rng.normal(0.0, 1.0, n)], axis=1)
    log_density = stats.gamma(4.0, scale=0.3).logpdf(theta[:, 0]) + stats.norm.logpdf(theta[:, 1])
    return {"theta": theta, "x": np.zeros((n, 2)), "log_density": log_density}


def reference_weights(log_prior, log_density, kept):
    """In NumPy: the prior over the density, cut off at sqrt(n) times the mean, of mean 1."""
    weight = np.exp(log_prior - log_density)[kept]
    weight = np.minimum(weight, np.sqrt(kept.sum()) * weight.mean())
    return weight / weight.mean()


@pytest.mark.parametrize("with_prior", [False, True])
def test_weights_are_the_prior_over_the_density_they_were_drawn_from(with_prior):
    """Densities over natural units; the uniform prior over inference space is 1 / theta in a log parameter."""
    import distrax

    prior = distrax.MultivariateNormalDiag(np.array([1.0, 0.5], np.float32), np.array([0.5, 0.7], np.float32))
    task = logarithmic(prior=prior) if with_prior else logarithmic()
    given = drawn(300)
    given["x"][::10] = np.inf
    simulations, support = presimulated(task, given, task.support("own"))
    theta = given["theta"]
    inside = ((theta >= [0.1, -3.0]) & (theta <= 3.0)).all(axis=1)
    kept = inside & np.isfinite(given["x"]).all(axis=1)
    assert 200 < kept.sum() < inside.sum() < 300
    np.testing.assert_array_equal(simulations.counted, inside)
    np.testing.assert_array_equal(simulations.kept, kept)
    assert simulations.failed(2).tolist() == [0, inside.sum() - kept.sum()]
    log_prior = stats.norm.logpdf(theta, [1.0, 0.5], [0.5, 0.7]).sum(axis=1) if with_prior else -np.log(theta[:, 0])
    expected = reference_weights(log_prior, given["log_density"], kept)
    np.testing.assert_allclose(np.asarray(simulations.weight)[kept], expected, rtol=2e-4)
    np.testing.assert_allclose(np.asarray(simulations.theta)[:, 0], np.log(theta[:, 0]), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(support.low, [np.log(0.1), -3.0], rtol=1e-6)
    assert expected.max() > 2  # so that the weights matter


def test_one_weight_of_many_is_limited():
    given = pairs(100) | {"log_density": np.zeros(100)}
    given["log_density"][3] = -20.0
    simulations, _ = presimulated(gaussian(), given)
    weight = np.asarray(simulations.weight)
    np.testing.assert_allclose(weight.mean(), 1.0, rtol=1e-5)
    raw = np.exp(-given["log_density"])
    assert weight[3] / weight[0] == pytest.approx(np.sqrt(100) * raw.mean() / raw[0], rel=1e-3)


@pytest.mark.slow
def test_weights_change_what_is_learnt():
    """Two thirds of the pairs are given the weight of next to nothing: the posterior is that of the others."""
    given = pairs(600)
    given["trajectory"][200:] -= 1.5
    weighted = given | {"log_density": np.where(np.arange(600) < 200, 0.0, 14.0)}
    infer = lambda simulations: jaxlfi.infer(
        jax.random.key(0), host_task(), simulations=simulations, settings=TRAINED,
        support=Support([-3.0, -3.0], [3.0, 3.0]), heuristic=jaxlfi.Fixed(),
    )  # fmt: skip
    exact = np.asarray(posterior(OBSERVED).mean)
    far, near = (np.abs(np.asarray(infer(given_).mixture.mean) - exact).max() for given_ in (given, weighted))
    assert near < 0.45 and far > 0.75


# ------------------------------------------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"theta": None}, "expected an array 'theta', got trajectory"),
        ({"theta": np.zeros((60, 3))}, r"expected numbers theta of shape \['N', 2\], got shape \[60, 3\]"),
        ({"theta": np.full((60, 2), "a")}, "expected numbers theta"),
        ({"theta": np.full((60, 2), np.nan)}, "expected finite parameters"),
        ({"theta": np.zeros((1, 2)), "trajectory": np.zeros((1, 2))}, "expected at least 2, got 1"),
        ({"trajectory": np.zeros((59, 2))}, r"expected 60 trajectories, got shape \[59, 2\]"),
        ({"trajectory": np.zeros(60)}, r"expected 60 trajectories, got shape \[60\]"),
        ({"trajectory": None}, "expected either 'trajectory' or 'x'"),
        ({"x": np.zeros((60, 2))}, "expected either 'trajectory' or 'x'"),
        ({"trajectory": np.full((60, 2), np.nan)}, "expected some inside the support, got 60 of 60, none finite"),
        ({"log_density": np.zeros(59)}, r"expected numbers log_density of shape \[60\], got shape \[59\]"),
        ({"log_density": np.full(60, np.inf)}, "expected finite log-densities"),
        ({"trajectory": None, "x": np.zeros((60, 3))}, "expected summaries of length 2, got 3"),
    ],
)
def test_wrong_arrays_are_named(changes, message):
    given = {name: value for name, value in (pairs(60) | changes).items() if value is not None}
    with pytest.raises(ValueError, match=f"^simulations: {message}") as refused:
        jaxlfi.infer(jax.random.key(0), host_task(), simulations=given, settings=ONE)
    assert "\n" not in str(refused.value)
