"""The study of designs: its posteriors are those of closed forms, and its rivals keep to the rules."""

import dataclasses
import functools
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from experiments.design import comparison, importance, laplace, queue, tables, tempered
from experiments.design.trust import UntrustedError
from jaxlfi.distributions.support import Support
from jaxlfi.envs import mg1, mg1_repetitions
from jaxlfi.tasks.design import Design
from jaxlfi.tasks.experiments import at
from jaxlfi.tasks.host import HostSimulator
from jaxlfi.tasks.task import Task

SIGMA = 0.3
BOX = Support([-9.0, -9.0], [9.0, 9.0])


def rows(design, numpy=jnp):
    """What is measured of two parameters, in three directions about the chosen one, [3, 2]."""
    angles = design[0] + numpy.asarray([0.0, 0.1, 0.2])
    return numpy.stack([numpy.cos(angles), 2 * numpy.sin(angles)], axis=-1)


def linear() -> Task:
    return Task(
        lambda key, theta, design: rows(design) @ theta + SIGMA * jax.random.normal(key, (3,)),
        ["a", "b"],
        {"guess": BOX},
        BOX,
        design=Design({"angle": (0.0, 3.0)}, response=lambda theta, design: rows(design) @ theta, noise=SIGMA),
    )


def linear_on_host() -> Task:
    clean = lambda theta, design: (theta @ rows(design, np).T)[:, :, None]
    simulate = lambda rng, theta, design: clean(theta, design) + SIGMA * rng.standard_normal((len(theta), 3, 1))
    return Task(
        HostSimulator(simulate),
        ["a", "b"],
        {"guess": BOX},
        BOX,
        design=Design({"angle": (0.0, 3.0)}, response=clean, noise=SIGMA),
    )


@pytest.mark.parametrize(
    ("sampler", "task"),
    [
        (importance.posterior, linear),
        (tempered.posterior, linear),
        (functools.partial(importance.posterior, points=1024), linear_on_host),
        (laplace.posterior, linear_on_host),
    ],
    ids=["importance", "tempered", "on host", "laplace"],
)
def test_posteriors_are_those_of_the_closed_form(sampler, task):
    """One recording, which leaves a ridge, and two, from the box and from the first one's posterior."""
    task, rng = task(), np.random.default_rng(0)
    designs = np.array([[0.3], [1.6]])
    matrix = np.stack([rows(design, np) for design in designs])
    recorded = matrix @ np.array([1.0, -0.5]) + SIGMA * rng.standard_normal((2, 3))
    shaped = recorded if not task.on_host else recorded[:, :, None]
    first = sampler(rng, task, shaped[:1], designs[:1])
    for draws, used in ((first, 1), (sampler(rng, task, shaped, designs, first), 2)):
        stacked = matrix[:used].reshape(-1, 2) / SIGMA
        covariance = np.linalg.inv(stacked.T @ stacked)
        mean = covariance @ stacked.T @ recorded[:used].ravel() / SIGMA
        deviation = np.sqrt(np.diagonal(covariance))
        assert deviation.max() < 2.2  # the box does not matter
        np.testing.assert_allclose(draws.mean(axis=0), mean, atol=0.35 * deviation.max())
        np.testing.assert_allclose(draws.std(axis=0) / deviation, 1.0, atol=0.2)


def test_quantiles_about_the_best_fit_are_those_of_the_closed_form():
    """So few independent draws leave them 0.2 standard deviations uncertain, and coverage lacks one percent."""
    task, designs = linear_on_host(), np.array([[0.3], [1.6]])
    matrix = np.stack([rows(design, np) for design in designs])
    mean = np.array([1.0, -0.5])
    flat = matrix.reshape(-1, 2) / SIGMA
    deviation = np.sqrt(np.diagonal(np.linalg.inv(flat.T @ flat)))
    found = [laplace.posterior(np.random.default_rng(i), task, (matrix @ mean)[:, :, None], designs) for i in range(8)]
    off = (np.quantile(found, [0.05, 0.95], axis=1) - mean) / deviation - 1.645 * np.array([-1, 1])[:, None, None]
    assert np.sqrt(np.mean(off**2)) < 0.1


