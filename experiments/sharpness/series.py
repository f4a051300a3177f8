"""Raw series with memory: autoregressions with exact likelihoods, and latent processes with particle filters."""

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy import special

from experiments.sharpness.counts import poisson_log_prob
from experiments.sharpness.problem import Problem
from jaxlfi.envs.mg1 import interdeparture_times

LENGTH = 60


def _normal_log_prob(x, mean, deviation):
    return -0.5 * ((x - mean) / deviation) ** 2 - jnp.log(deviation)


def _markov(key, start, deviation, step):
    """A Gaussian Markov chain that is stationary from the start: x_t = step(x_{t-1}) + deviation e_t."""
    noise = jax.random.normal(key, (LENGTH,))
    first = start[0] + start[1] * noise[0]

    def move(x, e):
        x = step(x) + deviation * e
        return x, x

    _, later = lax.scan(move, first, noise[1:])
    return jnp.concatenate([first[None], later])


def _ar1(key, theta):
    memory, deviation = theta
    stationary = deviation / jnp.sqrt(1 - memory**2)
    return _markov(key, (0.0, stationary), deviation, lambda x: memory * x)


def _ar1_likelihood(key, theta, x):
    memory, deviation = theta
    first = _normal_log_prob(x[0], 0.0, deviation / jnp.sqrt(1 - memory**2))
    return first + jnp.sum(_normal_log_prob(x[1:], memory * x[:-1], deviation))


INTERVAL = 0.25
"""Seconds between records of the Ornstein-Uhlenbeck process."""


def _transition(theta):
    rate, _, noise = theta
    memory, stationary = jnp.exp(-rate * INTERVAL), noise / jnp.sqrt(2 * rate)
    return memory, stationary, stationary * jnp.sqrt(1 - memory**2)


def _ornstein_uhlenbeck(key, theta):
    memory, stationary, deviation = _transition(theta)
    return _markov(key, (theta[1], stationary), deviation, lambda x: theta[1] + memory * (x - theta[1]))


def _ornstein_uhlenbeck_likelihood(key, theta, x):
    memory, stationary, deviation = _transition(theta)
    later = _normal_log_prob(x[1:], theta[1] + memory * (x[:-1] - theta[1]), deviation)
    return _normal_log_prob(x[0], theta[1], stationary) + jnp.sum(later)


# ------------------------------------------------------------------------------------------- particle filters


def resampled(key, log_weight):
    """Indices of particles drawn by their weights with systematic resampling, shape [P]."""
    count = len(log_weight)
    cumulated = jnp.cumsum(jax.nn.softmax(log_weight))
    points = (jnp.arange(count) + jax.random.uniform(key)) / count * cumulated[-1]
    return jnp.clip(jnp.searchsorted(cumulated, points), 0, count - 1)


def particle_filter(key, start, move, observations, count):
    """The logarithm of an unbiased estimate of the likelihood, by a particle filter that resamples at every record.

    Args:
        key: consumed.
        start: a pytree of particles before the first record, with a leading axis [P].
        move: `(key, particles, observation) -> (particles, log-weights [P])`: particles moved to the record, and the
            weights that it gives them; their predictive densities if the filter moves them knowing the record.
        observations: of the records, shape [T, ...].
        count: of particles, P.
    """

    def step(carry, record):
        particles, total = carry
        key, observation = record
        key_move, key_resample = jax.random.split(key)
        particles, log_weight = move(key_move, particles, observation)
        total = total + special.logsumexp(log_weight) - jnp.log(count)
        # If no particle explains the record, the estimate is zero and stays so.
        chosen = resampled(key_resample, jnp.where(jnp.isfinite(log_weight), log_weight, -1e30))
        return (jax.tree.map(lambda leaf: leaf[chosen], particles), total), None

    keys = jax.random.split(key, len(observations))
    (_, total), _ = lax.scan(step, (start, jnp.zeros(())), (keys, observations))
    return jnp.where(jnp.isnan(total), -jnp.inf, total)


RICKER_RECORDS, RICKER_PARTICLES = 50, 400


def _ricker_step(theta, population, noise):
    growth, deviation, _ = theta
    return population * jnp.exp(growth - population + deviation * noise)


def _ricker(key, theta):
    """Counts of a population that grows and crashes."""
    key_noise, key_count = jax.random.split(key)

    def step(population, noise):
        population = _ricker_step(theta, population, noise)
        return population, population

    _, populations = lax.scan(step, jnp.ones(()), jax.random.normal(key_noise, (RICKER_RECORDS,)))
    return jax.random.poisson(key_count, theta[2] * populations).astype(jnp.float32)


def _ricker_likelihood(key, theta, x):
    def move(key, population, count):
        population = _ricker_step(theta, population, jax.random.normal(key, population.shape))
        return population, poisson_log_prob(count, theta[2] * population)

    return particle_filter(key, jnp.ones(RICKER_PARTICLES), move, x, RICKER_PARTICLES)


JOBS, QUEUE_PARTICLES = 50, 100


def _mg1(key, theta):
    """Inter-departure times of a queue, in order of departure."""
    key_service, key_gaps = jax.random.split(key)
    service = theta[0] + theta[1] * jax.random.uniform(key_service, (JOBS,))
    gaps = jax.random.exponential(key_gaps, (JOBS,)) / theta[2]
    return interdeparture_times(service, gaps)


