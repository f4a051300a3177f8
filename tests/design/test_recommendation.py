"""Run.design and the command: the table, what is written, and bad input in one line."""

import csv
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlfi
from jaxlfi.cli.design import main
from jaxlfi.design import played
from jaxlfi.design.recommendation import recommend
from jaxlfi.design.regions import regions
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.envs.mujoco import logs
from jaxlfi.estimators.posterior import truncated
from jaxlfi.figures import designs as figures
from jaxlfi.io import files
from jaxlfi.tasks.design import Design
from tests import small
from tests.small import whole_runs  # noqa: F401

GUESS = Support([0.5, 0.5], [2.0, 2.0])
TASK = "tests.design.test_recommendation:task"


def task(load: bool = True) -> jaxlfi.Task:
    """An arm that swings in a plane: a known load, where it may be chosen, tells its mass from its motor's gain."""

    def response(theta, design):
        mass, gain = theta
        load = design[1] if load_allowed else 0.0
        return gain * design[0] / (mass + load) * jnp.array([1.0, 2.0])

    load_allowed = load
    variables = {"torque": (0.1, 1.0, "N m"), **({"load": (0.0, 1.0, "kg")} if load else {})}
    return jaxlfi.Task(
        lambda key, theta, design: response(theta, design) + 0.01 * jax.random.normal(key, (2,)),
        names=("mass", "gain"),
        units=("kg", ""),
        log=("mass", "gain"),
        supports={"guess": GUESS},
        feasible=GUESS,
        truth=np.array([1.0, 1.0]),
        name="arm",
        design=Design(
            variables,
            nominal={"torque": 0.5} | ({"load": 0.0} if load else {}),
            response=response,
            noise=0.01,
            controls=lambda design: (["time [s]", "motor"], np.array([[0.0, design[0]], [1.0, 0.0]])),
        ),
    )


def without_load() -> jaxlfi.Task:
    """The same arm without a load: an exact ridge."""
    return task(load=False)


def on_the_ridge(task: jaxlfi.Task):
    """A posterior that knows the ratio of mass and gain only, and the boxes of its run."""
    level, ratio = 0.3, 0.01
    factor = np.linalg.cholesky(np.array([[level**2 + ratio**2, level**2], [level**2, level**2 + ratio**2]]))
    mixture = GaussianMixture(jnp.zeros(1), jnp.zeros((1, 2)), jnp.asarray(factor[None], jnp.float32))
    box = task.space.box_to_inference(GUESS)
    return truncated(mixture, mixture, box, task.space), box, box, box


@pytest.mark.slow
def test_a_ridge_that_an_experiment_breaks_is_broken():
    found = recommend(jax.random.key(0), task(), *on_the_ridge(task()), rated=96)
    assert found.method == "fisher" and found.ridge.known == "mass / gain"
    torque, load = found.designs[0]
    assert torque > 0.95 and load > 0.5  # the load that tells most is the arm's mass, about 1 kg
    assert found.narrower > 5 and "Ridge: broken" in found.sentences()[-1]
    now, after = found.widths
    assert (after < 0.3 * now).all() and found.nominal.narrower[0] < 1.1
    assert found.chosen.rated.value[0] > found.alternatives.rated.value.max() > found.nominal.rated.value[0]
    headings, rows = found.table()
    assert headings[:4] == ["experiment", "torque [N m]", "load [kg]", "bits"] and len(rows) > 2
    assert all(len(row) == len(headings) for row in rows) and rows[-1][0] == "nominal"


def test_a_ridge_that_nothing_breaks_is_named():
    own = without_load()
    found = recommend(jax.random.key(0), own, *on_the_ridge(own), rated=64, about="ridge")
    assert found.reach < 1.05
    assert found.sentences()[-1].startswith(
        "Ridge: no experiment within the bounds determines mass * gain (only mass /"
    )
    assert found.together[0] < 0.05


@pytest.mark.slow
def test_the_expected_interval_is_the_one_that_a_posterior_has():
    """A measurement whose noise is that of the belief makes it narrower by sqrt(2)."""
    space, box = Space(("a",), (False,)), Support([-9.0], [9.0])
    mixture = GaussianMixture(jnp.zeros(1), jnp.zeros((1, 1)), jnp.ones((1, 1, 1)))
    own = jaxlfi.Task(
        lambda key, theta, design: theta * design[0] + jax.random.normal(key, (1,)),
        ["a"],
        {"guess": box},
        box,
        channel_noise=[1.0],
        channels=["y"],
        design={"gain": (0.0, 1.0)},
    )
    posterior = truncated(mixture, mixture, box, space)
    found = recommend(jax.random.key(0), own, posterior, box, box, box, rated=64, inflation=1.0, share=0.0)
    np.testing.assert_allclose(found.widths[:, 0], [2 * 1.645, 2 * 1.645 / np.sqrt(2)], rtol=0.05)
    assert found.together[0] == pytest.approx(0.5, rel=0.05)
    assert found.narrower == pytest.approx(np.sqrt(2), rel=0.02)


