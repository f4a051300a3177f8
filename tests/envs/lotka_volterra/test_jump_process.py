"""The Lotka-Volterra jump process against NumPy, closed forms, published numbers, its laws."""

import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxlfi.envs.lotka_volterra import counter_rng
from jaxlfi.envs.lotka_volterra import jump_process as lv
from tests.oracles import gillespie

GOLDEN = pathlib.Path(__file__).parents[2] / "golden" / "gillespie.npz"
TRUTH = np.log([0.01, 0.5, 1.0, 0.01]).astype(np.float32)
GOLDEN_RATES = {"truth": (0.01, 0.5, 1.0, 0.01), "asymmetric": (0.004, 0.25, 0.4, 0.009)}
GOLDEN_RECORDS = [1, 30, 150]
NEVER = -40.0  # a log-rate at which nothing happens

# Papamakarios and Murray's files: the observed summaries, and mean and standard deviation of the
# summaries of a thousand successful simulations from the prior U[-5, 2]^4 of log-rates.
OBSERVED = [
    95.225166,
    51.966887,
    8.673646,
    8.051496,
    0.980002,
    0.934988,
    0.977287,
    0.926922,
    0.022936,
]
PILOT_MEAN = [
    219.801775,
    5.830815,
    6.636609,
    4.4447,
    0.840878,
    0.737992,
    0.135018,
    0.074747,
    0.124836,
]
PILOT_STD = [
    592.326107,
    54.664998,
    2.969361,
    0.901873,
    0.179812,
    0.256786,
    0.266209,
    0.202996,
    0.375752,
]
PILOT_SIZE = 1000

simulate = lv.make_simulator()
simulate_many = jax.jit(jax.vmap(simulate))
# Thousands of simulations take longer than their program's compilation.
simulate_thousands = jax.jit(jax.vmap(simulate), compiler_options={"xla_backend_optimization_level": 3})
THOUSANDS = 4096
"""Simulations in a batch of `simulate_thousands`."""
summarise = jax.jit(lv.lotka_volterra_nine)
summarise_many = jax.jit(jax.vmap(lv.lotka_volterra_nine))


def draw(seed, log_rates, count, run=simulate_many):
    """Trajectories and failures of `count` simulations at one setting."""
    keys = jax.random.split(jax.random.key(seed), count)
    trajectory, failure = run(keys, np.broadcast_to(np.float32(log_rates), (count, 4)))
    return np.asarray(trajectory), np.asarray(failure)


def batched(process):
    return jax.jit(jax.vmap(lv.make_simulator(process)))


def succeeded(trajectory, failure):
    """States [N, 151, 2] and summaries [N, 9] of the simulations that succeeded."""
    kept = failure == lv.SUCCESS
    return trajectory[kept], np.asarray(summarise_many(trajectory))[kept]


@pytest.fixture(scope="module")
def at_truth():
    return draw(1, TRUTH, THOUSANDS, simulate_thousands)


def prior_arguments():
    """Keys [600] and log-rates from the prior: extinct, failed and ordinary simulations.

    Keys are made anew at each call, as tests that repeat a simulation on purpose would trip the
    key-reuse checker.
    """
    keys = jax.random.split(jax.random.key(2), 600)
    log_rates = jax.random.uniform(jax.random.key(3), (600, 4), minval=-5, maxval=2)
    return keys, log_rates


@pytest.fixture(scope="module")
def prior_batch():
    """Trajectories and failures of `prior_arguments()`."""
    return jax.device_get(simulate_many(*prior_arguments()))


