"""infer: the library call, its purity, the folder it can keep its run in, and what it refuses."""

import dataclasses
import importlib

import distrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlfi
from jaxlfi import Support
from jaxlfi.bayessim import programs
from jaxlfi.envs import gaussian_linear
from jaxlfi.heuristics import Choice, Edge, Fixed, Truncate
from jaxlfi.io import executables
from jaxlfi.io import files as atomic
from jaxlfi.io.workfolder import StoreError, as_json
from jaxlfi.runs.folder import run_config
from jaxlfi.runs.load import load
from jaxlfi.tasks.host import SimulatorError
from tests.small import FLAGS, SETTINGS, TASK, command, gaussian, read_ledger, settings, whole_runs  # noqa: F401 - a fixture

infer_module = importlib.import_module("jaxlfi.runs.infer")  # the package's name is the function's
pytestmark = pytest.mark.filterwarnings("ignore::jaxlfi.SupportWarning")

OBSERVED = np.array([0.8, -0.6], np.float32)
ARRAYS = ("posterior.npz", "dataset.npz", "history.npz", "observation.npz")
ONE = settings(rounds=1)
BOX = Support([0.5, -3.0], [3.0, 3.0])


def fails_above(key, theta):
    """The Gaussian task's simulator, which fails where the first parameter is large."""
    return gaussian_linear.simulate(key, theta), theta[0] < 2.5


OWN = dataclasses.replace(
    gaussian(), simulate=fails_above, supports={"own": BOX, "failing": Support([2.6, -3.0], [3.0, 3.0])}, feasible=BOX,
    log=("first",), observation=OBSERVED,
)  # fmt: skip
"""A task with a logarithm, failures and an observation of its own; one program serves all runs of it."""
FIXED, TRUNCATE = (Choice(index, (Fixed(), Truncate())) for index in range(2))
"""Two heuristics that never widen a support, in one program."""


def infer(seed=0, task=None, observation=OBSERVED, **arguments):
    """`jaxlfi.infer` with the small settings."""
    arguments = {"support": "misspecified", "settings": SETTINGS} | arguments
    return jaxlfi.infer(jax.random.key(seed), task or gaussian(), observation, **arguments)


def same_arrays(a, b, but=("seconds",)):
    """Equal to the last bit, but for what was measured."""
    first, second = atomic.read_arrays(a), atomic.read_arrays(b)
    assert first.keys() == second.keys()
    for name in first.keys() - set(but):
        np.testing.assert_array_equal(first[name], second[name], err_msg=f"{a} {name}")


# ----------------------------------------------------------------------------------------- one program, many calls


@pytest.fixture
def compilations():
    """Names of the programs that are compiled from here on, in whatever way."""
    seen = []
    jax.monitoring.register_event_duration_secs_listener(listener := lambda event, seconds, **_: seen.append(event))
    yield lambda: [event for event in seen if event.endswith("backend_compile_duration")]
    jax.monitoring.unregister_event_duration_listener(listener)


@pytest.mark.slow
def test_an_equal_task_made_anew_compiles_nothing(compilations):
    programs.forget()
    infer(0, gaussian_linear.task())
    before, kept = len(compilations()), dict(executables._EXECUTABLES)
    assert before > 0  # so that compilations are seen at all
    again = gaussian_linear.task()
    assert again is not gaussian()
    infer(1, again, OBSERVED + 1, heuristic=Edge(mass_threshold=0.3))
    infer(2, dataclasses.replace(again), support=Support([-2.0, -2.0], [1.0, 1.0]))
    assert len(compilations()) == before and executables._EXECUTABLES == kept
    other = dataclasses.replace(again, simulate=lambda key, theta: gaussian_linear.simulate(key, theta))
    infer(1, other)
    assert len(compilations()) > before


BATCH = {
    "key": jax.random.split(jax.random.key(0), 3),
    "heuristic": jaxlfi.stack([Edge(mass_threshold=tau) for tau in (0.005, 0.2, 0.9)]),
    "observation": OBSERVED + np.array([[0.0], [0.5], [1.0]], np.float32),
    "low": np.array([[-3.0, -3.0], [-2.0, -2.0], [-1.0, -3.0]], np.float32),
}


