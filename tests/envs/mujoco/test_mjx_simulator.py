"""Simulations by MJX, against MuJoCo's own."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")
pytest.importorskip("mujoco.mjx")

import jax
import jax.numpy as jnp
import small
from envs_mujoco import ARM, recorded
from small import whole_runs  # noqa: F401

import jaxlfi
from jaxlfi.envs.mujoco import config
from jaxlfi.envs.mujoco.discrepancy import Discrepancy
from jaxlfi.envs.mujoco.least_squares import best_fits
from jaxlfi.envs.mujoco.logs import Log, RecordingWarning, read
from jaxlfi.envs.mujoco.mjx_effects import Held
from jaxlfi.envs.mujoco.model_task import mujoco_task
from jaxlfi.envs.mujoco.parameters import Parameter
from jaxlfi.envs.mujoco.simulator import REFUSED, UNSTABLE, Simulator, simulator_of
from jaxlfi.registry import TASKS

FOLDER = Path(__file__).parents[3] / "examples/mujoco"

SLIDE = """
<mujoco model="slide">
  <option timestep="0.02" integrator="{integrator}"/>
  <worldbody><body name="cart"><joint name="rail" type="slide" axis="1 0 0"/><geom size="0.1" density="300"/>
    <site name="here"/></body></worldbody>
  <actuator><motor name="motor" joint="rail"/></actuator>
  <sensor><jointpos name="place" joint="rail"/><accelerometer name="felt" site="here"/></sensor>
</mujoco>
"""
TIMES = np.array([0.0, 0.05, 0.12, 0.2, 0.27, 0.41, 0.5])
"""At unequal intervals, between steps."""
PUSHES = Log(
    TIMES,
    {
        "motor": np.array([1.0, np.nan, -0.5, 0.7, 0.7, np.nan, 0.1]),
        "place": np.array([0.0, 0.1, 0.2, np.nan, 0.1, 0.3, 0.2]),
        "felt[0]": np.array([np.nan, 0.1, 0.2, np.nan, 0.1, 0.3, 0.2]),
    },
)
QUIET = {"place": 0.0, "felt[0]": 0.0}
DAMPING = Parameter("joint/rail/damping", (0.1, 2.0), (0.01, 9.0))
LATE = Parameter("control/delay", (0.0, 0.1))


def slide(parameters=(DAMPING,), log=PUSHES, noises=QUIET, integrator="implicitfast", engine="mjx", **others):
    return mujoco_task(
        SLIDE.format(integrator=integrator), list(parameters), log, noises=noises, engine=engine, **others
    )


def part(log, first, last, without=()):
    """Some rows of a recording, without some samples."""
    signals = {name: values[first:last].copy() for name, values in log.signals.items()}
    for name, rows in without:
        signals[name][rows] = np.nan
    return Log(log.times[first:last], signals, log.name)


def example(name, several, *besides, **others):
    """The task of an example, with more parameters and other recordings."""
    table = config.load(FOLDER / f"{name}.toml")
    parameters = [*config.parameters_of(table), *besides]
    return mujoco_task(
        FOLDER / f"{name}.xml", parameters, several, noises=config.numbers(table, "noise"), engine="mjx", **others
    )


def drawn(task, count=3):
    """Parameters in Theta_0 and in Phi, in natural units."""
    rng, boxes = np.random.default_rng(5), (task.support(), task.inference.feasible)
    inside = [rng.uniform(box.low, box.high, (count, task.dim)) for box in boxes]
    return np.asarray(task.space.to_natural(np.concatenate(inside)), np.float32)


def agree(task, theta, atol, *lacking):
    """Simulations without noise in those of MuJoCo, which are returned; with forces that the model lacks, if given."""
    rows, outcome = jax.jit(jax.vmap(task.simulate.clean))(theta, *lacking)
    expected, counted = simulator_of(task).clean(theta, *lacking)
    np.testing.assert_array_equal(outcome, counted)
    assert not counted.any() and np.ptp(expected, axis=0).max() > 0.3
    np.testing.assert_allclose(rows, expected, atol=atol)
    return expected


@pytest.mark.slow
def test_episodes_of_a_pendulum_that_begin_in_different_places():
    """Two recordings of different lengths, with missing samples, dry friction and an offset."""
    log = read(FOLDER / "furuta.csv")
    several = [part(log, 0, 60, [("arm angle", slice(3, 50, 2))]), part(log, 100, 140)]
    start = Parameter("initial/pendulum/qpos", (-1.0, 1.0), (-3.0, 3.0))
    task = example("furuta", several, start, Parameter("sensor/pendulum angle/bias", (-0.2, 0.2)))
    assert task.observation.shape == (100, 2)
    agree(task, drawn(task), atol=2e-4)  # a thousand steps in single precision
    trajectory, _ = jax.jit(task.simulate)(jax.random.key(0), drawn(task)[0])
    np.testing.assert_array_equal(trajectory == 0, ~simulator_of(task).there)


@pytest.mark.slow
def test_an_arm_whose_controls_are_late_and_forces_that_its_model_lacks():
    """Delays are fractions of steps, with two motors; springs, dampers and dry friction agree with MuJoCo's."""
    log = part(read(FOLDER / "arm.csv"), 0, 80)
    task = example("arm", log, Parameter("initial/elbow/qvel", (-1.0, 1.0)), unmodelled_force=0.1)
    native, theta = simulator_of(task), drawn(task)
    delay = task.names.index("control/delay")
    assert 0.1 < np.min(theta[:, delay] % 0.002) / 0.002 or np.ptp(theta[:, delay]) > 0.05
    numbers = native.forces.draws(np.random.default_rng(1), len(theta)).astype(np.float32)
    both = np.tile(theta, (2, 1)), np.concatenate([np.zeros_like(numbers), numbers])
    rows, outcome = jax.jit(jax.vmap(task.simulate.clean))(*both)
    expected, counted = native.clean(*both)
    assert not counted.any() and not np.asarray(outcome).any()
    np.testing.assert_allclose(rows, expected, atol=1e-3)  # at the corners of Phi it whirls
    without, lacking = np.split(expected, 2)
    np.testing.assert_array_equal(without, native.clean(theta)[0])
    assert np.ptp(without, axis=0).max() > 0.3 and np.abs(lacking - without).max() > 0.01


