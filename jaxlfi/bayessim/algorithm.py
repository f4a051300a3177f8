"""Iterative BayesSim with support adaptation: Algorithm 1, lines 6-17, as init / step / run."""

from collections.abc import Callable
from typing import Any

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from jaxlfi.bayessim.convergence import Progress, advanced, not_begun
from jaxlfi.bayessim.correction import CORRECTIONS, CorrectionInfo, effective_size
from jaxlfi.bayessim.keys import RoundKeys, init_key, round_keys
from jaxlfi.bayessim.settings import Settings
from jaxlfi.distributions.belief import RESTRICTIONS, Belief, uninformed
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.region import Region
from jaxlfi.distributions.support import Support
from jaxlfi.distributions.truncated_mixture import rough_mass
from jaxlfi.estimators import dataset as datasets
from jaxlfi.estimators import validity
from jaxlfi.estimators.base import Network, untrained
from jaxlfi.estimators.dataset import Dataset
from jaxlfi.estimators.posterior import Posterior
from jaxlfi.estimators.training import FitInfo, Lesson, fit_keys, prepare, train, trained
from jaxlfi.heuristics import Adaptation, Heuristic
from jaxlfi.tasks.priors import prior_draws
from jaxlfi.tasks.simulation import Simulations, simulate, within_budget
from jaxlfi.tasks.task import Task

WHOLE = 20
"""Number of rounds whose epochs go through all simulations so far: by default, all rounds of a run.

If an unlimited number did, the time of a run would grow with the square of its rounds.
"""


class State(struct.PyTreeNode):
    """The state that a round passes on to the next.

    Attributes:
        belief: the reference prior p_i on its support Theta_i, from which the next round proposes and adapts.
        reported: the belief that the run reports: the same, unless the correction divides out the pooled proposals.
        proposals: the proposals of the rounds so far, stacked, with room for all rounds.
        dataset: all simulations so far.
        network: the density estimator.
        progress: number of rounds made, and whether the posterior still moves.
        attempts: parameters of all simulations so far, including failed ones, whose summaries are 1 for success and 0
            for failure; None unless the estimator has to learn the probability of success.
    """

    belief: Belief
    reported: Belief
    proposals: Belief
    dataset: Dataset
    network: Network
    progress: Progress
    attempts: Dataset | None = None

    @property
    def feasible(self) -> Support:
        """Phi; a named support that the task declares wider than Phi widens it for the run."""
        return self.network.scale


class Gathered(struct.PyTreeNode):
    """The state of a round before it trains the network.

    Attributes:
        simulations: simulations of the round.
        dataset: all simulations so far.
        attempts: as in `State`.
        proposals: the proposals of all rounds, including this one.
        lesson: the network, and its training data.
        effective_size: effective number of simulations under the loss weights, shape [].
    """

    simulations: Simulations
    dataset: Dataset
    attempts: Dataset | None
    proposals: Belief
    lesson: Lesson
    effective_size: Float[Array, "*batch"]


class Round(struct.PyTreeNode):
    """The outcome of one round; `run` stacks these.

    Attributes:
        simulations: simulations of the round.
        failed: number of failures by reason, shape [R].
        proposal: the distribution that parameters were drawn from.
        belief: the posterior on the adapted support.
        adaptation: the heuristic's evidence and changes.
        correction: record of the posterior's correction.
        fit: losses of the training.
    """

    simulations: Simulations
    failed: Int[Array, "*batch reason"]
    proposal: Belief
    belief: Belief
    adaptation: Adaptation
    correction: CorrectionInfo
    fit: FitInfo