@pytest.mark.slow
def test_kernels_follow_a_posterior_that_no_normal_resembles():
    """A curved ridge: b is a squared, and a is known to be within 2."""
    box = Support([-3.0, -3.0], [3.0, 9.0])
    clean = lambda theta, design: np.stack([(theta[:, 1] - theta[:, 0] ** 2) / 4, theta[:, 0] / 10], axis=1)[:, :, None]
    task = Task(
        HostSimulator(lambda rng, theta, design: clean(theta, design) + 0.1 * rng.standard_normal((len(theta), 2, 1))),
        ["a", "b"],
        {"guess": box},
        box,
        design=Design({"none": (0.0, 1.0)}, response=clean, noise=0.1),
    )
    draws = importance.posterior(
        np.random.default_rng(2), task, np.zeros((1, 2, 1)), np.zeros((1, 1)), propose=importance.kernels
    )
    across = draws[:, 1] - draws[:, 0] ** 2
    np.testing.assert_allclose([draws[:, 0].std(), across.std()], [1.0, 0.4], rtol=0.12)
    np.testing.assert_allclose([draws[:, 0].mean(), across.mean()], 0.0, atol=0.15)


def on_host(clean, low, high, noise) -> Task:
    """A task of one parameter, whose response is a function of it."""
    box = Support([low], [high])
    response = lambda theta, design: clean(theta)[:, :, None]
    simulate = lambda rng, theta, design: response(theta, design) + noise * rng.standard_normal((len(theta), 1, 1))
    return Task(
        HostSimulator(simulate),
        ["a"],
        {"guess": box},
        box,
        design=Design({"none": (0.0, 1.0)}, response=response, noise=noise),
    )


NOTHING = np.zeros((1, 1, 1)), np.zeros((1, 1))
"""Recorded, by some design."""


def test_a_fit_that_noise_does_not_explain_is_left():
    """Where the search begins, residuals of 1.2 are least, at a noise of 0.01; they vanish at 2."""
    task = on_host(lambda theta: (theta - 2) * ((theta + 2) ** 2 + 0.3), -4.0, 4.0, 0.01)
    start, near = np.array([-2.0]), np.array([0.1])
    assert abs(laplace.fitted(task, *NOTHING, start, near)[1] + 2) < 0.5
    before = start + 0.1 * np.random.default_rng(3).standard_normal((256, 1))
    draws = laplace.posterior(np.random.default_rng(4), task, *NOTHING, before)
    np.testing.assert_allclose(draws, 2.0, atol=0.01)


def test_no_posterior_is_said_of_a_fit_that_noise_never_explains():
    task = on_host(lambda theta: 1.0 + theta**2, -4.0, 4.0, 0.01)
    with pytest.raises(UntrustedError, match="squared residuals"):
        laplace.posterior(np.random.default_rng(5), task, *NOTHING)


@pytest.mark.parametrize("known", [False, True], ids=["box", "before"])
def test_modes_of_a_slow_simulator_are_weighed(known):
    """About -1 the response is twice as steep as about 1: a third of the posterior is there, and half as wide."""
    task = on_host(lambda theta: np.where(theta > 0, theta - 1, 2 * (theta + 1)), -3.0, 3.0, 0.05)
    before = None
    if known:  # a posterior of both, of twice the noise
        rng = np.random.default_rng(6)
        first = np.where(
            rng.random(256) < 1 / 3, -1 + 0.05 * rng.standard_normal(256), 1 + 0.1 * rng.standard_normal(256)
        )
        before = first[:, None]
    draws = laplace.posterior(np.random.default_rng(7), task, *NOTHING, before)[:, 0]
    assert np.mean(draws < 0) == pytest.approx(1 / 3, abs=0.04)
    np.testing.assert_allclose([draws[draws < 0].std(), draws[draws > 0].std()], [0.025, 0.05], rtol=0.15)


