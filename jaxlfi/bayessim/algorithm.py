"""Iterative BayesSim with support adaptation: Algorithm 1, lines 9-20, as init / step / run."""

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from jaxlfi.bayessim.correction import CORRECTIONS, CorrectionInfo, effective_size
from jaxlfi.distributions.belief import RESTRICTIONS, Belief, uninformed
from jaxlfi.distributions.support import Support
from jaxlfi.estimators import dataset as datasets
from jaxlfi.estimators.dataset import Dataset
from jaxlfi.estimators.estimator import Estimator, Network, initialise, normalisers, static
from jaxlfi.estimators.posterior import posterior
from jaxlfi.estimators.training import FitInfo, fit
from jaxlfi.heuristics import Adaptation, Heuristic
from jaxlfi.tasks.simulation import Simulations, simulate, within_budget
from jaxlfi.tasks.task import Task


@struct.dataclass
class Settings:
    """The numbers of one inference run. The defaults are the paper's.

    Attributes:
        estimator: the network and its training.
        rounds: inference iterations N_LFI.
        simulations_per_round: simulations added to the dataset each round, at most.
        simulation_budget: simulations attempted each round, at most, failures included.
        correction: how q_phi becomes the posterior, "none", "paper" or "importance" (reading A).
        restriction: how draws are kept in the support, "clip" or "reject" (reading E).
        defensive: share of each round's proposals drawn from the prior over the current support instead of the
            posterior. 0 is the paper. A leaf.
    """

    estimator: Estimator = Estimator()
    defensive: Float[Array, "*batch"] | float = 0.0
    rounds: int = static(10)
    simulations_per_round: int = static(100)
    simulation_budget: int = static(125)
    correction: str = static("none")
    restriction: str = static("clip")

    def check(self) -> "Settings":
        """Refuse settings that cannot work, by name; returns the settings."""
        self.estimator.check()
        for field, known in {"correction": CORRECTIONS, "restriction": RESTRICTIONS}.items():
            if getattr(self, field) not in known:
                raise ValueError(f"{field}: expected one of {sorted(known)}, got {getattr(self, field)!r}")
        if self.rounds < 1 or self.simulations_per_round < 1:
            raise ValueError(
                f"expected at least 1 round and 1 addition, got {self.rounds} and {self.simulations_per_round}"
            )
        if isinstance(self.defensive, float | int) and not 0 <= self.defensive <= 1:
            raise ValueError(f"defensive: expected a share in [0, 1], got {self.defensive}")
        if self.simulation_budget < self.simulations_per_round:
            raise ValueError(
                f"simulation_budget: expected at least the {self.simulations_per_round} simulations of a round, "
                f"got {self.simulation_budget}"
            )
        return self


@struct.dataclass
class State:
    """What the next round needs.

    Attributes:
        belief: the reference prior p_i on its support Theta_i.
        proposals: the beliefs the rounds so far drew from, stacked, with room for all rounds.
        dataset: all simulations so far.
        network: the density estimator's weights.
        feasible: Phi. A named support that the task declares wider than Phi widens it for the run.
    """

    belief: Belief
    proposals: Belief
    dataset: Dataset
    network: Network
    feasible: Support


@struct.dataclass
class Round:
    """What one round did; `run` stacks these.

    Attributes:
        simulations: what was simulated.
        failed: failures by reason, shape [R].
        proposal: the belief that was drawn from.
        belief: the posterior on the adapted support.
        adaptation: what the heuristic saw and did.
        correction: what the posterior's correction did.
        fit: losses.
    """

    simulations: Simulations
    failed: Int[Array, "*batch reason"]
    proposal: Belief
    belief: Belief
    adaptation: Adaptation
    correction: CorrectionInfo
    fit: FitInfo


def init(key: jax.Array, task: Task, support: Support, settings: Settings, observed: Float[Array, " obs"]) -> State:
    """The state before the first round: no data, and nothing believed but the support."""
    chex.assert_rank(observed, 1)
    chex.assert_shape([support.low, support.high], (task.dim,))
    components = settings.estimator.ensemble_size * settings.estimator.components
    belief = uninformed(support, components)
    obs = observed.shape[-1]
    feasible = task.feasible.hull(support)
    nothing = datasets.empty(settings.rounds * settings.simulations_per_round, task.dim, obs)
    return State(
        belief=belief,
        proposals=jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (settings.rounds, *leaf.shape)), belief),
        dataset=nothing,
        network=Network(
            initialise(key, settings.estimator, task.dim, obs), *normalisers(settings.estimator, nothing, feasible)
        ),
        feasible=feasible,
    )