class TestDistribution:
    @pytest.mark.parametrize("name", GOLDEN_RATES)
    def test_agrees_with_numpy_oracle(self, name):
        expected = np.load(GOLDEN)[name]
        log_rates = np.log(np.float32(GOLDEN_RATES[name]))
        trajectory, summaries = succeeded(*draw(4, log_rates, THOUSANDS, simulate_thousands))
        states = trajectory[:, GOLDEN_RECORDS].reshape(len(trajectory), -1)
        ours = np.concatenate([summaries, states], axis=1)
        pvalues = [stats.ks_2samp(*columns).pvalue for columns in zip(ours.T, expected.T, strict=True)]
        assert min(pvalues) > 1e-3 / len(pvalues), pvalues

    def test_pure_prey_birth_is_a_yule_process(self):
        rate, initial, count = 0.7, 20, 8192
        process = lv.JumpProcess(predators=0, prey=initial, duration=2.0, interval=0.5, record="before")
        trajectory, failure = draw(5, [NEVER, NEVER, np.log(rate), NEVER], count, batched(process))
        assert not failure.any() and not trajectory[..., 0].any()
        growth = np.exp(rate * 0.5 * np.arange(1, 5))
        prey = trajectory[:, 1:, 1]
        variance = initial * growth * (growth - 1)
        assert np.all(np.abs(prey.mean(0) - initial * growth) < 4 * np.sqrt(variance / count))
        # Near to normal, so that the relative standard error of the variance is sqrt(2 / n).
        assert np.all(np.abs(prey.var(0) / variance - 1) < 5 * np.sqrt(2 / count))
        # One prey's offspring is geometric, a sum of them negative binomial.
        expected = stats.nbinom(initial, 1 / growth[-1])
        edges = expected.ppf(np.linspace(0.05, 0.95, 19))
        counts = np.histogram(prey[:, -1] - initial, [-np.inf, *(edges + 0.5), np.inf])[0]
        probabilities = np.diff([0, *expected.cdf(edges), 1])
        assert stats.chisquare(counts, count * probabilities).pvalue > 1e-3

    @pytest.mark.parametrize("species", [0, 1])
    def test_pure_death_is_binomial_survival(self, species):
        """Predators die spontaneously (r2), prey by predation at r4 X with X = 5 predators."""
        rate, initial, count = 0.6, 40, 8192
        populations = (initial, 0) if species == 0 else (5, initial)
        log_rates = [NEVER] * 4
        log_rates[1 if species == 0 else 3] = np.log(rate if species == 0 else rate / 5)
        process = lv.JumpProcess(*populations, duration=2.0, interval=0.5, record="before")
        trajectory, _ = draw(6 + species, log_rates, count, batched(process))
        for i in range(1, 5):
            survivors = trajectory[:, i, species].astype(int)
            expected = stats.binom(initial, np.exp(-rate * 0.5 * i))
            low, high = expected.ppf(0.02), expected.ppf(0.98)
            counts = np.bincount(np.clip(survivors, low, high).astype(int) - int(low))
            cdf = expected.cdf(np.arange(low, high))
            probabilities = np.diff([0, *cdf, 1])
            assert stats.chisquare(counts, count * probabilities).pvalue > 1e-3, i
        assert (trajectory[..., 1 - species] == populations[1 - species]).all()

    @pytest.mark.slow
    def test_waiting_time_is_independent_of_the_reaction(self):
        """One predator, one prey: who dies first is a fair coin, whenever it is."""
        count, rate, interval = 8192, 0.5, 0.02
        process = lv.JumpProcess(1, 1, duration=20.0, interval=interval, record="before")
        log_rates = [-np.inf, np.log(rate), -np.inf, np.log(rate)]
        trajectory, _ = draw(24, log_rates, count, batched(process))
        wait = interval * (trajectory.sum(-1) == 2).sum(-1)
        predator_first = trajectory[:, -1, 1] == 1  # a lone prey stays, a lone predator dies on
        assert abs(predator_first.mean() - 0.5) < 4 * 0.5 / np.sqrt(count)
        error = 1 / (2 * rate) / np.sqrt(count)
        assert abs(wait.mean() - interval / 2 - 1 / (2 * rate)) < 4 * error
        assert abs(wait[predator_first].mean() - wait[~predator_first].mean()) < 4 * 2 * error

    def test_predator_birth_is_a_yule_process_at_constant_prey(self):
        rate, initial, prey, count = 0.7, 20, 10, 4096
        process = lv.JumpProcess(initial, prey, duration=2.0, interval=2.0, record="before")
        trajectory, _ = draw(8, [np.log(rate / prey), NEVER, NEVER, NEVER], count, batched(process))
        growth = np.exp(rate * 2)
        error = np.sqrt(initial * growth * (growth - 1) / count)
        assert abs(trajectory[:, -1, 0].mean() - initial * growth) < 4 * error

    def test_published_observation_is_a_plausible_draw(self, at_truth):
        _, summaries = succeeded(*at_truth)
        low, high = np.quantile(summaries, [0.001, 0.999], axis=0)
        assert np.all((low < OBSERVED) & (OBSERVED < high))

    def test_published_pilot_moments(self):
        batches = 6
        keys = jax.random.split(jax.random.key(9), (batches, THOUSANDS))
        log_rates = jax.random.uniform(jax.random.key(10), (batches, THOUSANDS, 4), minval=-5, maxval=2)
        runs = [jax.device_get(simulate_thousands(*batch)) for batch in zip(keys, log_rates, strict=True)]
        summaries = np.concatenate([succeeded(*run)[1] for run in runs])[:20_000]
        assert len(summaries) == 20_000
        error = np.array(PILOT_STD) / np.sqrt(PILOT_SIZE)
        assert np.all(np.abs(summaries.mean(0) - PILOT_MEAN) < 4 * error)
        bounded = slice(4, 9)  # correlations: their standard deviation has a small error of its own
        assert np.allclose(summaries.std(0, ddof=1)[bounded], np.array(PILOT_STD)[bounded], rtol=0.12)


