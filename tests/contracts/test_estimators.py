"""The contract of all density estimators: those that are registered, and one by a third party."""

import dataclasses
import functools

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from scipy import stats

from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.estimators import dataset as datasets
from jaxlfi.estimators.base import Estimator, Network, converted, untrained
from jaxlfi.estimators.posterior import MAP_DRAWS, Posterior
from jaxlfi.estimators.training import fit
from jaxlfi.fields import declared, option
from jaxlfi.io.serialise import from_json, to_json
from jaxlfi.registry import ESTIMATORS

# --------------------------------------------------------------------------------- an estimator of another package


@struct.dataclass
class Logistic:
    """Independent logistic variables, one vector of them for each x."""

    mean: jax.Array
    log_scale: jax.Array

    def log_prob(self, theta):
        """Log-density at theta."""
        z = (theta - self.mean) * jnp.exp(-self.log_scale)
        return jnp.sum(-z - 2 * jax.nn.softplus(-z) - self.log_scale, axis=-1)

    def sample(self, key, n):
        """`n` draws."""
        return self.mean + jnp.exp(self.log_scale) * jax.random.logistic(key, (n, *self.mean.shape))


class LogisticNetwork(nn.Module):
    """A network from a summary to the density."""

    dim: int
    width: int

    @nn.compact
    def __call__(self, x):
        """The density of each x."""
        mean, log_scale = jnp.split(nn.Dense(2 * self.dim)(nn.tanh(nn.Dense(self.width)(x))), 2, axis=-1)
        return Logistic(mean, jnp.tanh(log_scale) - 1.0)


class OneFile(Estimator):
    """Everything that a third party writes."""

    width: int = option(default=8, low=1, help="units of the hidden layer")

    def module(self, dim: int) -> nn.Module:
        """The network."""
        return LogisticNetwork(dim, self.width)


# -------------------------------------------------------------------------------------------------- the suite

COMMON = {
    "hidden": (8,),
    "transforms": 2,
    "bins": 4,
    "components": 2,
    "ensemble_size": 2,
    "epochs": 60,
    "batch_size": 20,
    "learning_rate": 1e-2,
}
"""Small settings; each family takes those that it has."""
KINDS = {name: ESTIMATORS.load(name) for name in ESTIMATORS.names()} | {"third party": OneFile}
SPACE = Space(("rate", "shift"), (True, False))
PHI = Support([np.log(0.1), -4.0], [np.log(20.0), 4.0])
BOX = Support([np.log(0.4), -1.5], [np.log(6.0), 1.0])
X = jnp.array([0.4, -1.3, 0.9])
CELLS = 160
DRAWS = 3000
"""Number of draws that are tested, made `MAP_DRAWS` at a time, as `Posterior.map` compiles that number, too."""


def small(kind: type[Estimator]) -> Estimator:
    """An instance of the family."""
    return kind(**{name: value for name, value in COMMON.items() if name in declared(kind)}).check()


@dataclasses.dataclass
class Case:
    """A family, its untrained and its perturbed network, and the posterior of X, from a compiled program."""

    estimator: Estimator
    start: Network
    network: Network
    posterior: Posterior


@functools.partial(jax.jit, static_argnums=1)
def perturbed(key: jax.Array, estimator: Estimator) -> tuple[Network, Network, Posterior]:
    """An untrained network; the same perturbed, as if trained on simulations of part of Phi; and its posterior of X."""
    start = untrained(key, estimator, 3, PHI, SPACE)
    draw = np.random.default_rng(0)
    params = jax.tree.map(lambda leaf: leaf + 0.15 * draw.normal(size=leaf.shape).astype(np.float32), start.params)
    of_theta = start.theta_normaliser
    if of_theta is not None:
        of_theta = of_theta.replace(mean=jnp.array([0.2, -0.1]), scale=jnp.array([0.3, 0.25]))
    network = start.replace(params=params, theta_normaliser=of_theta)
    return start, network, network.condition(X, BOX)


# The two families of flows differ in their modules, which `estimators/test_flows.py` tests with the same laws.
SLOW = [pytest.mark.slow]


@pytest.fixture(scope="module", params=[pytest.param(name, marks=SLOW * (name == "maf")) for name in KINDS])
def case(request) -> Case:
    """One case for each family."""
    estimator = small(KINDS[request.param])
    return Case(estimator, *perturbed(jax.random.key(8), estimator))


@functools.cache
def cells(natural: bool) -> tuple[np.ndarray, float, tuple[np.ndarray, np.ndarray]]:
    """Centres of the cells of BOX, [n, n, 2], their area, and the cells' upper edges."""
    low, high = np.asarray(BOX.low, float), np.asarray(BOX.high, float)
    if natural:
        low, high = np.array([np.exp(low[0]), low[1]]), np.array([np.exp(high[0]), high[1]])
    width = (high - low) / CELLS
    axes = [low[d] + width[d] * (np.arange(CELLS) + 0.5) for d in range(2)]
    edges = tuple(axis + 0.5 * w for axis, w in zip(axes, width, strict=True))
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).astype(np.float32), float(width.prod()), edges