def one_of_batch(key, heuristic, observation, low):
    """A run of everything that can be mapped over."""
    support = Support(low, jnp.array([0.0, 3.0]))
    return jaxlfi.infer(key, gaussian(), observation, support=support, heuristic=heuristic, settings=SETTINGS)


def each_of_batch() -> list[jaxlfi.Run]:
    """The three runs, one after another."""
    return [one_of_batch(**jax.tree.map(lambda leaf, i=i: leaf[i], BATCH)) for i in range(3)]


def mapped(batch):
    """They, under `vmap`."""
    return jax.vmap(lambda batch: one_of_batch(**batch))(batch)


@pytest.mark.slow  # `bayessim/` and `studies/test_grid.py` compare batches with runs by themselves
def test_vmap_over_anything_equals_a_loop():
    together = mapped(jax.tree.map(jnp.asarray, BATCH))
    for i, alone in enumerate(each_of_batch()):
        own = jax.tree.map(lambda leaf, i=i: leaf[i], together)
        for a, b in zip(jax.tree.leaves(own.belief), jax.tree.leaves(alone.belief), strict=True):
            np.testing.assert_allclose(a, b, rtol=2e-3, atol=2e-3)
        assert own.history.keys() == alone.history.keys()
        np.testing.assert_allclose(own.history["theta"], alone.history["theta"], rtol=2e-2, atol=2e-2)
        np.testing.assert_array_equal(own.posterior.support.low, own.belief.support.low)
    assert own.warnings is not None and own.posterior.sample(jax.random.key(0), 1000).shape == (1000, 2)


def test_vmap_over_anything_gives_an_axis_of_runs():
    shapes = jax.eval_shape(mapped, jax.tree.map(jnp.asarray, BATCH))
    alone = jax.eval_shape(lambda batch: one_of_batch(**batch), jax.tree.map(lambda leaf: leaf[0], BATCH))
    added = jax.tree.map(lambda many, one: many.shape == (3, *one.shape), shapes, alone)
    assert jax.tree.structure(shapes) == jax.tree.structure(alone) and all(jax.tree.leaves(added))