def init(
    key: jax.Array,
    task: Task,
    support: Support,
    settings: Settings,
    observed: Float[Array, " obs"],
    first: int | None = None,
) -> State:
    """The state before the first round: no data, and a uniform belief on the support.

    Args:
        key: consumed.
        task: simulator, names and bounds.
        support: Theta_0, in inference space.
        settings: settings of the run.
        observed: the real trajectory's summary x^r, shape [S].
        first: number of simulations of the first round, if they are given and not made.
    """
    chex.assert_rank(observed, 1)
    chex.assert_shape([support.low, support.high], (task.dim,))
    belief = uninformed(support, settings.estimator.ensemble_size * settings.estimator.components)
    obs = observed.shape[-1]
    room = lambda each: (each if first is None else first) + (settings.rounds - 1) * each
    capacity = room(settings.simulations_per_round)
    network = untrained(
        key, settings.estimator, obs, task.inference.feasible.hull(support), task.space, task.inference.prior, capacity
    )
    attempts = None
    if settings.estimator.includes_prior:  # independently of the proposals, and so of which simulations succeeded
        key_validity = jax.random.fold_in(jax.random.clone(key), 1)
        network = network.replace(validity=validity.unknown(key_validity, network.scale, task.space))
        attempts = datasets.empty(room(settings.simulation_budget), task.dim, 1)
    return State(
        belief=belief,
        reported=belief,
        proposals=jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (settings.rounds, *leaf.shape)), belief),
        dataset=datasets.empty(capacity, task.dim, obs),
        network=network,
        progress=not_begun(task.dim),
        attempts=attempts,
    )


def proposal(settings: Settings, belief: Belief) -> Belief:
    """The distribution that a round draws from: the belief, widened by the factor `settings.inflation`."""
    return belief.replace(mixture=belief.mixture.inflated(settings.inflation))


def support_before(state: State, round: Int[Array, ""] | int) -> Support:
    """The support that the previous round proposed in; in the first round, its own."""
    return jax.tree.map(lambda leaf: leaf[jnp.maximum(round - 1, 0)], state.proposals.support)


def propose(
    key: jax.Array, prior: Any, settings: Settings, belief: Belief, before: Support | None = None
) -> Float[Array, "attempts dim"]:
    """Draw theta ~ p_i (line 8): the prior over Theta_0 in the first round, then the restricted posterior.

    A belief that is not informed is the prior over its support: in the first round, and always with `Truncate`. Unless
    something else accounts for the task's own prior, it is a factor of the proposals: otherwise the posterior would
    forget it after the first round. Nothing is proposed where it is zero. A defensive fraction of the draws comes from
    the prior over the *current* support: it covers newly gained regions, even if the posterior is stuck in a region
    where it learns nothing more.

    Args:
        key: consumed.
        prior: prior of the task (`Task.inference.prior`), None for a uniform one.
        settings: settings of the run.
        belief: belief after the previous round.
        before: support that the previous round proposed in, by which restrictions recognise bounds that have moved;
            None if it is unknown.
    """
    key_prior, key_posterior, key_choice = jax.random.split(key, 3)
    attempts = settings.simulation_budget
    factor = None if prior is None or settings.includes_prior else prior.log_prob
    inside = None if prior is None else Region(belief.support, prior)
    informed = RESTRICTIONS[settings.restriction](
        key_posterior, belief, attempts, settings.inflation, factor, inside, before
    )
    from_prior = jax.random.bernoulli(key_choice, settings.defensive, (attempts, 1)) | ~belief.informed
    return jnp.where(from_prior, prior_draws(key_prior, prior, belief.support, attempts), informed)


def update(
    key: jax.Array,
    task: Task,
    settings: Settings,
    heuristic: Heuristic,
    observed: Float[Array, " obs"],
    state: State,
    round: Int[Array, ""] | int,
    simulations: Simulations,
) -> tuple[State, Round]:
    """The part of a round that follows its simulations (lines 9-17)."""
    prior = task.inference.prior
    key_fit, key_condition = settings.estimator.keys(key)
    gathered = gather(jax.random.clone(key_fit), prior, settings, state, round, simulations)
    _, key_train = fit_keys(key_fit)
    learnt = train(key_train, gathered.lesson, expected_size(settings, state, round))
    return conclude(
        key_condition, prior, len(task.reasons), settings, heuristic, observed, state, round, gathered, learnt
    )