def test_regions_are_wider_than_the_posterior_and_hold_the_next_box():
    posterior, box, *_ = on_the_ridge(task())
    wide, everywhere = regions(jax.random.key(0), posterior, box, box, inflation=2.0, share=0.3)
    assert (wide.weight, everywhere.weight) == (0.7, 0.3)
    deviation = np.asarray(posterior.std("inference"))
    assert (np.sqrt(np.diagonal(wide.covariance)) > 1.1 * deviation).all()  # the box cuts off some
    np.testing.assert_allclose(np.sqrt(np.diagonal(everywhere.covariance)), np.log(4) / np.sqrt(12), rtol=0.05)
    assert len(regions(jax.random.key(0), posterior, box, box, share=0.0)) == 1


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run whose task can be found by name."""
    with jax.debug_key_reuse(False):
        run = jaxlfi.infer(jax.random.key(0), task(), settings=small.settings())
    return run.save(tmp_path_factory.mktemp("runs") / "arm")


@pytest.mark.slow
def test_the_command_writes_what_it_prints(folder, tmp_path, capsys):
    words = [str(folder), "--task", TASK, "--rated", "48", "--experiments", "2", "--out", str(tmp_path / "out")]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "torque" in printed and "Expected information" in printed and "Ridge" in printed
    found = files.read_json(tmp_path / "out" / "design.json")
    assert found["parameters"] == ["mass", "gain"] and len(found["chosen"]["designs"]) == 2
    assert found["together"]["bits"] == pytest.approx(sum(found["chosen"]["bits"]), abs=1e-3)
    rows = list(csv.reader((tmp_path / "out" / "designs.csv").open()))
    assert rows[0] == ["torque [N m]", "load [kg]", "bits", "error", "fails"] and len(rows) > 40
    assert [float(row[2]) for row in rows[1:]] == sorted((float(row[2]) for row in rows[1:]), reverse=True)
    controls = list(csv.reader((tmp_path / "out" / "experiment_2.csv").open()))
    assert controls[0] == ["time [s]", "motor"]
    np.testing.assert_allclose(
        logs.read(tmp_path / "out" / "experiment_2.mcap").signals["motor"], [float(row[1]) for row in controls[1:]]
    )
    assert "robotics" not in printed
    assert float(controls[1][1]) == pytest.approx(found["chosen"]["designs"][1][0], rel=1e-6)
    assert (tmp_path / "out" / "design.png").stat().st_size > 10_000
    arrays = files.read_arrays(tmp_path / "out" / "design.npz")
    axes = figures.figure_of(arrays).get_axes()
    assert len(axes) == 3 and axes[0].get_xlabel() == "torque [N m]"


def test_without_mcap_controls_are_written_as_csv_only_and_a_line_says_so(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "mcap", None)
    words = [str(folder), "--task", TASK, "--rated", "16", "--out", str(tmp_path / "out"), "--no-figures", "--quiet"]
    assert main(words) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == (
        "controls are written as CSV only: MCAP files need the package mcap: pip install 'jaxlfi[robotics]'"
    )
    assert sorted(path.name for path in (tmp_path / "out").glob("experiment*")) == ["experiment_1.csv"]


def test_controls_without_times_are_no_signals(tmp_path):
    written = played.write(tmp_path / "a", ["angle [rad]", "load [kg]"], np.ones((2, 2)))
    assert [path.name for path in written] == ["a.csv"]


def test_a_design_of_many_numbers_is_left_to_the_files():
    """A table that is wider than any terminal tells nobody anything."""
    variables = {f"x {i + 1}": (0.0, 1.0, "m") for i in range(9)}
    many = jaxlfi.Task(
        lambda key, theta, design: theta * design[:2] + 0.1 * jax.random.normal(key, (2,)),
        ["mass", "gain"],
        {"guess": GUESS},
        GUESS,
        log=("mass", "gain"),
        design=Design(variables, response=lambda theta, design: theta * design[:2], noise=0.1),
    )
    headings, rows = recommend(jax.random.key(0), many, *on_the_ridge(many), rated=16).table()
    assert headings[:2] == ["experiment", "bits"] and all(len(row) == len(headings) for row in rows)


def test_a_simulator_without_known_noise_is_rated_by_contrasts(folder):
    own = task()
    plain = jaxlfi.Task(
        own.simulate.function,
        own.names,
        own.supports,
        own.feasible,
        units=own.units,
        log=own.log,
        design={"torque": (0.1, 1.0, "N m"), "load": (0.0, 1.0, "kg")},
    )
    found = jaxlfi.load(folder, task=plain).design(rated=16, simulations=128, about=["mass"])
    assert found.method == "contrastive" and found.ceiling == 5.0
    assert "at least" in found.sentences()[0] and "about mass" in found.sentences()[0]
    assert 0 < found.together[0] <= 5.0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--about", "stiffness"], "about: expected some of mass, gain, or ridge, got stiffness"),
        (["--experiments", "0"], "experiments: expected"),
        (["--inflation", "0.5"], "inflation: expected a number of at least 1, got 0.5"),
        (["--share", "1"], "share: expected a number from 0 and below 1, got 1.0"),
        (["--tolerance", "2"], "tolerance: expected a share from 0 and below 1, got 2.0"),
        (["--rated", "3"], "rated: expected at least 16, got 3"),
    ],
)
def test_bad_words_are_refused_in_one_line(folder, words, message, tmp_path, capsys):
    assert main([str(folder), "--task", TASK, "--out", str(tmp_path / "out"), *words]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_tasks_that_are_unknown_or_have_no_design_are_refused(folder, tmp_path, capsys):
    assert main([str(folder)]) == 2
    assert "task: expected a run whose task can be found" in capsys.readouterr().err
    plain = task()
    plain = jaxlfi.Task(
        lambda key, theta: theta, plain.names, plain.supports, plain.feasible, units=plain.units, log=plain.log
    )
    with pytest.raises(ValueError, match="design: expected a task with a design"):
        jaxlfi.load(folder, task=plain).design()
    with pytest.raises(ValueError, match="design: expected a run whose task is known"):
        jaxlfi.load(folder).design()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "own.txt").write_text("mine")
    assert main([str(folder), "--task", TASK, "--out", str(tmp_path / "out")]) == 2