def test_a_batch_is_not_saved(tmp_path):
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each_of_batch())
    with pytest.raises(ValueError, match=r"^warnings: expected one run, got a batch .*jax\.tree\.map"):
        _ = together.warnings
    with pytest.raises(ValueError, match=r"^save: expected one run, got a batch of them .*jax\.tree\.map\(") as refused:
        together.save(tmp_path / "batch")
    assert "\n" not in str(refused.value) and not (tmp_path / "batch").exists()
    one = jax.tree.map(lambda leaf: leaf[1], together)
    again = load(one.save(tmp_path / "one"), gaussian())
    assert jax.tree.structure(again.belief) == jax.tree.structure(one.belief)
    for a, b in zip(jax.tree.leaves(again.belief), jax.tree.leaves(one.belief), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(jax.random.key_data(again.key), jax.random.key_data(BATCH["key"][1]))


@pytest.mark.parametrize("argument", [{"progress": True}, {"callback": print}, {"out": "nowhere"}])
def test_what_a_traced_run_cannot_do_is_refused(argument):
    with pytest.raises(ValueError, match=r"^infer: expected concrete arguments"):
        jax.eval_shape(lambda observation: infer(observation=observation, **argument).x, OBSERVED)


def test_the_command_line_and_the_library_agree(tmp_path):
    assert command("infer", TASK, "--support", "misspecified", *FLAGS, "--out", tmp_path / "cli") == 0
    run = infer(0, observation=None)
    run.save(tmp_path / "library")
    files = [sorted(path.name for path in (tmp_path / name).iterdir()) for name in ("cli", "library")]
    assert files[0] == ["checkpoint", *files[1]]  # from which --rounds goes on
    for name in ARRAYS:  # the same program in the same process: to the last bit
        same_arrays(tmp_path / "library" / name, tmp_path / "cli" / name)
    ledgers = [read_ledger(tmp_path / name) for name in ("library", "cli")]
    assert [line["round"] for line in ledgers[0]] == [line["round"] for line in ledgers[1]] == [0, 1]
    assert ledgers[0][1]["theta_error"] == ledgers[1][1]["theta_error"]
    with pytest.raises(ValueError, match="not empty"):
        run.save(tmp_path / "library")


# ------------------------------------------------------------------------------------ progress, callbacks, folders


class Stopped(Exception):
    """Raised by a callback."""


def test_a_run_in_a_folder_goes_on_where_a_callback_stopped_it(tmp_path):
    seen, rows = [], []

    def watch(index, row):
        seen.append(index)
        rows.append(row)

    whole = infer(3, callback=watch, out=tmp_path / "whole")
    assert seen == [0, 1]
    for index, row in enumerate(rows):  # of the one run, by the names of its history
        np.testing.assert_array_equal(row["theta"], whole.history["theta"][index])
        assert row["sample_theta"].shape == (20, 2)

    def stop_at(last):
        def stop(index, row):
            left.append(index)
            if index == last:
                raise Stopped

        return stop

    for last in (0, 1):  # before the last round, and after it, before anything is written of the result
        left = []
        with pytest.raises(Stopped):
            infer(3, callback=stop_at(last), out=tmp_path / "stopped")
        assert left == [last]
        with pytest.raises(StoreError, match=r"expected a finished run; continue it with jaxlfi resume"):
            load(tmp_path / "stopped")
    left = []
    resumed = infer(3, callback=stop_at(0), out=tmp_path / "stopped")
    assert left == []
    for name in ARRAYS:
        same_arrays(tmp_path / "whole" / name, tmp_path / "stopped" / name)
    assert [line["round"] for line in read_ledger(tmp_path / "stopped")] == [0, 1]
    np.testing.assert_array_equal(resumed.draws(), whole.draws())
    assert (tmp_path / "stopped" / "checkpoint" / "state.npz").exists()  # for more rounds
    # Finished: it is read, and nothing is done again.
    done = infer(3, callback=stop_at(0), out=tmp_path / "stopped")
    np.testing.assert_array_equal(done.mixture.means, whole.mixture.means)


def test_a_callback_makes_a_round_the_last_by_stop_iteration(tmp_path):
    def enough(index, row):
        if index == 0:
            raise StopIteration

    short = infer(3, callback=enough, out=tmp_path / "short")
    assert short.history["theta"].shape[0] == 1 and int(short.dataset.size) == int(short.history["kept"].sum())
    whole = infer(3)
    np.testing.assert_allclose(short.mixture.means, whole.history["means"][0], rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(short.belief.support.high, whole.history["support_high"][0])
    np.testing.assert_array_equal(load(tmp_path / "short").draws(), short.draws())


def test_a_folder_of_another_run_is_refused(tmp_path):
    infer(0, out=tmp_path / "run")
    contents = lambda: {path: path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()}
    before = contents()
    others = {
        "seed": {"seed": 1},
        "settings": {"settings": settings(simulation_budget=30)},
        "heuristic": {"heuristic": Edge(expansion=0.1)},
        "task_name": {"task": dataclasses.replace(gaussian(), name="another")},
    }
    for name, changes in others.items():
        with pytest.raises(StoreError, match=f"^out: expected a new folder or one of the same run, got .* {name}$"):
            infer(out=tmp_path / "run", **changes)
    (tmp_path / "occupied").mkdir()
    (tmp_path / "occupied" / "notes.txt").write_text("mine")
    with pytest.raises(StoreError, match=r"^out: expected a new or empty folder"):
        infer(out=tmp_path / "occupied")
    assert contents() == before


def test_another_prior_is_another_run(tmp_path):
    """The prior is of the same kind with other numbers; a folder without the numbers can still be read."""
    normal = lambda mean: dataclasses.replace(
        gaussian(), prior=distrax.MultivariateNormalDiag(jnp.array([mean, 0.3]), jnp.array([2.0, 1.0]))
    )
    spec = infer_module.RunSpec("own", "ok", gaussian().support("ok"), Edge(), 0)
    plan = lambda task: infer_module.BatchPlan("jaxlfi-run", None, task, None, ONE, (spec,))
    described = lambda task: as_json(run_config(task, plan(task).origin(spec), spec, ONE))
    config = described(normal(0.5))
    infer_module._require_same(tmp_path, config, plan(normal(0.5)))
    for other in (normal(0.9), gaussian()):
        with pytest.raises(StoreError, match=r"of a run with another prior$"):
            infer_module._require_same(tmp_path, config, plan(other))
    with pytest.raises(StoreError, match=r"of a run with another prior$"):
        infer_module._require_same(tmp_path, described(gaussian()), plan(normal(0.5)))
    del config["prior_log_density"]
    infer_module._require_same(tmp_path, config, plan(normal(0.9)))


def test_a_traced_run_is_checked_like_another():
    """Before anything is compiled: shapes alone are asked for."""
    shape = lambda **arguments: jax.eval_shape(lambda key: jaxlfi.infer(key, **arguments).x, jax.random.key(0))
    common = {"task": gaussian(), "observation": OBSERVED}
    with pytest.raises(ValueError, match=r"^simulation_budget: expected at least the 20"):
        shape(**common, settings=settings(simulation_budget=5))
    far = distrax.MultivariateNormalDiag(jnp.array([99.0, 99.0]), jnp.ones(2))
    with pytest.raises(ValueError, match=r"^prior: expected some of its mass inside the support"):
        shape(**common | {"task": dataclasses.replace(gaussian(), prior=far)}, settings=SETTINGS)
    tailed = dataclasses.replace(gaussian(), prior=distrax.Independent(distrax.Laplace(jnp.zeros(2), jnp.ones(2)), 1))
    with pytest.raises(ValueError, match=r"^correction='paper' divides by the prior"):
        shape(**common | {"task": tailed}, settings=settings(correction="paper"))


def test_another_observation_or_support_is_another_run(tmp_path):
    """They do not stand in the settings, but the result of the folder would not be the one that was asked for."""
    infer(0, out=tmp_path / "run")
    for changes in ({"observation": OBSERVED + 1}, {"support": "ok"}):
        with pytest.raises(StoreError, match=r"^out: expected a new folder or one of the same run"):
            infer(out=tmp_path / "run", **changes)


def test_progress_is_shown_when_asked_for(capsys):
    infer()
    assert capsys.readouterr().out == ""
    infer(progress=True)
    assert "gaussian_linear: 1 run" in capsys.readouterr().out


# -------------------------------------------------------------------------------------------- posteriors of a run


def test_draws_lie_in_the_support():
    run = infer(task=OWN, heuristic=FIXED, support="own", settings=ONE)
    draws = run.posterior.sample(jax.random.key(1), 1000)
    assert draws.shape == (1000, 2) and bool(BOX.contains(draws).all())
    assert bool(run.belief.support.contains(run.space.to_inference(draws)).all())


def test_a_network_of_one_round_knows_other_observations(tmp_path):
    run = infer(task=OWN, heuristic=FIXED, support="own", settings=ONE)
    assert run.amortised
    own, again = run.posterior, run.posterior_of(OBSERVED)
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(own), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)
    other = run.posterior_of(OBSERVED + 1)
    means = [np.asarray(posterior.sample(jax.random.key(0), 1000)).mean(0) for posterior in (own, other)]
    assert np.abs(means[1] - means[0]).max() > 0.05
    loaded = load(run.save(tmp_path / "run"), OWN).posterior_of(OBSERVED + 1)
    np.testing.assert_allclose(loaded.mixture.means, other.mixture.means, rtol=1e-4, atol=1e-4)
    with pytest.raises(ValueError, match=r"^observation: expected a trajectory of shape \[2\] .* got \[3\]$"):
        run.posterior_of(np.zeros(3))
    for observation in (np.array([np.nan, 0.0]), np.array([0.0, np.inf])):
        with pytest.raises(ValueError, match=r"^observation: expected finite numbers, got some that are not$"):
            run.posterior_of(observation)
    unknown = run.replace(task=None, observed=np.zeros((3, 2)))
    with pytest.raises(ValueError, match=r"^observation: expected a summary of shape \[2\], as the task is not known"):
        unknown.posterior_of(np.zeros((3, 2)))
    with pytest.raises(ValueError, match=r"^posterior_of: expected a run whose network was kept"):
        run.replace(network=None).posterior_of(OBSERVED)


def test_a_network_of_several_rounds_does_not():
    run = infer(observation=None)
    assert not run.amortised
    with pytest.raises(ValueError, match=r"^posterior_of: expected a run of one round, got one of 2, whose network"):
        run.posterior_of(OBSERVED)


def test_a_fixed_support_that_is_wrong_warns():
    far = Support([0.5, 2.0], [2.4, 3.0])  # the observation says -0.6
    with pytest.warns(jaxlfi.SupportWarning, match="second reaches its lower bound 2 "):
        run = infer(task=OWN, support=far, heuristic=FIXED, settings=ONE)
    assert any("widen the support" in text for text in run.warnings)
    assert all("--heuristic" not in text and "heuristic=jaxlfi.Edge()" in text for text in run.warnings)


def test_an_observation_unlike_all_simulations_warns(tmp_path):
    with pytest.warns(
        jaxlfi.MisspecificationWarning, match=r"^observation: x_1 is 1e\+06, all 40 simulations lie between"
    ):
        run = infer(observation=np.array([1e6, 0.0], np.float32))
    (text,) = run.misspecification
    assert text.endswith("is it in the simulator's units, and could the box be wrong?") and text in run.warnings
    again = load(run.save(tmp_path / "run"), gaussian())
    assert again.misspecification == run.replace(task=None).misspecification == [text]
    assert run.replace(x=run.dataset.x[39]).misspecification == []


def test_an_observation_of_the_model_does_not(recwarn):
    assert infer().misspecification == []
    assert not [found for found in recwarn if found.category is jaxlfi.MisspecificationWarning]


@pytest.mark.slow
def test_a_support_that_grows_warns_of_the_bounds_of_phi_alone():
    """Edge cannot move them, and moves all others."""
    run = infer(settings=ONE, heuristic=Edge())
    mixture, box = run.belief.mixture, Support([-2.0, -2.0], [2.0, 2.0])
    outside = run.replace(
        belief=run.belief.replace(
            support=box,
            mixture=mixture.replace(means=jnp.full_like(mixture.means, 2.5), scale_tril=mixture.scale_tril / 1e3),
        ),
        feasible=Support([-5.0, -5.0], [5.0, 2.0]),
    )
    (text,) = outside.warnings
    assert text.startswith("second reaches its upper bound 2 (1.00 of") and "of the feasible domain Phi" in text
    assert len(outside.replace(heuristic=Fixed()).warnings) == 2


@pytest.mark.slow
def test_mode_pairs_components_as_on_the_command_line(tmp_path):
    """Networks that start anew number their components as they like."""
    flags = ("--support", "misspecified", "--heuristic", "mode", *FLAGS, "--out", tmp_path / "cli")
    assert command("infer", TASK, *flags) == 0
    run = infer(0, observation=None, heuristic=jaxlfi.Mode())
    other = load(tmp_path / "cli", gaussian())
    assert run.heuristic == other.heuristic == jaxlfi.Matched(jaxlfi.Mode())
    np.testing.assert_array_equal(run.history["support_high"], other.history["support_high"])
    np.testing.assert_array_equal(run.mixture.means, other.mixture.means)


def test_seeds_and_names_stand_for_keys_and_heuristics(monkeypatch):
    run = jaxlfi.infer(3, gaussian(), OBSERVED, support="misspecified", heuristic="edge", settings=SETTINGS)
    same = infer(3, heuristic=Edge())
    assert run.heuristic == same.heuristic
    np.testing.assert_array_equal(run.mixture.means, same.mixture.means)
    np.testing.assert_array_equal(run.posterior.sample(4, 7), same.posterior.sample(jax.random.key(4), 7))
    # With the hyperparameters that a task asks for: of what would be run, as it would be recompiled.
    plans, task = [], dataclasses.replace(gaussian(), hyperparameters={"edge": {"expansion": 0.5}})
    monkeypatch.setattr(infer_module, "_run", lambda plan, *_: plans.append(plan) or same)
    infer(3, task, heuristic="edge")
    assert plans[0].task is task and plans[0].specs[0].heuristic == Edge(expansion=0.5)


def test_without_an_observation_one_is_simulated_at_the_truth():
    a, b, c = infer(0, observation=None), infer(0, observation=None), infer(1, observation=None)
    np.testing.assert_array_equal(a.observed, b.observed)
    assert not np.allclose(a.observed, c.observed)
    own = infer(0, OWN, observation=None, support="own", heuristic=FIXED, settings=ONE)
    np.testing.assert_array_equal(own.observed, OBSERVED)


# ------------------------------------------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"observation": np.zeros(3)}, r"observation: expected the shape the simulator produces, \[2\], got \[3\]"),
        ({"observation": np.array([np.nan, np.inf])}, "observation: expected finite"),
        ({"support": "unknown"}, "support: expected one of"),
        ({"support": ([0, 0], [1, 1])}, r"support: expected one of .* or a box such as jaxlfi\.Support"),
        ({"support": Support([0.0], [1.0])}, "support: expected bounds for 2 parameters, got 1"),
        ({"support": Support([0.0, 0.0], [1.0, 11.0])}, "support: expected a box inside the feasible domain Phi"),
        ({"space": "log"}, "space: expected 'natural' or 'inference', got 'log'"),
        ({"heuristic": "edgy"}, r"heuristic: expected .*edge.*, got 'edgy'"),
        ({"heuristic": Edge}, r"heuristic: expected an instance such as jaxlfi\.Edge\(\), got the class Edge"),
        ({"heuristic": lambda *_: None}, r"heuristic: expected an instance"),
        ({"heuristic": Edge(expansion=np.ones(3))}, r"heuristic: .*scalars or 2 values, got shape \(3,\)"),
        ({"settings": "quick"}, r"settings: expected jaxlfi\.Settings such as jaxlfi\.QUICK, got 'quick'"),
        ({"settings": settings(simulation_budget=5)}, "simulation_budget: expected at least the 20"),
        ({"task": "gaussian_linear"}, r"task: expected a jaxlfi\.Task, got str"),
        ({"task": dataclasses.replace(gaussian(), truth=None), "observation": None}, "observation: expected one"),
    ],
)
def test_bad_input_is_named(arguments, message):
    with pytest.raises(ValueError, match=f"^{message}") as refused:
        infer(**arguments)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("key", [0.5, "seed", np.zeros(3, np.uint32), jax.random.split(jax.random.key(0), 2)])