def gather(
    key: jax.Array,
    prior: Any,
    settings: Settings,
    state: State,
    round: Int[Array, ""] | int,
    simulations: Simulations,
) -> Gathered:
    """Add the round's simulations to the dataset, and prepare the network for training on it (line 9).

    Args:
        key: key of the fit, consumed; its other part is for training.
        prior: prior of the task (`Task.inference.prior`), None for a uniform one.
        settings: settings of the run.
        state: state after the previous rounds.
        round: index of the round, from 0.
        simulations: simulations of the round.
    """
    dataset = datasets.augment(state.dataset, simulations, round)
    proposed = proposal(settings, state.belief)
    proposals = jax.tree.map(lambda all_, now: all_.at[round].set(now), state.proposals, proposed)
    weights = CORRECTIONS[settings.correction].row_weights(prior, dataset, proposals, round, settings.defensive)
    log_prior = None if prior is None else prior.log_prob(dataset.theta)
    network, attempts = _started(state, dataset), state.attempts
    if attempts is not None:
        attempts = datasets.augment(attempts, _outcomes(simulations), round)
        learnt = network.validity.learnt(jax.random.fold_in(jax.random.clone(key), 1), attempts)
        network = network.replace(validity=learnt)
        # Atomic losses compare successful simulations, so success is part of their prior.
        log_prior = (0.0 if log_prior is None else log_prior) + learnt.log_prob(dataset.theta)
    key_prepare, _ = fit_keys(key)
    lesson = prepare(key_prepare, network, dataset, weights, log_prior, _rows_after(settings, state, WHOLE - 1))
    return Gathered(simulations, dataset, attempts, proposals, lesson, effective_size(weights))