def test_a_posterior_that_is_wider_than_its_best_fit_says():
    """A kink at the best fit, ten times as steep on one side: a normal by the steep side would be a tenth as wide."""
    task = on_host(lambda theta: np.where(theta > 0, 10 * theta, theta), -9.0, 9.0, 0.5)
    draws = laplace.posterior(np.random.default_rng(8), task, *NOTHING)[:, 0]
    assert np.mean(draws > 0) == pytest.approx(1 / 11, abs=0.03)
    assert np.quantile(draws, 0.05) == pytest.approx(-0.5 * 2.0, abs=0.12)


def test_both_halves_of_a_mixture_are_found():
    """The sign of the parameter is not measured: half of the particles stay on either side."""
    box = Support([-3.0], [3.0])
    response = lambda theta, design: theta**2 * design
    task = Task(
        lambda key, theta, design: response(theta, design) + 0.1 * jax.random.normal(key, (1,)),
        ["a"],
        {"guess": box},
        box,
        design=Design({"gain": (0.5, 2.0)}, response=response, noise=0.1),
    )
    draws = tempered.posterior(np.random.default_rng(1), task, np.full((1, 1), 4.0), np.array([[1.0]]))
    assert 0.35 < np.mean(draws > 0) < 0.65
    np.testing.assert_allclose(np.abs(draws).mean(), 2.0, atol=0.01)
    assert 0.02 < np.abs(draws).std() < 0.03  # 0.1 / (2 * 2)


def test_a_queue_that_is_never_emptied_is_the_one_without_a_design():
    one_go = at(mg1_repetitions.task(), [mg1_repetitions.COST])
    times, kind = one_go.simulate(jax.random.key(3), jnp.array([1.0, 4.0, 0.2]))
    jobs = mg1.draw_jobs(jax.random.key(3), jnp.array([1.0, 5.0, 0.2]), mg1_repetitions.COST)
    np.testing.assert_allclose(times, mg1.interdeparture_times(*jobs), rtol=1e-4)
    assert kind.tolist() == [2.0] + [1.0] * (mg1_repetitions.COST - 1)


def test_intervals_of_a_regression_are_the_residuals():
    rng = np.random.default_rng(0)
    theta = rng.standard_normal((20_000, 2))
    x = np.stack([theta[:, 0] + 0.5 * rng.standard_normal(20_000), theta[:, 1]], axis=1)
    found = queue.Regression(x, theta)
    left = np.sqrt(0.5**2 / (1 + 0.5**2))
    assert found.widths[0] == pytest.approx(2 * 1.645 * left, rel=0.03) and found.widths[1] < 0.1
    assert found.held[0] == pytest.approx(0.9, abs=0.01)
    np.testing.assert_allclose(found.mean(np.array([[1.0, 0.5]])), [[0.8, 0.5]], atol=0.05)


def test_experiments_of_experts_and_at_random_are_safe():
    pytest.importorskip("mujoco")
    from experiments.design import machines

    task, rng = machines.furuta(), np.random.default_rng(0)
    inner = np.asarray(task.space.to_inference(task.truth))
    draws = inner + 0.01 * rng.standard_normal((16, 3)) * np.array([1.0, 0.001, 1.0])
    arms = dict(machines.experts_and_random(rng, task, draws))
    assert {name: designs.shape for name, designs in arms.items()} == {"expert": (3, 4), "at random": (3, 4)}
    natural = np.asarray(task.space.to_natural(draws[:8]), float)
    for designs in arms.values():
        for design in designs:
            assert np.abs(task.design.response(natural, design)[:, :, 0]).max() <= 2.0
    strongest = np.array([0.06, 0.2, 3.0, 0.0])
    assert np.abs(task.design.response(natural, strongest)[:, :, 0]).max() > 2.0  # the limit does matter


