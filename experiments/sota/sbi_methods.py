"""The methods of sbi (Tejero-Cantero et al. 2020; version 0.27) with their defaults, as in its documentation.

A method's loop over rounds is written as in sbi's own examples. Further decisions were:

- Failed simulations are dropped (`exclude_invalid_x=True`) and not replaced. That is sbi's default in a first round. In
  later rounds of APT and in all of SNLE, sbi requires it explicitly, as the correction and the likelihood are then
  those of valid simulations. Our methods also drop them.
- If nearly all of a flow's mass has leaked from the prior's box, rejection sampling does not end. After `PATIENCE`
  seconds, draws are made by sbi's slice sampler, as its warning advises; the note says "mcmc".
- SNLE draws with its default sampler, the vectorised slice sampler (20 chains, 200 steps of warm-up).
- TSNPE draws truncated proposals by rejection from the prior, which is `RestrictedPrior`'s default, and by its other
  sampler, sampling-importance-resampling, if no more than `LEAST_ACCEPTED` of the prior is accepted. The density
  threshold is found with `THRESHOLD_DRAWS`, a tenth of the default: a million takes minutes per round.
- PyTorch uses one thread: with two, networks of this size train more slowly, and far more so on a busy machine.
"""

import contextlib
import dataclasses
import io
import time
import warnings
from collections.abc import Callable

import jax
import numpy as np

from experiments.sota.cases import Case, Simulator
from experiments.sota.measures import DRAWS, Found, points
from jaxlfi.bayessim.keys import key_of, run_keys

try:
    import torch
    from sbi.inference import NLE, NPE, NPE_C
    from sbi.inference.posteriors import DirectPosterior, MCMCPosterior
    from sbi.inference.posteriors.posterior_parameters import MCMCPosteriorParameters
    from sbi.utils import BoxUniform, RestrictedPrior, get_density_thresholder, within_support
except ImportError as error:
    raise ImportError("methods of sbi: expected sbi and torch, got none: pip install -e '.[bench]'") from error

ROUNDS = 10
PATIENCE = 20.0
"""Seconds after which rejection sampling is given up."""
THRESHOLD_DRAWS = 100_000
"""Number of posterior draws by which TSNPE finds the density that all but 1e-4 of its mass exceeds."""
LEAST_ACCEPTED = 1e-4
"""Accepted fraction of the prior below which TSNPE does not draw from it by rejection."""
PROBES = 10_000
"""Number of draws that estimate the mass in the box, or the accepted fraction."""


class _Silent:
    """A tracker that writes nothing, in place of TensorBoard's files."""

    log_dir = None

    def _ignored(self, *values, **named) -> None: ...

    log_metric = log_metrics = log_params = add_figure = flush = _ignored


QUIET = {"show_progress_bars": False, "tracker": _Silent()}