def log_prob(posterior: Posterior, space: str, points=()) -> tuple[np.ndarray, np.ndarray]:
    """Log-density at the centres of the cells, [n, n], and at some more points: always one shape, so compiled once."""
    theta, _, _ = cells(space == "natural")
    more = np.zeros((20, CELLS, 2), np.float32)
    more.reshape(-1, 2)[: len(points)] = np.reshape(points, (-1, 2))
    both = np.asarray(posterior.log_prob(np.concatenate([theta, more]), space), float)
    return both[:CELLS], both[CELLS:].reshape(-1)[: len(points)]


def sampled(posterior: Posterior, key: jax.Array) -> np.ndarray:
    """`DRAWS` draws, in inference space."""
    keys = jax.random.split(key, DRAWS // MAP_DRAWS)
    return np.concatenate([posterior.sample(key, MAP_DRAWS, space="inference") for key in keys])


@pytest.fixture(scope="module")
def draws(case) -> np.ndarray:
    """Draws of the posterior."""
    return sampled(case.posterior, jax.random.key(2))


def test_ours_are_registered():
    assert {"mdn", "maf", "nsf", "mdn_likelihood"} <= set(KINDS)


def test_families_are_found_by_their_names_and_written_to_json(case):
    name = ESTIMATORS.name_of(type(case.estimator))
    if isinstance(case.estimator, OneFile):
        assert name.endswith("test_estimators:OneFile")
        return
    assert ESTIMATORS.load(name) is type(case.estimator)
    described = to_json(case.estimator, lambda value: ESTIMATORS.name_of(type(value)))
    assert from_json(described, ESTIMATORS.load) == case.estimator


@pytest.mark.parametrize("case", ["mdn"], indirect=True)
def test_conditioning_is_the_same_compiled_and_not(case):
    """The family with the fewest operations, as each operation is compiled separately here."""
    assert_same_compiled_and_not(case)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["maf", "mdn_likelihood"], indirect=True)
def test_conditioning_of_other_families_is_the_same_compiled_and_not(case):
    """One flow and one likelihood: the other families share their code for conditioning."""
    assert_same_compiled_and_not(case)


def assert_same_compiled_and_not(case: Case) -> None:
    """The posterior of X is the same, whether operations are compiled one by one or together."""
    eager = case.network.condition(X, BOX)
    theta = np.stack([BOX.centre, BOX.low, BOX.high])
    np.testing.assert_allclose(
        log_prob(eager, "inference", theta)[1], log_prob(case.posterior, "inference", theta)[1], atol=5e-3
    )
    assert float(eager.mass_inside) == pytest.approx(float(case.posterior.mass_inside), abs=2e-3)
    # A mixture fitted to draws may have its components in another order, but not other moments.
    np.testing.assert_allclose(eager.mixture.mean, case.posterior.mixture.mean, atol=0.02)
    np.testing.assert_allclose(eager.mixture.covariance, case.posterior.mixture.covariance, atol=0.05)


@pytest.mark.slow
def test_conditioning_can_be_mapped_over_observations(case):
    x = jnp.stack([X, -X])
    both = jax.jit(jax.vmap(lambda x: case.network.condition(x, BOX).log_prob(BOX.centre, space="inference")))(x)
    assert float(both[0]) == pytest.approx(log_prob(case.posterior, "inference", [BOX.centre])[1][0], abs=5e-3)
    assert abs(float(both[1] - both[0])) > 0.01  # it depends on x


def test_some_of_the_density_is_inside_and_some_is_not(case):
    """Otherwise the tests below would test nothing. A likelihood is not a density of parameters, so it cannot leak."""
    if case.estimator.is_likelihood:
        assert float(case.posterior.mass_inside) == 1
    else:
        assert 0.02 < float(case.posterior.mass_inside) < 0.98


@pytest.mark.parametrize("space", ["natural", "inference"])
def test_the_density_is_one_in_all_inside_and_nothing_outside(case, space):
    theta, area, _ = cells(space == "natural")
    (low, bottom), (high, top) = theta[0, 0], theta[-1, -1]
    inside, outside = log_prob(
        case.posterior, space, [[low, bottom - 1], [high, top + 1], [high + 5, 0.0], [-100.0, 0.0]]
    )
    assert np.isfinite(inside).all()
    mass = float(case.posterior.mass_inside)
    # The truncation constant has the error of 10000 draws; a flow's density has kinks that cells blur.
    assert np.exp(inside).sum() * area == pytest.approx(1, abs=0.02 + 5 * np.sqrt((1 - mass) / mass / 10_000))
    assert np.isneginf(outside).all()