def propose(key: jax.Array, task: Task, settings: Settings, belief: Belief) -> Float[Array, "attempts dim"]:
    """Draw theta ~ p_i (line 11): the prior over Theta_0 in the first round, then the restricted posterior.

    A belief that is not informed is the prior over its support: so it is in the first round, and always by `Truncate`.
    A defensive share of the draws stays with the prior over the *current* support: it sees the ground that the
    support has gained, also where the posterior has locked itself onto a place where it learns nothing more.
    """
    key_prior, key_posterior, key_share = jax.random.split(key, 3)
    informed = RESTRICTIONS[settings.restriction](key_posterior, belief, settings.simulation_budget)
    prior = prior_draws(key_prior, task, belief.support, settings.simulation_budget)
    from_prior = jax.random.bernoulli(key_share, settings.defensive, (settings.simulation_budget, 1)) | ~belief.informed
    return jnp.where(from_prior, prior, informed)


def prior_draws(key: jax.Array, task: Task, support: Support, n: int) -> Float[Array, "n dim"]:
    """`n` draws of the task's prior inside the support: uniform unless the task brings a prior of its own."""
    if task.prior is None:
        return support.sample(key, n)
    tries = 32
    candidates = task.prior.sample(seed=key, sample_shape=(n, tries))
    inside = support.contains(candidates)
    first = jnp.take_along_axis(candidates, jnp.argmax(inside, axis=1)[:, None, None], axis=1)[:, 0]
    return support.clip(first)


def update(
    key: jax.Array,
    task: Task,
    settings: Settings,
    heuristic: Heuristic,
    observed: Float[Array, " obs"],
    state: State,
    round: Int[Array, ""] | int,
    attempts: Simulations,
) -> tuple[State, Round]:
    """All of a round that comes after its simulations (lines 12-20)."""
    dataset = datasets.augment(state.dataset, attempts, round)
    proposals = jax.tree.map(lambda all_, now: all_.at[round].set(now), state.proposals, state.belief)
    network = _started(settings.estimator, state, dataset)
    correction = CORRECTIONS[settings.correction]
    weights = correction.row_weights(task, dataset, proposals, round, settings.defensive)
    expected = (round + 1) * settings.simulations_per_round
    # An MDN is read off, a flow is drawn from.
    key_fit, key_draw = jax.random.split(key) if settings.estimator.is_flow else (key, None)
    log_prior = None if task.prior is None else task.prior.log_prob(dataset.theta)
    network, fit_info = fit(key_fit, settings.estimator, network, dataset, weights, state.feasible, expected, log_prior)
    q, inside = posterior(key_draw, settings.estimator, network, observed, state.feasible, state.belief.support)
    mixture, not_positive_definite = correction.change(task, q, state.belief)
    belief, adaptation = heuristic(state.belief, mixture, state.feasible)
    info = Round(
        simulations=attempts,
        failed=attempts.failed(len(task.reasons)),
        proposal=state.belief,
        belief=belief,
        adaptation=adaptation,
        correction=CorrectionInfo(effective_size(weights), not_positive_definite, inside),
        fit=fit_info,
    )
    return State(belief, proposals, dataset, network, state.feasible), info


def _started(estimator: Estimator, state: State, dataset: Dataset) -> Network:
    """A network that is trained on takes its normalisers from the first round that has simulations."""
    fresh = Network(state.network.params, *normalisers(estimator, dataset, state.feasible))
    return jax.tree.map(lambda kept, new: jnp.where(state.dataset.size > 0, kept, new), state.network, fresh)


def step(
    key: jax.Array,
    task: Task,
    settings: Settings,
    heuristic: Heuristic,
    observed: Float[Array, " obs"],
    state: State,
    round: Int[Array, ""] | int,
) -> tuple[State, Round]:
    """One round of Algorithm 1 for a simulator in JAX (lines 11-20).

    Args:
        key: consumed.
        task: simulator, names and bounds.
        settings: the numbers of the run.
        heuristic: how the support is adapted.
        observed: the real trajectory's summary x^r, shape [S].
        state: what the rounds before left.
        round: index i of the round, from 0.

    Returns:
        The next state, and what the round did.
    """
    key_propose, key_simulate, key_update = jax.random.split(key, 3)
    theta = propose(key_propose, task, settings, state.belief)
    x, failure = simulate(key_simulate, task, theta)
    attempts = within_budget(theta, x, failure, settings.simulations_per_round)
    return update(key_update, task, settings, heuristic, observed, state, round, attempts)


def run(
    key: jax.Array,
    task: Task,
    settings: Settings,
    heuristic: Heuristic,
    observed: Float[Array, " obs"],
    support: Support,
) -> tuple[State, Round]:
    """The whole inference, as one scan: Algorithm 1, lines 9-20.

    Pure: jit it, and vmap it over keys, supports, observations and the leaves of heuristics and settings.

    Returns:
        The last state, and what every round did, stacked along a leading axis of length `settings.rounds`.
    """
    key_init, key_rounds = jax.random.split(key)
    state = init(key_init, task, support, settings, observed)

    def body(state, round):
        return step(jax.random.fold_in(key_rounds, round), task, settings, heuristic, observed, state, round)

    return jax.lax.scan(body, state, jnp.arange(settings.rounds))