def test_a_key_is_one_typed_key(key):
    expected = r"^key: expected one key such as jax\.random\.key\(0\), or a seed, got "
    with pytest.raises(ValueError, match=expected) as refused:
        jaxlfi.infer(key, gaussian(), OBSERVED, settings=SETTINGS)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("simulate", "message"),
    [
        (lambda key, theta: np.asarray(theta), "JAX can trace"),
        (lambda key, theta: theta[0], r"expected one array"),
        (lambda key, theta: (theta, theta, theta), r"expected one array"),
        (lambda key, theta: (theta, theta > 0), "expected a scalar outcome"),
        (fails_above, r"got none \(failed: 25, non_finite: 0\)"),
    ],
)
def test_a_simulator_that_breaks_its_contract_is_named(simulate, message):
    with pytest.raises(SimulatorError, match=message):
        infer(task=dataclasses.replace(OWN, simulate=simulate), support="failing", heuristic=FIXED, settings=ONE)


def test_bounds_are_natural_unless_asked_for_otherwise():
    natural = infer(task=OWN, support=Support([1.0, -1.0], [2.0, 1.0]), heuristic=TRUNCATE, settings=ONE)
    inner = Support([0.0, -1.0], [float(np.log(2.0)), 1.0])
    inference = infer(task=OWN, support=inner, space="inference", heuristic=TRUNCATE, settings=ONE)
    np.testing.assert_allclose(natural.support.low, [0.0, -1.0])
    np.testing.assert_allclose(natural.belief.mixture.means, inference.belief.mixture.means, rtol=1e-3, atol=1e-3)