def test_draws_are_inside_and_have_the_density(case, draws):
    assert draws.shape == (DRAWS, 2)
    assert ((draws > np.asarray(BOX.low)) & (draws < np.asarray(BOX.high))).all()
    assert len(np.unique(draws, axis=0)) == DRAWS
    theta, _, edges = cells(False)
    density = np.exp(log_prob(case.posterior, "inference")[0])
    for d in range(2):
        cdf = np.cumsum(density.sum(1 - d)) / density.sum()
        law = lambda t, d=d, cdf=cdf: np.interp(t, np.append(float(BOX.low[d]), edges[d]), np.append(0.0, cdf))
        assert stats.kstest(draws[:, d], law).pvalue > 1e-3
    mass = density / density.sum()
    centred = theta.reshape(-1, 2) - mass.reshape(-1) @ theta.reshape(-1, 2)
    covariance = (centred * mass.reshape(-1, 1)).T @ centred
    correlation = covariance[0, 1] / np.sqrt(np.prod(np.diag(covariance)))
    assert np.corrcoef(draws.T)[0, 1] == pytest.approx(correlation, abs=5 / np.sqrt(DRAWS))


def test_draws_in_natural_units_are_the_same_draws(case, key):
    inner = case.posterior.sample(jax.random.clone(key), MAP_DRAWS, space="inference")
    np.testing.assert_allclose(case.posterior.sample(key, MAP_DRAWS), SPACE.to_natural(inner), rtol=1e-5)


def test_the_mixture_is_like_the_density(case, draws, key):
    """Heuristics and proposals see the mixture: truncated to the box, it has the moments of the posterior's draws."""
    mixture = case.posterior.mixture
    assert mixture.logits.shape == (case.estimator.ensemble_size * case.estimator.components,)
    chex.assert_tree_all_finite((mixture.means, mixture.scale_tril))
    like = Posterior(mixture, mixture, case.posterior.support, jnp.ones(()), SPACE)
    others = sampled(like, key)
    scale = draws.std(0)
    np.testing.assert_allclose((others.mean(0) - draws.mean(0)) / scale, 0, atol=0.2)
    np.testing.assert_allclose(others.std(0) / scale, 1, atol=0.2)


def test_the_maximum_is_above_all_draws(case, draws):
    peak = case.posterior.map()
    height = log_prob(case.posterior, "natural", np.concatenate([peak[None], SPACE.to_natural(draws)]))[1]
    assert height[0] >= height[1:].max() - 1e-3


def test_posteriors_are_pytrees(case):
    leaves, structure = jax.tree.flatten(case.posterior)
    again = jax.tree.unflatten(structure, leaves)
    np.testing.assert_array_equal(log_prob(again, "inference")[0], log_prob(case.posterior, "inference")[0])


def test_training_lowers_the_loss(case):
    """theta is drawn from the box, and x is a linear map of it with noise."""
    draw = np.random.default_rng(1)
    theta = draw.uniform(BOX.low, BOX.high, (80, 2)).astype(np.float32)
    x = theta @ np.float32([[1.0, 0.4, 0.0], [-0.2, 0.8, 1.0]]) + 0.1 * draw.normal(size=(80, 3)).astype(np.float32)
    dataset = datasets.empty(80, 2, 3).replace(theta=jnp.asarray(theta), x=jnp.asarray(x), size=jnp.asarray(80))

    def train(key, network):
        return fit(key, network.begun(dataset)[0], dataset, jnp.ones(80), 80)

    network, info = jax.jit(train)(jax.random.key(1), case.start)
    loss = np.asarray(info.loss)
    assert loss.shape == (2, 60) and np.isfinite(loss).all() and int(info.nonfinite.sum()) == 0
    assert (loss[:, -5:].mean(axis=1) < loss[:, 0] - 0.5).all()
    chex.assert_tree_all_finite(network.params)


def test_what_is_no_estimator_is_refused():
    for wrong, message in (
        ("glow", "expected one of"),
        ("builtins:dict", "a class derived from Estimator"),
        ("jaxlfi.estimators.base:Estimator", "with all its methods"),
        ("jaxlfi.estimators.flow_estimators:FlowEstimator", "with all its methods"),
        ("no_such_module:Thing", "cannot load"),
    ):
        with pytest.raises(ValueError, match=f"^estimator: .*{message}") as error:
            ESTIMATORS.load(wrong)
        assert "\n" not in str(error.value)


def test_settings_that_families_share_are_kept_from_one_to_another():
    mdn, nsf = KINDS["mdn"](hidden=(9, 9), ensemble_size=3, prune=0.1), KINDS["nsf"]
    other = converted(mdn, nsf, {"bins": 7})
    assert type(other) is nsf and (other.hidden, other.ensemble_size, other.bins) == ((9, 9), 3, 7)
    assert converted(mdn, KINDS["mdn"], {"prune": 0.2}) == mdn.replace(prune=0.2)
    with pytest.raises(ValueError, match=r"^bins: expected a setting of MixtureNetwork"):
        converted(mdn, KINDS["mdn"], {"bins": 7})
    with pytest.raises(ValueError, match=r"^bins: expected a whole number in \[1, 999\], got 0"):
        converted(mdn, nsf, {"bins": 0})