class TestRecords:
    def test_shape_start_and_types(self, at_truth):
        trajectory, failure = at_truth
        assert trajectory.shape == (THOUSANDS, 151, 2) and trajectory.dtype == np.float32
        assert failure.dtype == np.int32
        assert (trajectory[:, 0] == [50, 100]).all()
        assert (trajectory >= 0).all() and (trajectory == np.round(trajectory)).all()

    def test_after_is_one_event_past_before(self, prior_batch):
        after, failure = prior_batch
        before, failure_before = batched(lv.JumpProcess(record="before"))(*prior_arguments())
        assert (failure == failure_before).all()
        kept = np.asarray(failure) == lv.SUCCESS
        after, before = np.asarray(after)[kept], np.asarray(before)[kept]
        steps = np.abs(after - before).sum(-1)
        assert (before[:, 0] == [50, 100]).all() and not steps[:, 0].any()
        assert set(np.unique(steps)) == {0, 1}
        # Only a frozen state has no next event, and X = Y = 0 is the only frozen state here.
        assert not after[:, 1:][steps[:, 1:] == 0].any()

    def test_after_in_pure_death_has_one_less(self):
        log_rates = [NEVER, np.log(0.3), NEVER, NEVER]
        results = [
            draw(11, log_rates, 64, batched(lv.JumpProcess(predators=30, prey=0, record=record)))[0]
            for record in ("before", "after")
        ]
        assert (results[1][:, 1:, 0] == np.maximum(results[0][:, 1:, 0] - 1, 0)).all()

    def test_extinction_freezes_and_succeeds(self):
        trajectory, failure = draw(12, [-np.inf, 2.0, -np.inf, -1.0], 256)
        assert not failure.any()
        assert (trajectory[:, -1, 0] == 0).all()
        assert (np.diff(trajectory, axis=1) <= 0).all()

    def test_zero_total_rate_keeps_the_initial_state(self):
        trajectory, failure = draw(13, [-np.inf] * 4, 256)
        assert not failure.any() and (trajectory == [50, 100]).all()

    def test_more_than_max_events_fails_with_finite_content(self):
        trajectory, failure = draw(14, [2.0, NEVER, 2.0, NEVER], 256)
        assert (failure == lv.TOO_MANY_EVENTS).all()
        assert np.isfinite(trajectory).all()
        assert (trajectory[:, -1].sum(-1) == 150 + 10_000).all()  # births only: the last state counts events

    @pytest.mark.parametrize("limit", [127, 128, 129])
    def test_event_limit_is_exact(self, limit):
        """A simulation with as many deaths as the limit succeeds; with one more, if a prey dies first, it fails."""
        process = lv.JumpProcess(predators=limit, prey=1, max_events=limit)
        log_rates = jnp.array([[-np.inf, 3.0, -np.inf, -np.inf], [-np.inf, 1.0, -np.inf, 20.0]])
        keys = jax.random.split(jax.random.key(15), 2)
        trajectory, failure = batched(process)(keys, log_rates)
        assert failure.tolist() == [lv.SUCCESS, lv.TOO_MANY_EVENTS]
        assert trajectory[:, -1].tolist() == [[0, 1], [1, 0]]

    def test_step_count_matches_yule_growth(self):
        process = lv.JumpProcess(predators=0, prey=20, duration=2.0, interval=0.5)
        keys = jax.random.split(jax.random.key(16), 300)
        log_rates = jnp.broadcast_to(jnp.array([NEVER, NEVER, -0.3, NEVER]), (300, 4))
        result = jax.jit(lv.make_batch_simulator(process))(keys, log_rates)
        assert (result.trajectory[:, -1, 1] - 20 == result.steps).all()

    def test_nan_rate_fails_alone(self):
        log_rates = np.zeros((256, 4), np.float32)
        log_rates[:, 2], log_rates[7, 1] = NEVER, np.nan
        keys = jax.random.split(jax.random.key(17), 256)
        trajectory, failure = simulate_many(keys, log_rates)
        assert np.flatnonzero(failure).tolist() == [7] and failure[7] == lv.TOO_MANY_EVENTS
        assert np.isfinite(trajectory).all()

    def test_other_grid(self):
        process = lv.JumpProcess(duration=0.7, interval=0.1)
        trajectory, failure = draw(18, TRUTH, 3, batched(process))
        assert trajectory.shape == (3, 8, 2) and not failure.any()

    @pytest.mark.parametrize(
        ("argument", "value"),
        [
            ("predators", -1),
            ("prey", -1),
            ("interval", 0.0),
            ("max_events", 0),
            ("max_events", 70_000),
            ("record", "during"),
        ],
    )
    def test_bad_setting_is_named(self, argument, value):
        with pytest.raises(ValueError, match=argument):
            lv.JumpProcess(**{argument: value})

    def test_bad_shape_is_named(self):
        with pytest.raises(ValueError, match="log_rates"):
            simulate(jax.random.key(0), jnp.zeros(3))