def expected_size(settings: Settings, state: State, round: Int[Array, ""] | int) -> Int[Array, ""] | int:
    """Number of simulations per epoch in a round without failures: all so far, in the first `WHOLE` rounds.

    In later rounds it is the average of those rounds, and epochs take turns through all simulations, so that the time
    of a run is proportional to its rounds.
    """
    size = _rows_after(settings, state, round)
    if settings.rounds <= WHOLE:
        return size
    return jnp.where(round < WHOLE, size, _rows_after(settings, state, (WHOLE - 1) // 2))


def _rows_after(settings: Settings, state: State, round: Any) -> Any:
    """Number of rows of the dataset after a round without failures: its capacity less the room for later rounds."""
    return state.dataset.capacity - (settings.rounds - 1 - round) * settings.simulations_per_round


def conclude(
    key: jax.Array | None,
    prior: Any,
    reasons: int,
    settings: Settings,
    heuristic: Heuristic,
    observed: Float[Array, " obs"],
    state: State,
    round: Int[Array, ""] | int,
    gathered: Gathered,
    learnt: tuple[dict, FitInfo],
) -> tuple[State, Round]:
    """Compute the posterior with the trained network, and adapt the support to it (lines 11-17).

    Args:
        key: consumed; None for an estimator of closed form.
        prior: as in `gather`.
        reasons: number of reasons for which a simulation can fail.
        settings: settings of the run.
        heuristic: rule that adapts the support.
        observed: the real trajectory's summary x^r, shape [S].
        state: state after the previous rounds.
        round: index of the round, from 0.
        gathered: simulations of this round and the previous ones.
        learnt: the trained weights, and the losses (line 10).
    """
    params, fit_info = learnt
    network, correction = trained(gathered.lesson, params), CORRECTIONS[settings.correction]
    proposed = proposal(settings, state.belief)
    posterior = network.condition(observed, state.belief.support, key)
    mixture, not_positive_definite = correction.change(prior, posterior.mixture, proposed)
    quotients = None
    if correction.divide is not None:
        before = (gathered.proposals, round, settings.defensive, state.belief.support, gathered.dataset.size)
        quotients = correction.divide(prior, mixture, *before)
        estimator: Any = network.estimator  # it has a closed form: `Settings.check` ensures that
        weighted = estimator.weighted(network, posterior.density)
        mixture = quotients.proposed(mixture, weighted)
    belief, adaptation = heuristic(state.belief, mixture, state.feasible)
    reported, effective_share = belief, jnp.ones(())
    if quotients is not None:
        divided, effective_share = quotients.reported(weighted)
        reported = belief.replace(mixture=divided)
    info = Round(
        simulations=gathered.simulations,
        failed=gathered.simulations.failed(reasons),
        proposal=proposed,
        belief=reported,
        adaptation=adaptation,
        correction=CorrectionInfo(
            gathered.effective_size, not_positive_definite, _mass_inside(posterior), effective_share
        ),
        fit=fit_info,
    )
    progress = advanced(state.progress, mixture, settings.min_rounds)
    after = State(belief, reported, gathered.proposals, gathered.dataset, network, progress, gathered.attempts)
    return _unless_settled(state, after, info) if settings.min_rounds else (after, info)


def _mass_inside(posterior: Posterior) -> Float[Array, ""]:
    """For the record; computing a mixture's exactly would be a sixth of what is compiled for the end of a round."""
    if isinstance(posterior.density, GaussianMixture):
        return rough_mass(posterior.density, posterior.region)
    return posterior.mass_inside


def _unless_settled(before: State, after: State, info: Round) -> tuple[State, Round]:
    """The round that was made; or, for a settled run, its state unchanged and a round without simulations."""
    settled = before.progress.settled
    state = jax.tree.map(lambda was, now: jnp.where(settled, was, now), before, after)
    simulations, adaptation = info.simulations, info.adaptation
    nothing = info.replace(
        simulations=simulations.replace(
            counted=jnp.zeros_like(simulations.counted), kept=jnp.zeros_like(simulations.kept)
        ),
        failed=jnp.zeros_like(info.failed),
        belief=before.reported,
        adaptation=adaptation.replace(
            low_shift=jnp.zeros_like(adaptation.low_shift), high_shift=jnp.zeros_like(adaptation.high_shift)
        ),
    )
    return state, jax.tree.map(lambda was, now: jnp.where(settled, was, now), nothing, info)


def _outcomes(simulations: Simulations) -> Simulations:
    """All attempted simulations, with their outcomes as summaries: 1 for success, 0 for failure."""
    success = (simulations.failure == 0).astype(jnp.float32)
    return simulations.replace(x=success[:, None], kept=simulations.counted)


def _started(state: State, dataset: Dataset) -> Network:
    """The network; if its training continues, its normalisers are those of the first round with simulations."""
    if not state.network.estimator.warm_start:
        return state.network  # each fit reinitialises it
    fresh, _ = state.network.begun(dataset)
    return jax.tree.map(lambda kept, new: jnp.where(state.dataset.size > 0, kept, new), state.network, fresh)


def step(
    keys: RoundKeys,
    task: Task,
    settings: Settings,
    heuristic: Heuristic,
    observed: Float[Array, " obs"],
    state: State,
    round: Int[Array, ""] | int,
) -> tuple[State, Round]:
    """One round of Algorithm 1 for a simulator in JAX (lines 8-17).

    Args:
        keys: keys of the round, consumed.
        task: simulator, names and bounds.
        settings: settings of the run.
        heuristic: rule that adapts the support.
        observed: the real trajectory's summary x^r, shape [S].
        state: state after the previous rounds.
        round: index i of the round, from 0.

    Returns:
        The next state, and what the round did.
    """
    theta = propose(keys.propose, task.inference.prior, settings, state.belief, support_before(state, round))
    x, failure = simulate(keys.simulate, task, theta)
    simulations = within_budget(theta, x, failure, settings.simulations_per_round)
    return update(keys.update, task, settings, heuristic, observed, state, round, simulations)


def run(
    key: jax.Array,
    task: Task,
    settings: Settings,
    heuristic: Heuristic,
    observed: Float[Array, " obs"],
    support: Support,
    look: Callable[[Array, State, Round], Any] = lambda index, state, info: info,
) -> tuple[State, Any]:
    """The whole inference, as one scan: Algorithm 1, lines 6-17.

    Pure: jit it, and vmap it over keys, supports, observations and the leaves of heuristics and settings.

    Args:
        key: consumed (`RunKeys.run`).
        task: a task whose simulator is in JAX.
        settings: settings of the run.
        heuristic: rule that adapts the support.
        observed: the real trajectory's summary x^r, shape [S].
        support: Theta_0, in inference space.
        look: function of a round's index, the state after it and its outcome, which returns what is kept of the round;
            by default, the outcome.

    Returns:
        The last state, and what was kept of every round, stacked along a leading axis of length `settings.rounds`.
        Once a run has settled, its rounds have no simulations and leave its state unchanged.
    """
    state = init(init_key(key), task, support, settings, observed)

    def body(state, index):
        state, info = step(round_keys(key, index), task, settings, heuristic, observed, state, index)
        return state, look(index, state, info)

    return jax.lax.scan(body, state, jnp.arange(settings.rounds))