def test_a_cart_on_a_belt_moves_as_two_masses_and_a_spring():
    """Without friction, by SciPy; the model's own steps are of a hundredth of a second."""
    pytest.importorskip("mujoco")
    from experiments.design import machines

    task = machines.belt()
    stiffness, damping, cart, pulley = 1000.0, 3.0, 1.0, 0.4
    force = lambda t: 5.0 * np.sin(2 * np.pi * (0.5 * t + 0.5 * (2.0 - 0.5) * t**2 / machines.DURATION))

    def slope(t, state):
        first, second, v_first, v_second = state
        pull = stiffness * (second - first) + damping * (v_second - v_first)
        return [v_first, v_second, (force(t) - 2.0 * v_first + pull) / pulley, -pull / cart]

    times = machines.INTERVAL * np.arange(101)
    exact = solve_ivp(slope, (0, times[-1]), np.zeros(4), t_eval=times, rtol=1e-8, atol=1e-10, max_step=0.01).y[1]
    found = task.design.response(np.array([[stiffness, damping, cart, 0.0]]), np.array([5.0, 0.5, 2.0]))[0, :, 0]
    assert np.ptp(exact) > 0.2
    np.testing.assert_allclose(found, exact, atol=0.06 * np.ptp(exact))


def test_a_belt_in_jax_takes_mujocos_steps():
    """Where the cart slides and where it sticks, within a hundredth of the noise."""
    pytest.importorskip("mujoco")
    from experiments.design import machines

    task, rng = machines.belt(), np.random.default_rng(0)
    low, high = np.asarray(task.feasible.low), np.asarray(task.feasible.high)
    theta, design = rng.uniform(low, high, (16, 4)), np.array([8.0, 0.6, 11.0])
    exact = task.design.response(theta, design)[:, :, 0]
    found = jax.vmap(machines.belt_response, (0, None))(jnp.asarray(theta, jnp.float32), jnp.asarray(design))
    np.testing.assert_allclose(found, exact, atol=1e-2 * task.design.noise[0])


def test_particles_that_do_not_move_are_refused(monkeypatch):
    monkeypatch.setattr(tempered, "LAST", 2)
    with pytest.raises(UntrustedError, match="move 3 times"):
        tempered.posterior(np.random.default_rng(0), linear(), np.zeros((1, 3)), np.array([[0.3]]))


def test_recordings_that_no_particle_explains_are_refused():
    with pytest.raises(UntrustedError, match="squared residuals that sum to about 3"):
        tempered.posterior(np.random.default_rng(0), linear(), np.array([[9.0, -9.0, 9.0]]), np.array([[0.3]]))


def test_a_truth_whose_posterior_is_refused_is_left_out_and_counted(tmp_path: Path, monkeypatch):
    """The second of three, in all arms."""
    calls = iter(range(99))

    def sampler(rng, task, recorded, designs, before=None):
        if next(calls) == 5:  # each truth has five posteriors, if none is refused
            raise UntrustedError("lost")
        return rng.standard_normal((64, 2))

    advice = types.SimpleNamespace(designs=np.array([[1.0]]), reach=2.0, together=[3.0], narrower=1.5)
    monkeypatch.setattr(comparison, "chosen_for", lambda *given: advice)
    task = dataclasses.replace(linear(), truth=np.array([1.0, -0.5]))
    problem = comparison.Problem(lambda: task, sampler, comparison.again_and_random)
    comparison.measured(problem, 3, 0, tmp_path / "made.npz")
    kept = np.load(tmp_path / "made.npz")
    assert kept["width"].shape == (2, 5, 2) and kept["refused"] == 1
    np.testing.assert_array_less(0, kept["width"])


def test_tables_compare_with_random(tmp_path: Path):
    """Chosen ones half as wide in each of two parameters: a quarter of the product."""
    width = np.ones((5, 4, 2)) * np.array([1.0, 0.2, 0.3, 0.4])[:, None]
    np.savez(
        tmp_path / "made.npz",
        refused=np.array(2),
        width=width,
        held=np.ones((5, 4, 2), bool),
        arms=np.array(["chosen", "expert", "at random"]),
        reach=np.ones(5),
        narrower=np.ones(5),
    )
    lines = tables.widths(tmp_path, ["made"]).splitlines()
    assert (
        lines[2]
        == "| made | 5 (2 left out) | chosen | 0.20 [0.20, 0.20] | 0.50 times | 0.25 [0.25, 0.25] | 100% of 10 |"
    )
    assert lines[3].startswith(
        "| made | 5 (2 left out) | expert | 0.30 [0.30, 0.30] | 0.75 times | 0.56 [0.56, 0.56] |"
    )