def test_forces_that_a_model_lacks_are_drawn_for_each_simulation(monkeypatch):
    """There are as many as requested, and these are the ones simulated; no step is needed here."""
    task = example("arm", part(read(FOLDER / "arm.csv"), 0, 40), unmodelled_force=0.1)
    native, shape = simulator_of(task), task.observation.shape
    clean = lambda self, theta, lacking, begun: (jnp.resize(lacking, shape), 0)
    monkeypatch.setattr(type(task.simulate), "clean", clean)
    monkeypatch.setattr(native, "noise", np.zeros_like(native.noise))
    many = jax.jit(jax.vmap(task.simulate, in_axes=(0, None)))
    rows, _ = many(jax.random.split(jax.random.key(0), 4000), drawn(task)[0])
    deviations = np.resize(native.forces.deviations, shape)
    assert native.there.all() and (deviations > 0).any()
    np.testing.assert_allclose(rows.std(axis=0), deviations, rtol=5 / np.sqrt(2 * 4000))


@pytest.mark.slow
def test_sensors_are_those_of_the_state_before_a_step():
    """Accelerations among them, of a model without constraints, and between steps; Runge-Kutta looks ahead."""
    task = slide([DAMPING, LATE], integrator="RK4")
    agree(task, np.array([[0.1, 0.0], [2.0, 0.033], [8.0, 0.06]], np.float32), atol=1e-4)


@pytest.mark.slow
def test_sensors_that_are_late_and_have_gains():
    """One alone, and beside controls that are late, too; without and with forces that the model lacks."""
    delay, gain = Parameter("sensor/place/delay", (0.0, 0.2)), Parameter("sensor/felt[0]/gain", (0.5, 3.0))
    task = slide([DAMPING, LATE, delay, gain], unmodelled_force=1.0)
    theta = np.array([[0.1, 0.0, 0.033, 1.5], [2.0, 0.05, 0.12, 2.0], [8.0, 0.0, 0.0, 1.0]], np.float32)
    numbers = simulator_of(task).forces.draws(np.random.default_rng(1), len(theta)).astype(np.float32)
    both = np.tile(theta, (2, 1)), np.concatenate([np.zeros_like(numbers), numbers])
    without, lacking = np.split(agree(task, both[0], 2e-4, both[1]), 2)
    np.testing.assert_array_equal(without, simulator_of(task).clean(theta)[0])
    assert (np.abs(lacking - without).max(axis=(1, 2)) > 0.03).all()