class TestBatching:
    """The result of a simulation depends on its own key and rates only, bit for bit."""

    @pytest.mark.parametrize("single", [simulate, jax.jit(simulate)], ids=["eager", "jit"])
    def test_vmap_equals_loop(self, prior_batch, single):
        trajectory, failure = prior_batch
        keys, log_rates = prior_arguments()
        for i in range(0, 600, 40):
            alone, code = single(keys[i], log_rates[i])
            assert (alone == trajectory[i]).all() and code == failure[i]

    def test_order_and_company_do_not_matter(self, prior_batch):
        keys, log_rates = prior_arguments()
        order = jax.random.permutation(jax.random.key(19), 600)
        shuffled, _ = simulate_many(keys[order], log_rates[order])
        assert (shuffled == prior_batch[0][order]).all()

    def test_nested_vmap(self, prior_batch):
        trajectory, failure = prior_batch
        keys, log_rates = prior_arguments()
        nested = jax.jit(jax.vmap(jax.vmap(simulate)))
        grid, codes = nested(keys.reshape(20, 30), log_rates.reshape(20, 30, 4))
        assert (grid.reshape(600, 151, 2) == trajectory).all()
        assert (codes.ravel() == failure).all()

    def test_other_axes(self, prior_batch):
        keys, log_rates = prior_arguments()
        mapped = jax.vmap(simulate, in_axes=(0, 1), out_axes=(1, 0))
        trajectory, _ = mapped(keys[:12], log_rates[:12].T)
        assert (trajectory.swapaxes(0, 1) == prior_batch[0][:12]).all()

    def test_unbatched_key(self, prior_batch):
        keys, log_rates = prior_arguments()
        trajectory, _ = jax.vmap(simulate, in_axes=(None, 0))(keys[4], log_rates[:12])
        assert (trajectory[4] == prior_batch[0][4]).all()

    def test_product_of_keys_and_rates(self, prior_batch):
        keys, log_rates = prior_arguments()
        product = jax.vmap(jax.vmap(simulate, (None, 0)), (0, None))
        trajectory, _ = product(keys[:3], log_rates[:4])
        assert trajectory.shape == (3, 4, 151, 2)
        assert (trajectory[2, 2] == prior_batch[0][2]).all()

    @pytest.mark.slow
    def test_scan_inside_vmap(self, prior_batch):
        keys, log_rates = prior_arguments()

        def scanned(*arguments):
            return jax.lax.scan(lambda _, now: (None, simulate(*now)[0]), None, arguments)[1]

        run = jax.jit(jax.vmap(scanned))
        # A false alarm of the checker: any use of the keys a scan under vmap runs over trips it.
        with jax.debug_key_reuse(False):
            across = run(keys.reshape(30, 20), log_rates.reshape(30, 20, 4))
        assert (across.reshape(600, 151, 2) == prior_batch[0]).all()

    def test_inside_shard_map(self, prior_batch):
        automatic = (jax.sharding.AxisType.Auto,)
        mesh = jax.make_mesh((jax.device_count(),), ("device",), axis_types=automatic)
        split = jax.sharding.PartitionSpec("device")
        run = jax.shard_map(jax.vmap(simulate), mesh=mesh, in_specs=split, out_specs=split)
        assert (jax.jit(run)(*prior_arguments())[0] == prior_batch[0]).all()

    def test_schedule_does_not_matter(self, prior_batch):
        schedule = lv.Schedule(slots=48, records=100)
        run = jax.jit(jax.vmap(lv.make_simulator(schedule=schedule)))
        assert (run(*prior_arguments())[0] == prior_batch[0]).all()

    def test_no_recompilation(self):
        traces = []

        def counted(key, log_rates):
            traces.append(None)
            return simulate(key, log_rates)

        run = jax.jit(jax.vmap(counted))
        for seed in range(3):
            draw(seed, TRUTH, 5, run)
        assert len(traces) == 1

    def test_key_is_consumed_and_matters(self):
        key = jax.random.key(20)
        simulate(key, TRUTH)
        with jax.debug_key_reuse(True), pytest.raises(jax.errors.KeyReuseError):
            simulate(key, TRUTH)
        trajectories, _ = draw(21, TRUTH, 256)
        assert len(np.unique(trajectories.reshape(256, -1), axis=0)) == 256


