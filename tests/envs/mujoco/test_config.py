"""Tasks that TOML files describe."""

import csv

import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("mujoco")

from envs_mujoco import ARM, recorded

from jaxlfi.cli import parser as cli
from jaxlfi.envs.mujoco.config import read
from jaxlfi.registry import TASKS

CONFIG = """
model = "arm.xml"
log = ["swing.csv"]
measured = ["angle"]

[parameters."joint/elbow/damping"]
support = [0.01, 0.2]
feasible = [0.001, 1]
unit = "N m s/rad"
log = true
truth = 0.03

[parameters."control/delay"]
support = [0, 0.1]
truth = 0

[noise]
angle = 0.002

[initial]
"shoulder/qpos" = 0.25
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM)
    log = recorded()
    with (tmp_path / "swing.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["time [s]", "motor [N m]", "angle [deg]"])
        writer.writerows(zip(log.times, log.signals["motor"], np.rad2deg(log.signals["angle"]), strict=True))
    (tmp_path / "arm.toml").write_text(CONFIG)
    return tmp_path


def test_a_file_says_all_of_it(folder):
    task = TASKS.load(f"mujoco,config={folder / 'arm.toml'}")
    assert task.name == "arm" and task.names == ("joint/elbow/damping", "control/delay")
    assert task.units == ("N m s/rad", "") and task.log == ("joint/elbow/damping",)
    assert task.channels == ("angle [rad]",) and task.record_label == "time [s]"
    np.testing.assert_allclose(task.truth, [0.03, 0])
    np.testing.assert_allclose(task.feasible.high, [1, 0.1])
    np.testing.assert_allclose(task.observation[:, 0], recorded().signals["angle"], atol=1e-6)
    rows, _ = task.simulate.function.clean([[0.03, 0.0]])
    np.testing.assert_allclose(rows[0, :, 0], recorded(start=(0.25, 0.0)).signals["angle"], atol=1e-9)
    noisy, _ = task.simulate.function(np.random.default_rng(0), np.array([[0.03, 0.0]]))
    assert np.std(noisy - rows) == pytest.approx(0.002, rel=4 / np.sqrt(2 * 101))


def test_another_recording_in_its_place(folder):
    (folder / "other.csv").write_text("time [s],motor,angle [rad]\n0,0,0.5\n1,0,0.25\n")
    task = TASKS.load(f"mujoco,config={folder / 'arm.toml'},log={folder / 'other.csv'}")
    assert task.observation[:, 0].tolist() == [0.5, 0.25]
    both = TASKS.load(f"mujoco,config={folder / 'arm.toml'},log={folder / 'other.csv'};{folder / 'swing.csv'}")
    assert both.observation.shape == (103, 1)


def test_a_summary_by_its_name(folder):
    """A summary can be named in the file or replace the file's."""
    path = folder / "arm.toml"
    path.write_text('summary = "spectrum"\n' + CONFIG)
    shape = lambda task: task.summary(jnp.asarray(task.observation)).shape
    assert shape(read(path)) == (12,)
    assert shape(TASKS.load(f"mujoco,config={path},summary=samples")) == (30,)
    learnt = TASKS.load(f"mujoco,config={path},summary=learnt")
    assert shape(learnt) == (101,) and learnt.settings["embedding"] == "series"