def _mg1_likelihood(key, theta, x):
    """By a filter over the backlog: the time from the last job's arrival to the last departure.

    A job's arrival is drawn knowing its departure, in proportion to the joint density of both: either before the last
    departure, where its service takes the whole time between departures, or after it, where it takes the rest of it.
    """
    least, span, rate = theta
    most = least + span

    def move(key, backlog, between):
        key_which, key_place = jax.random.split(key)
        busy = -jnp.expm1(-rate * backlog) * ((between >= least) & (between <= most))
        first, last = jnp.maximum(between - most, 0.0), jnp.maximum(between - least, 0.0)
        decay = jnp.exp(-rate * (last - first))
        idle = jnp.where(last > first, jnp.exp(-rate * (backlog + first)) * (1 - decay), 0.0)
        total = busy + idle
        place = jax.random.uniform(key_place, backlog.shape)
        # Gaps from the last arrival: within the backlog, or between the ends of the idle time.
        early = -jnp.log1p(place * jnp.expm1(-rate * backlog)) / rate
        late = backlog + first - jnp.log1p(-place * (1 - decay)) / rate
        gap = jnp.where(jax.random.uniform(key_which, backlog.shape) * total < busy, early, late)
        return backlog + between - gap, jnp.log(total) - jnp.log(span)

    return particle_filter(key, jnp.zeros(QUEUE_PARTICLES), move, x, QUEUE_PARTICLES)


PREY_TIMES, PREY_SUBSTEPS, PREY_INTERVAL, PREY_ERROR, PREY_PARTICLES = 20, 10, 1.0, 0.2, 200
"""Number of records, Euler steps and time between two, error of a record's logarithm, and number of particles."""


def _populations_after(theta, populations, noise):
    """Predators and prey [..., 2] one record later: the diffusion of the four reactions, steps of noise [N, ..., 2]."""
    dt = PREY_INTERVAL / PREY_SUBSTEPS

    def step(populations, noise):
        predators, prey = populations[..., 0], populations[..., 1]
        meetings = predators * prey
        up = jnp.stack([theta[0] * meetings, theta[2] * prey], axis=-1)
        down = jnp.stack([theta[1] * predators, theta[3] * meetings], axis=-1)
        moved = populations + dt * (up - down) + jnp.sqrt(dt * (up + down)) * noise
        return jnp.clip(moved, 0.1, 1e5), None

    return lax.scan(step, populations, noise)[0]


PREY_START = jnp.array([50.0, 100.0])


def _lotka_volterra(key, theta):
    """Predators and prey in turn, counted with an error."""
    key_noise, key_error = jax.random.split(key)
    noise = jax.random.normal(key_noise, (PREY_TIMES, PREY_SUBSTEPS, 2))

    def step(populations, noise):
        populations = _populations_after(theta, populations, noise)
        return populations, populations

    _, populations = lax.scan(step, PREY_START, noise)
    error = PREY_ERROR * jax.random.normal(key_error, (PREY_TIMES, 2))
    return (populations * jnp.exp(error)).ravel()


def _lotka_volterra_likelihood(key, theta, x):
    def move(key, populations, observed):
        noise = jax.random.normal(key, (PREY_SUBSTEPS, *populations.shape))
        populations = _populations_after(theta, populations, noise)
        error = _normal_log_prob(jnp.log(observed), jnp.log(populations), PREY_ERROR)
        return populations, jnp.sum(error, axis=-1)

    start = jnp.broadcast_to(PREY_START, (PREY_PARTICLES, 2))
    return particle_filter(key, start, move, x.reshape(PREY_TIMES, 2), PREY_PARTICLES)


_RATES = ("predator birth", "predator death", "prey birth", "predation")

PROBLEMS = (
    Problem(
        "ar1", _ar1, ("memory", "deviation"), ("", "V"), (0.7, 1.0), (-0.3, 0.2), (0.98, 5.0), log=("deviation",),
        log_likelihood=_ar1_likelihood, phi_low={"memory": -0.98}, phi_high={"memory": 0.98},
    ),
    Problem(
        "ornstein_uhlenbeck", _ornstein_uhlenbeck, ("rate", "level", "noise"), ("1/s", "m", "m/s^0.5"),
        (1.0, 2.0, 0.8), (0.1, -2.0, 0.1), (10.0, 6.0, 5.0), log=("rate", "noise"),
        log_likelihood=_ornstein_uhlenbeck_likelihood,
    ),
    Problem(
        "ricker", _ricker, ("growth", "deviation", "scale"), ("", "", ""), (3.8, 0.3, 10.0), (2.0, 0.05, 2.0),
        (5.0, 1.0, 40.0), log=("deviation", "scale"), log_likelihood=_ricker_likelihood, estimated=True, kept=True,
        phi_low={"growth": 1.0}, phi_high={"growth": 6.0},
    ),
    Problem(
        "mg1", _mg1, ("least service", "span", "arrival rate"), ("min", "min", "1/min"), (1.0, 4.0, 0.2),
        (0.0, 1.0, 0.05), (5.0, 10.0, 0.5), log=("arrival rate",), log_likelihood=_mg1_likelihood, estimated=True,
        kept=True, phi_low={"least service": 0.0, "span": 0.2}, phi_high={"least service": 8.0, "span": 20.0},
    ),
    Problem(
        "lotka_volterra", _lotka_volterra, _RATES, ("1/d",) * 4, (0.01, 0.5, 1.0, 0.01),
        tuple(rate * 0.2 for rate in (0.01, 0.5, 1.0, 0.01)), tuple(rate * 5.0 for rate in (0.01, 0.5, 1.0, 0.01)),
        log=_RATES, log_likelihood=_lotka_volterra_likelihood, estimated=True, kept=True,
    ),
)  # fmt: skip