class TestSummaries:
    def test_equal_float64_numpy(self, prior_batch):
        trajectory = np.asarray(prior_batch[0])
        ours = np.asarray(summarise_many(trajectory))
        theirs = np.stack([gillespie.nine_summaries(t) for t in trajectory])
        np.testing.assert_allclose(ours, np.nan_to_num(theirs), rtol=2e-5, atol=2e-5)

    def test_small_spread_on_a_large_level(self):
        series = np.stack([10_000 + np.arange(151) % 2, 9_000 + np.arange(151) % 3], axis=1)
        ours = summarise(series.astype(np.float32))
        np.testing.assert_allclose(ours, gillespie.nine_summaries(series), rtol=1e-4, atol=2e-5)

    def test_one_spike_is_no_constant(self):
        series = np.full((151, 2), 7.0)
        series[0] = [50, 100]
        ours = summarise(series.astype(np.float32))
        np.testing.assert_allclose(ours, gillespie.nine_summaries(series), rtol=2e-5, atol=2e-5)

    @pytest.mark.parametrize("constant", [(0,), (1,), (0, 1)])
    def test_constant_series_has_no_correlation(self, constant):
        series = np.stack([np.arange(151) % 5, np.arange(151) % 7], axis=1).astype(np.float32)
        series[:, constant] = 3.3
        ours = np.asarray(summarise(series))
        undefined = {0: [2, 4, 5, 8], 1: [3, 6, 7, 8]}
        for species in constant:
            assert (ours[undefined[species]] == 0).all()
        assert np.isfinite(ours).all()


@pytest.fixture(scope="module")
def seeds():
    return jax.vmap(counter_rng.seed_from_key)(jax.random.split(jax.random.key(22), 256))


@pytest.fixture(scope="module")
def words(seeds):
    """[256 streams, 8192 counters]."""
    counters = jnp.arange(8192, dtype=jnp.uint32)
    streams = jax.tree.map(lambda leaf: leaf[:, None], seeds)
    return np.asarray(counter_rng.random_word(streams, counters))