@pytest.mark.slow
def test_windows_begin_in_starts_of_their_own():
    """The recording begins in motion, controls are late, and initial states are drawn."""
    times = 0.02 * np.arange(100)
    place = 0.3 + 0.9 * np.sin(2 * times) + 0.01 * np.random.default_rng(0).standard_normal(100)
    log = Log(times, {"motor": np.cos(3 * times), "place": place})
    with pytest.warns(RecordingWarning, match="cut into 2 windows of 0.6 s"):
        task = slide([DAMPING, LATE], log, {"place": 0.01}, windows=2, window=0.6)
    agree(task, np.array([[0.1, 0.0], [2.0, 0.033], [8.0, 0.06]], np.float32), atol=1e-4)
    (start, other), theta = simulator_of(task).starts, np.array([0.1, 0.0], np.float32)
    rows, _ = jax.jit(jax.vmap(task.simulate, in_axes=(0, None)))(jax.random.split(jax.random.key(1), 2000), theta)
    for row, own in ((0, start), (len(task.observation) // 2, other)):
        assert np.std(rows[:, row, 0]) == pytest.approx(np.hypot(0.01, own.root[0, 0, 0]), rel=5 / np.sqrt(2 * 2000))


@pytest.fixture(scope="module")
def noisy():
    """A task of two episodes with noise that is given and inferred, and an error of the model; and many simulations."""
    felt = Parameter("sensor/felt[0]/noise", (0.1, 1.0))
    task = slide(
        [DAMPING, LATE, felt], [PUSHES, PUSHES], {"place": 0.3}, discrepancies={"place": Discrepancy(0.5, 0.2)}
    )
    return task, jax.jit(jax.vmap(task.simulate))


COUNT = 4000


@pytest.mark.slow
def test_noise_and_what_the_model_gets_wrong(noisy):
    """Standard deviations, and an error that persists within an episode."""
    task, many = noisy
    theta = np.array([1.0, 0.05, 0.7], np.float32)
    rows, outcome = many(jax.random.split(jax.random.key(0), COUNT), np.tile(theta, (COUNT, 1)))
    native, rows = simulator_of(task), np.asarray(rows)
    assert not np.asarray(outcome).any() and (rows[:, ~native.there] == 0).all()
    error = rows - np.where(native.there, native.clean(theta[None])[0], 0.0)
    place, felt = native.there.T
    deviations = np.stack([np.where(place, np.hypot(0.3, 0.5), 0.0), np.where(felt, 0.7, 0.0)], axis=1)
    np.testing.assert_allclose(error.mean(axis=0), np.zeros_like(deviations), atol=5 * 0.7 / np.sqrt(COUNT))
    np.testing.assert_allclose(error.std(axis=0), deviations, rtol=5 / np.sqrt(2 * COUNT), atol=1e-6)
    times, episode = np.concatenate(native.times), np.repeat([0, 1], [len(times) for times in native.times])
    same = episode[:, None] == episode
    shares = np.where(same, 0.25 * np.exp(-np.abs(times[:, None] - times) / 0.2) / 0.34, 0.0)
    np.fill_diagonal(shares, 1.0)
    np.testing.assert_allclose(np.corrcoef(error[:, place, 0].T), shares[np.ix_(place, place)], atol=5 / np.sqrt(COUNT))


@pytest.mark.slow
def test_one_simulation_is_as_in_a_batch(noisy):
    task, many = noisy
    keys, theta = jax.random.split(jax.random.key(1), COUNT), np.tile([[0.1, 0.0, 0.2]], (COUNT, 1)).astype(np.float32)
    theta[:3] = [[0.1, 0.0, 0.2], [1.0, 0.02, 0.5], [7.0, 0.06, 1.0]]
    one = jax.jit(task.simulate)
    with jax.debug_key_reuse(False):
        several, outcomes = many(keys, theta)
        loop = [one(key, row) for key, row in zip(keys[:3], theta[:3], strict=True)]
    assert one._cache_size() == many._cache_size() == 1
    np.testing.assert_allclose(several[:3], np.stack([rows for rows, _ in loop]), atol=1e-4)
    np.testing.assert_array_equal(outcomes[:3], [outcome for _, outcome in loop])


@pytest.fixture(scope="module")
def explosive():
    """A task whose simulations fail where the stiffness is negative, and whose model where the mass is."""
    parameters = [Parameter("joint/elbow/stiffness", (0.0, 1e-3)), Parameter("body/fore/mass", (0.1, 1.0))]
    noise = {"angle": 0.01, **{f"velocity[{i}]": 0.0 for i in range(3)}}
    return mujoco_task(ARM.replace("implicitfast", "Euler"), parameters, recorded(), noises=noise, engine="mjx")


THETA = np.array([[0.0, 0.3], [-1e9, 0.3], [0.0, -1.0], [0.0, 0.5]], np.float32)


@pytest.mark.slow
def test_what_explodes_or_is_refused_is_counted_and_the_others_go_on(explosive):
    many = jax.jit(jax.vmap(explosive.simulate))
    rows, outcome = many(jax.random.split(jax.random.key(0), 4), THETA)
    assert outcome.tolist() == [0, UNSTABLE, REFUSED, 0]
    assert explosive.failures[UNSTABLE - 1 : REFUSED] == ("unstable", "refused by MuJoCo")
    assert np.isfinite(rows).all() and np.abs(rows[1:3]).max() < 0.1 < np.abs(rows[::3]).max(axis=(1, 2)).min()
    expected, _ = simulator_of(explosive).clean(THETA)
    np.testing.assert_allclose(rows[::3, :, 1:], expected[::3, :, 1:], atol=2e-3)
    again, _ = many(jax.random.split(jax.random.key(1), 4), THETA[::-1])
    assert many._cache_size() == 1
    np.testing.assert_allclose(again[3, :, 1:], rows[0, :, 1:], atol=1e-6)


def test_a_held_control_is_that_of_the_recording():
    """With several samples within a step, none for long, and one only."""
    rng = np.random.default_rng(1)
    times = np.cumsum(rng.choice([0.001, 0.003, 0.2], 300)) + 0.05
    values = np.where(rng.random(300) < 0.2, np.nan, rng.normal(size=300))
    log = Log(np.append(0.0, times), {"motor": np.append(np.nan, values), "once": np.append(np.full(300, np.nan), 2.5)})
    when = np.append(0.004 * np.arange(-5, 2000), log.times)
    for name in log.signals:
        held = jax.jit(Held(log, name, 0.004))(when.astype(np.float32))
        # A time of 8 s is exact to half a microsecond, in steps of 4 ms.
        np.testing.assert_allclose(held, log.mean_held(name, when, 0.004), atol=2e-3)


def test_what_is_beside_a_run_is_by_mujoco():
    """Points of least squares, as of the same task without MJX."""
    own, native = slide(), slide(engine="native")
    assert isinstance(simulator_of(own), Simulator)
    one, other = (best_fits(task, np.array([[1.0]]), keep=1)[0] for task in (own, native))
    np.testing.assert_array_equal(one.theta, other.theta)
    for field in dataclasses.fields(own):
        if field.name not in ("simulate", "summary"):
            assert str(getattr(own, field.name)) == str(getattr(native, field.name))


@pytest.mark.slow
def test_a_whole_run():
    task = slide(noises={"place": 0.01, "felt[0]": 0.1})
    run = jaxlfi.infer(jax.random.key(0), task, settings=small.SETTINGS, polish=False)
    assert np.isfinite(run.draws(10)).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"integrator": "implicit"}, "model: MJX cannot simulate it"),
        ({"parameters": [Parameter("site/here/size[0]", (0.1, 0.2))]}, "got one that changes site_size"),
        ({"parameters": [Parameter("option/timestep", (0.01, 0.02))]}, "other than the model's time step"),
    ],
)
def test_what_mjx_cannot_simulate_is_refused(changes, message):
    with pytest.raises(ValueError, match="engine: expected native for what MJX cannot simulate, got mjx: ") as refusal:
        slide(**changes)
    assert message in str(refusal.value) and "\n" not in str(refusal.value)
    slide(**changes, engine="native")