def infer(method: str, case: Case, simulations: int) -> Found:
    """The posterior of a case by one of `METHODS`; the time covers simulating, training and drawing."""
    seed = case.seed
    torch.manual_seed(seed)
    np.random.seed(seed)  # noqa: NPY002  the slice sampler draws from it
    torch.set_num_threads(1)
    prior = _prior(case)
    simulator = Simulator(case.task, jax.random.fold_in(run_keys(key_of(seed)).run, 1))
    rounds, said = 1 if method == "sbi-npe" else ROUNDS, io.StringIO()
    simulator.compile(prior.sample((simulations // rounds,)).numpy())
    with warnings.catch_warnings(), contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        warnings.simplefilter("ignore")
        began = time.perf_counter()
        posterior = METHODS[method](simulator, prior, torch.as_tensor(case.x)[None], simulations // rounds)
        draws, note = _draws(posterior, DRAWS)
        seconds = time.perf_counter() - began
        log_prob = None if method == "sbi-snle" else _log_prob(posterior, torch.as_tensor(points(case)))
    return Found(draws.numpy(), log_prob, seconds, 0.0, simulator.simulated, simulator.failed, note)


def _prior(case: Case):
    """The case's prior as a torch distribution."""
    if case.prior is None:
        return BoxUniform(torch.tensor(np.array(case.box.low)), torch.tensor(np.array(case.box.high)))
    mean, covariance = np.array(case.prior.mean()), np.diag(np.array(case.prior.variance()))
    return torch.distributions.MultivariateNormal(torch.as_tensor(mean), torch.as_tensor(covariance))


def _draws(distribution, count: int) -> tuple:
    """Draws [count, D], and "mcmc" if rejection sampling was given up."""
    if isinstance(distribution, MCMCPosterior):
        return distribution.sample((count,), show_progress_bars=False), ""
    if not isinstance(distribution, DirectPosterior):
        return distribution.sample((count,)), ""
    try:
        return distribution.sample((count,), show_progress_bars=False, max_sampling_time=PATIENCE), ""
    except RuntimeError:
        chains = MCMCPosterior(
            distribution.potential_fn,
            distribution.prior,
            distribution.theta_transform,
            **dataclasses.asdict(MCMCPosteriorParameters()),
        )
        return chains.sample((count,), x=distribution.default_x, show_progress_bars=False), "mcmc"


def _log_prob(posterior, theta) -> np.ndarray:
    """Log-density at theta [P, D], divided by the mass in the box.

    sbi's own estimate of that mass draws until 10,000 are inside, which never ends if none are. This one makes `PROBES`
    draws in total, and counts at least one as inside.
    """
    flow, x = posterior.posterior_estimator, posterior.default_x
    with torch.no_grad():
        held = within_support(posterior.prior, flow.sample((PROBES,), condition=x)[:, 0]).float().mean().item()
    return posterior.log_prob(theta, norm_posterior=False).numpy() - np.log(max(held, 1 / PROBES))


def _simulated(simulator: Simulator, proposal, count: int) -> tuple:
    theta = _draws(proposal, count)[0]
    return theta, torch.as_tensor(simulator(theta.numpy()))


def _npe(simulator: Simulator, prior, x, count: int):
    trainer = NPE(prior, **QUIET)
    trainer.append_simulations(*_simulated(simulator, prior, count)).train()
    return trainer.build_posterior().set_default_x(x)


def _apt(simulator: Simulator, prior, x, count: int):
    trainer, proposal = NPE_C(prior, **QUIET), prior
    for _ in range(ROUNDS):
        theta, simulated = _simulated(simulator, proposal, count)
        if torch.isfinite(simulated).all(dim=1).sum() < 2:
            continue  # nothing to learn from: the same proposal is used again
        trainer.append_simulations(theta, simulated, proposal=proposal, exclude_invalid_x=True).train()
        proposal = trainer.build_posterior().set_default_x(x)
    return proposal


def _tsnpe(simulator: Simulator, prior, x, count: int):
    trainer, proposal = NPE(prior, **QUIET), prior
    for index in range(ROUNDS):
        trainer.append_simulations(*_simulated(simulator, proposal, count)).train(force_first_round_loss=True)
        posterior = trainer.build_posterior().set_default_x(x)
        if index < ROUNDS - 1:  # the last posterior is not used as a proposal
            accepts = get_density_thresholder(posterior, num_samples_to_estimate_support=THRESHOLD_DRAWS)
            accepted = accepts(prior.sample((PROBES,))).float().mean()
            proposal = RestrictedPrior(
                prior, accepts, posterior, sample_with="rejection" if accepted > LEAST_ACCEPTED else "sir"
            )
    return posterior


def _snle(simulator: Simulator, prior, x, count: int):
    trainer, proposal = NLE(prior, **QUIET), prior
    for _ in range(ROUNDS):
        trainer.append_simulations(*_simulated(simulator, proposal, count), exclude_invalid_x=True).train()
        proposal = trainer.build_posterior().set_default_x(x)
    return proposal


METHODS: dict[str, Callable] = {"sbi-npe": _npe, "sbi-apt": _apt, "sbi-tsnpe": _tsnpe, "sbi-snle": _snle}