@pytest.fixture(scope="module")
def hard_words():
    """Streams of seeds next to each other in the low, then the high word, [2, 256, 8192]."""
    near = jnp.arange(256, dtype=jnp.uint32)[:, None]
    counters = jnp.arange(8192, dtype=jnp.uint32)
    pairs = [(near, jnp.uint32(0)), (jnp.uint32(0), near)]
    return np.stack([counter_rng.random_word(counter_rng.Seed(*p), counters) for p in pairs])


class TestCounterRng:
    """Statistical tests of streams as the simulator uses them: streams of consecutive counters."""

    def test_uniform_and_exponential_laws(self, words):
        uniforms = np.asarray(counter_rng.uniform(words)).ravel()
        exponentials = np.asarray(counter_rng.exponential(words)).ravel()
        assert stats.kstest(uniforms, "uniform").pvalue > 1e-3
        assert stats.kstest(exponentials, "expon").pvalue > 1e-3
        tail = (exponentials > 10).sum()
        assert stats.poisson(exponentials.size * np.exp(-10)).cdf(tail) == pytest.approx(0.5, abs=0.499)

    def test_ends_of_the_range(self):
        ends = jnp.array([0, 1, 2**32 - 1], jnp.uint32)
        uniforms, exponentials = counter_rng.uniform(ends), counter_rng.exponential(ends)
        assert uniforms[0] == 0 and uniforms[-1] == 1 - 2**-24
        assert (exponentials >= 0).all() and exponentials[-1] == 0
        assert exponentials[0] == pytest.approx(32 * np.log(2))

    @pytest.mark.parametrize("lag", [1, 2, 3, 64, 128])
    def test_no_serial_correlation(self, words, hard_words, lag):
        for block in (words, *hard_words):
            uniforms = block / 2.0**32 - 0.5
            product = (uniforms[:, :-lag] * uniforms[:, lag:]).mean()
            assert abs(product) < 4 / 12 / np.sqrt(block.size)

    @pytest.mark.parametrize("lag", [1, 2, 16])
    def test_neighbouring_streams_are_independent(self, words, hard_words, lag):
        for block in (words, *hard_words):
            uniforms = block / 2.0**32 - 0.5
            product = (uniforms[:-lag] * uniforms[lag:]).mean()
            assert abs(product) < 4 / 12 / np.sqrt(block.size)
            equal_bits = np.bitwise_count(block[:-lag] ^ block[lag:])
            assert abs(equal_bits.mean() - 16) < 4 * np.sqrt(8 / equal_bits.size)

    @pytest.mark.parametrize("shift", [0, 8, 16, 24])
    def test_chi_square_of_bytes_and_of_consecutive_pairs(self, words, hard_words, shift):
        for block in (words, *hard_words):
            byte = (block >> shift) & 255
            assert stats.chisquare(np.bincount(byte.ravel(), minlength=256)).pvalue > 1e-4
            pairs = (byte[:, ::2] * 256 + byte[:, 1::2]).ravel()
            assert stats.chisquare(np.bincount(pairs, minlength=65536)).pvalue > 1e-4
            across = (byte[::2] * 256 + byte[1::2]).ravel()
            assert stats.chisquare(np.bincount(across, minlength=65536)).pvalue > 1e-4

    def test_sums_of_streams_are_independent_draws(self, words, hard_words):
        """Means of a stream over counters, and of a counter over streams, have the right standard deviation."""
        for block in (words, *hard_words):
            uniforms = block / 2.0**32 - 0.5
            for axis in (0, 1):
                scores = uniforms.mean(axis) * np.sqrt(12 * uniforms.shape[axis])
                assert stats.kstest(scores, "norm").pvalue > 1e-3

    def test_every_input_bit_flips_every_output_bit_half_the_time(self):
        rng = np.random.default_rng(23)
        inputs = rng.integers(0, 2**32, (3, 4096), dtype=np.uint32)

        def word(values):
            seed = counter_rng.Seed(values[0], values[1])
            return np.asarray(counter_rng.random_word(seed, values[2]))

        for argument in range(3):
            for bit in range(32):
                flipped = inputs.copy()
                flipped[argument] ^= np.uint32(1 << bit)
                change = word(inputs) ^ word(flipped)
                rate = [(change >> out & 1).mean() for out in range(32)]
                assert np.abs(np.array(rate) - 0.5).max() < 0.06, (argument, bit)