def test_without_a_file_it_says_what_it_needs(capsys):
    assert cli.main(["tasks", "mujoco"]) == 2
    assert "task: expected mujoco,config=FILE, got 'mujoco'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('model = "arm.xml"', "", "expected model, got none"),
        ('model = "arm.xml"', "model = 3", "model: expected a str, got 3"),
        ('model = "arm.xml"', 'model = "leg.xml"', "expected an MJCF file, got none called "),
        ('log = ["swing.csv"]', "", "expected recordings, as log = \\[FILE\\], or mujoco,config="),
        ('log = ["swing.csv"]', 'log = ["none.csv"]', "none.csv: expected a CSV file"),
        ("[noise]", "[noises]", "expected keys among model, log, .* got 'noises'"),
        ("angle = 0.002", 'angle = "low"', "noise: angle: expected a number, got 'low'"),
        ("support = [0, 0.1]", "support = [0.1, 0]", "'control/delay': support: expected LOW below HIGH"),
        ("support = [0, 0.1]", "support = 0.1", "'control/delay': support: expected \\[LOW, HIGH\\], got 0.1"),
        ("support = [0, 0.1]", "", "'control/delay': expected support = \\[LOW, HIGH\\]"),
        ("support = [0, 0.1]", "support = [0, 0.1]\nbounds = 1", "expected keys among support, .* got bounds"),
        ("log = true", "log = 1", "expected log = true or false and a unit in quotes"),
        ("feasible = [0.001, 1]", "feasible = [0.1, 1]", "support: expected bounds within feasible"),
        ("feasible = [0.001, 1]", "feasible = [0, 1]", "expected positive bounds for the log parameters"),
        ("joint/elbow/damping", "joint/elbo/damping", "expected a joint such as elbow, got 'elbo'"),
        ('"shoulder/qpos"', '"wrist/qpos"', "expected a joint such as "),
        ('model = "arm.xml"', 'model = "arm.xml"\nsummary = "spectra"', "summary: expected one of .*, got 'spectra'"),
        ('model = "arm.xml"', 'model = "arm.xml"\nsummary = 3', "summary: expected a str, got 3"),
        ('model = "arm.xml"', 'model = "arm.xml"\nunmodelled_force = -1', "expected a fraction of at least 0, got -1"),
        ('model = "arm.xml"', 'model = "arm.xml"\nunmodelled_force = true', "expected a float, got True"),
        ("[initial]", "[initial", "expected a TOML file, got a missing or damaged one"),
    ],
)
def test_files_that_describe_no_task_are_one_line(folder, capsys, old, new, expected):
    path = folder / "arm.toml"
    assert old in CONFIG
    path.write_text(CONFIG.replace(old, new))
    with pytest.raises(ValueError, match=expected) as caught:
        read(path)
    assert "\n" not in str(caught.value)
    out = folder / "run"
    assert cli.main(["infer", f"mujoco,config={path}", "--out", str(out)]) == 2
    assert "Traceback" not in capsys.readouterr().err and not out.exists()


def test_other_first_guesses_and_what_the_model_gets_wrong(folder):
    (folder / "arm.toml").write_text(
        CONFIG
        + '[supports.wide]\n"joint/elbow/damping" = [0.001, 0.9]\n'
        + "[discrepancy]\nangle = { deviation = 0.5, time = 0.2 }\n"
    )
    task = TASKS.load(f"mujoco,config={folder / 'arm.toml'}")
    assert task.simulate.function.forces is None
    np.testing.assert_allclose(task.supports["wide"].low, [0.001, 0])
    np.testing.assert_allclose(task.supports["wide"].high, [0.9, 0.1])
    theta = np.tile([0.03, 0.0], (400, 1))
    noisy, _ = task.simulate.function(np.random.default_rng(0), theta)
    clean, _ = task.simulate.function.clean(theta[:1])
    error = noisy[:, :, 0] - clean[:, :, 0]
    # A standard deviation of 0.5 within four sigma, and neighbours that persist: exp(-0.02 / 0.2) = 0.905.
    assert error[:, 50].std() == pytest.approx(np.hypot(0.5, 0.002), rel=4 / np.sqrt(800))
    assert np.corrcoef(error[:, 50], error[:, 51])[0, 1] == pytest.approx(np.exp(-0.1), abs=0.05)


def test_forces_that_the_model_lacks(folder):
    """A fraction of what acts on each joint at the centre of the box."""
    (folder / "arm.toml").write_text("unmodelled_force = 1\n" + CONFIG)
    task = TASKS.load(f"mujoco,config={folder / 'arm.toml'}")
    expected = task.simulate.function.typical_forces(np.array([np.sqrt(0.01 * 0.2), 0.05]))
    np.testing.assert_allclose(task.simulate.function.forces.deviations, expected.deviations)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[supports.wide]\n"joint/elbow/dampin" = [0.1, 0.2]', "expected some of .*, got joint/elbow/dampin$"),
        ('[supports.wide]\n"joint/elbow/damping" = [0.1, 7]', "expected bounds within feasible"),
        ('[supports]\nwide = 3', r"supports: wide: expected bounds \[LOW, HIGH\] of parameters, got 3"),
        ("[discrepancy]\nangl = { deviation = 1, time = 1 }", "discrepancy: expected some of angle, got angl"),
        ("[discrepancy]\nangle = 0.1", r"discrepancy: angle: expected { deviation = NUMBER, time = SECONDS }, got 0.1"),
        ("[discrepancy]\nangle = { deviation = 1, time = 0 }", "a correlation time above 0 s, got 1 and 0"),
    ],
)  # fmt: skip
def test_guesses_and_discrepancies_that_do_not_fit(folder, text, message):
    (folder / "arm.toml").write_text(CONFIG + text)
    with pytest.raises(ValueError, match=message):
        read(folder / "arm.toml")


def test_units_that_contradict_the_sensor(folder):
    text = (folder / "swing.csv").read_text().replace("angle [deg]", "angle [mm]")
    (folder / "swing.csv").write_text(text)
    with pytest.raises(ValueError, match=r"swing.csv: angle: expected rad as the sensor, got m"):
        read(folder / "arm.toml")