def test_engines_are_chosen_by_name(tmp_path, capsys):
    with pytest.raises(ValueError, match="engine: expected one of native, mjx, got 'warp'"):
        slide(engine="warp")
    (tmp_path / "slide.xml").write_text(SLIDE.format(integrator="Euler"))
    (tmp_path / "slide.csv").write_text("time [s],motor,place [m]\n0,0,0.5\n1,0,0.25\n")
    (tmp_path / "slide.toml").write_text(
        'model = "slide.xml"\nlog = ["slide.csv"]\nnoise = { place = 0.1 }\n'
        '[parameters."joint/rail/damping"]\nsupport = [0.1, 2.0]\n'
    )
    reference = f"mujoco,config={tmp_path / 'slide.toml'}"
    assert not TASKS.load(f"{reference},engine=mjx").on_host
    assert TASKS.load(reference).on_host and TASKS.load(f"{reference},engine=native").on_host
    assert small.command("tasks", f"{reference},engine=mjx") == 0
    assert "joint/rail/damping" in capsys.readouterr().out
    assert small.command("infer", f"{reference},engine=warp", "--out", tmp_path / "run") == 2
    assert "engine" in capsys.readouterr().err and not (tmp_path / "run").exists()
    (tmp_path / "slide.xml").write_text(SLIDE.format(integrator="implicit"))
    assert small.command("infer", f"{reference},engine=mjx", "--out", tmp_path / "run") == 2
    assert "engine: expected native for what MJX cannot simulate" in capsys.readouterr().err.replace("\n", " ")
    assert not (tmp_path / "run").exists()
