"""`jaxlfi mujoco`: its commands on a run's folder, and whatever is refused, in one line."""

import csv
import dataclasses
import json
import subprocess
import sys
import types

import numpy as np
import pytest
import scipy.optimize

pytest.importorskip("mujoco")

import small
from envs_mujoco import ARM, recorded
from PIL import Image
from small import whole_runs  # noqa: F401

from jaxlfi.envs.mujoco import commands, config, least_squares, sysid_point
from jaxlfi.envs.mujoco.sysid_point import SysidPoint
from tests.envs.mujoco.test_film import renderer  # noqa: F401

CONFIG = """
model = "arm.xml"
log = ["swing.csv"]

[parameters."joint/shoulder/damping"]
support = [0.02, 0.5]
unit = "N m s/rad"
log = true
truth = 0.08

[parameters."actuator/motor/gear[0]"]
support = [0.5, 3.0]
truth = 1.5

[noise]
angle = 0.002
"""

FLAGS = [*small.FLAGS, "--rounds", 1, "--no-predictive"]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A folder with a task's file and a run of it."""
    folder = tmp_path_factory.mktemp("runs")
    log, rng = recorded(), np.random.default_rng(0)
    noisy = log.signals["angle"] + 0.002 * rng.standard_normal(len(log.times))
    with (folder / "swing.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["time [s]", "motor [N m]", "angle [rad]"])
        writer.writerows(zip(log.times, log.signals["motor"], noisy, strict=True))
    (folder / "arm.xml").write_text(ARM)
    (folder / "arm.toml").write_text(CONFIG)
    assert small.command("infer", f"mujoco,config={folder / 'arm.toml'}", "--out", folder / "run", *FLAGS) == 0
    return folder


def mujoco(*words) -> int:
    return small.command("mujoco", *words)


# ------------------------------------------------------------------------------------------------------------- film


@pytest.mark.slow
def test_a_film_of_a_run(renderer, runs, tmp_path, capsys):  # noqa: F811
    out = tmp_path / "films/arm.gif"
    words = ("film", runs / "run", "--draws", 2, "--slower", 0.5, "--size", "160x170", "--out", out)
    assert mujoco(*words) == 0
    with Image.open(out) as film, Image.open(out.with_suffix(".png")) as sheet:
        assert film.size == (160, 170) and film.n_frames == 26 and sheet.width > 1000
    said = capsys.readouterr().out
    assert f"film of 26 frames: {out}" in said and f"6 of them: {out.with_suffix('.png')}" in said
    assert "the recorded pose is not drawn: the recording does not measure elbow" in said
    before = out.read_bytes()
    assert mujoco(*words) == 2 and out.read_bytes() == before
    assert sorted(path.name for path in out.parent.iterdir()) == ["arm.gif", "arm.png"]


# -------------------------------------------------------------------------------------------------------------- fit


@pytest.mark.slow
def test_a_fit_of_a_run_and_of_its_file(runs, tmp_path, capsys):
    """From posterior draws and from draws of Phi, it ends at the same least-squares point."""
    assert mujoco("fit", runs / "run", "--starts", 8, "--keep", 1, "--out", tmp_path / "new/fit") == 0
    said = capsys.readouterr().out
    assert "point 1 of 1" in said and "joint/shoulder/damping" in said and f"results: {tmp_path / 'new/fit'}" in said
    assert sorted(path.name for path in (tmp_path / "new/fit").iterdir()) == ["fit.json", "pairs.png"]
    (point,) = json.loads((tmp_path / "new/fit/fit.json").read_text())["points"]
    assert point["names"] == ["joint/shoulder/damping", "actuator/motor/gear[0]"]
    np.testing.assert_allclose(point["theta"], [0.08, 1.5], rtol=0.02)
    task = config.read(runs / "arm.toml")
    np.testing.assert_allclose(point["theta"], least_squares.fit(task, [0.1, 1.2]).theta, rtol=1e-3)
    assert mujoco("fit", runs / "arm.toml", "--starts", 8, "--keep", 1) == 0
    said = capsys.readouterr().out
    assert f"{point['theta'][1]:.4g}" in said and "[discrepancy]" in said and "results:" not in said


def test_what_a_fit_says(runs):
    task = config.read(runs / "arm.toml")
    best = least_squares.fit(task, [0.1, 1.2])
    one, other = (dict(zip(("theta", "misfit"), pair, strict=True)) for pair in (([0.5, 1.0], 1.05), ([0.4, 2.0], 9.0)))
    changed = [commands.dataclasses.replace(best, **changes) for changes in (one, other)]
    bound = commands.dataclasses.replace(
        best,
        misfit=1.0,
        theta=np.array([0.5, 1.0]),
        at_bound=np.array([True, False]),
        covariance=1e-4 * np.array([[1.0, 0.99], [0.99, 1.0]]),
    )
    lines = "\n".join(commands.said(task, [bound, *changed]))
    assert "2 points explain the recording equally well" in lines
    assert "joint/shoulder/damping ended on a bound of Phi" in lines and "gear[0] ended" not in lines
    assert "joint/shoulder/damping and actuator/motor/gear[0]" in lines and "(correlation 0.99)" in lines
    assert "Residuals are 1.00 times the noise" in lines and '\n"angle" = { deviation = ' in lines
    independent = dataclasses.replace(best, covariance=np.diag(np.diagonal(best.covariance)))
    alone = "\n".join(commands.said(task, [independent, changed[1]]))
    assert not any(word in alone for word in ("as well", "bound", "trade off"))
    assert best.defect == 0 and "is not subtracted: a finer integrator does not fit better" in alone
    corrected = commands.said(task, [dataclasses.replace(best, defect=0.4)])
    assert any("error is 0.40 times the noise, and is subtracted" in line for line in corrected)


def test_the_picture_has_intervals_of_all_points(runs, tmp_path, monkeypatch):
    """Two equally good points, a worse one, and that of mujoco.sysid."""
    task = config.read(runs / "arm.toml")
    best = dataclasses.replace(least_squares.fit(task, [0.1, 1.2]), misfit=1.0)
    second, worse = (
        dataclasses.replace(best, theta=np.array([0.2, 2.0]), misfit=misfit, covariance=covariance)
        for misfit, covariance in ((1.05, np.diag([1e3, 1e3])), (9.0, best.covariance))  # nearly all outside of Phi
    )
    other = SysidPoint(np.array([0.3, 1.0]), 4.0, np.array([[0.2, 0.4], [np.nan, np.nan]]), np.zeros(2, bool), 9)
    drawn, pairs = {}, commands.plot.pairs
    monkeypatch.setattr(
        commands.plot, "pairs", lambda *sets, **given: drawn.update(given, sets=sets) or pairs(*sets, **given)
    )
    commands.draw(tmp_path / "pairs.png", task, [best, second, worse], other, np.full((30, 2), 0.5))
    (sets,) = drawn["sets"]
    assert list(sets) == ["posterior", "point 1, 90 %", "point 2, 90 %"]
    assert list(drawn["points"]) == ["point 1, 90 %", "point 2, 90 %", "mujoco.sysid, 90 %"]
    np.testing.assert_array_equal(drawn["points"]["point 2, 90 %"][0], [0.2, 2.0])
    np.testing.assert_array_equal(drawn["points"]["mujoco.sysid, 90 %"][1], other.interval)
    commands.draw(tmp_path / "alone.png", task, [best])
    assert list(drawn["points"]) == ["point 1, 90 %"] and (tmp_path / "alone.png").exists()


def test_the_point_of_sysid_beside(runs, tmp_path, capsys):
    """It starts in the middle of the first guess, and its interval is that of ordinary least squares."""
    try:
        sysid_point.require_sysid()
    except ImportError:
        pytest.skip("needs mujoco[sysid], of the extra bench")
    words = ("fit", runs / "arm.toml", "--sysid", "--starts", 4, "--keep", 1, "--out", tmp_path / "fit")
    assert mujoco(*words) == 0
    assert "mujoco.sysid, from the middle of the first guess" in capsys.readouterr().out
    found = json.loads((tmp_path / "fit/fit.json").read_text())["mujoco.sysid"]
    task = config.read(runs / "arm.toml")
    residuals = least_squares.Residuals(task)
    low, high = (np.asarray(bound, float) for bound in (task.inference.feasible.low, task.inference.feasible.high))
    solved = scipy.optimize.least_squares(
        lambda x: residuals(x[None])[0], [np.log(0.1), 1.75], lambda x: residuals.jacobian(x, low, high), (low, high)
    )
    np.testing.assert_allclose(found["theta"], [np.exp(solved.x[0]), solved.x[1]], rtol=1e-3)
    variance = np.sum(solved.fun**2) / (len(solved.fun) - 2) * np.linalg.inv(solved.jac.T @ solved.jac)
    reach = 1.66 * np.sqrt(np.diagonal(variance))  # Student's t of 99 degrees of freedom
    expected = solved.x + np.outer([-1, 1], reach)
    np.testing.assert_allclose(found["interval"][0], np.exp(expected[:, 0]), rtol=2e-3)
    np.testing.assert_allclose(found["interval"][1], expected[:, 1], rtol=2e-3)
    assert found["at_bound"] == [False, False] and found["misfit"] == pytest.approx(np.sqrt(np.mean(solved.fun**2)))


def test_without_sysid_it_says_what_to_install(runs, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "mujoco.sysid", types.ModuleType("mujoco.sysid"))  # as MuJoCo alone brings it
    assert mujoco("fit", runs / "arm.toml", "--sysid", "--out", tmp_path / "fit") == 2
    error = capsys.readouterr().err
    assert "the estimate of mujoco.sysid needs its packages: pip install 'mujoco[sysid]'" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "fit").exists()


# -------------------------------------------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("film none --out new.gif", "expected a run folder, got 'none', which is not a folder"),
        ("film . --out new.gif", "expected a run folder, got '.' without a readable config.json"),
        ("film run --out swing.csv", "--out: expected a new .gif file, got swing.csv"),
        ("film run --out taken.gif", "no .png beside it, but there is taken.gif"),
        ("film run --out half.gif", "no .png beside it, but there is half.png"),
        ("film run --out new.gif --size 640", "expected WIDTHxHEIGHT in pixels, as 640x480, got '640'"),
        ("film run --out new.gif --size 64x640", "--size: expected sides of 160 to 1280 pixels, got 64x640"),
        ("film run --out new.gif --size 640x9999", "--size: expected sides of 160 to 1280 pixels, got 640x9999"),
        ("film run --out new.gif --draws 0", "argument --draws: expected a whole number of at least 1, got '0'"),
        ("film run --out new.gif --slower -1", "slower: expected 0.02 to 20"),
        ("film run --out new.gif --episode 3", "episode: expected one of 0 to 0, got 3"),
        ("film run --out new.gif --camera top", "camera: expected none, as those of the model have no names; got"),
        ("film run", "the following arguments are required: --out"),
        ("fit none", "none: expected the folder of a run, a TOML file that describes a task, or a task such as"),
        ("fit gaussian_linear", "task: expected one of a MuJoCo model, got gaussian_linear"),
        ("fit swing.csv", "swing.csv: expected a TOML file"),
        ("fit run --out run", "--out: expected a new folder, got run"),
        ("fit run --starts 0", "argument --starts: expected a whole number of at least 1, got '0'"),
        ("fit run --keep 0.5", "argument --keep: expected a whole number of at least 1, got '0.5'"),
        ("dance", "invalid choice: 'dance' (choose from"),
        ("", "the following arguments are required: COMMAND"),
    ],
)
def test_bad_input_is_refused_in_one_line(runs, monkeypatch, capsys, words, expected):
    monkeypatch.chdir(runs)
    for name in ("taken.gif", "half.png"):
        (runs / name).write_bytes(b"mine")
    before = {path: path.stat().st_mtime_ns for path in runs.rglob("*")}
    assert mujoco(*words.split()) == 2
    error = capsys.readouterr().err
    assert error.startswith("jaxlfi mujoco") and expected in error and error.count("\n") == 1
    assert {path: path.stat().st_mtime_ns for path in runs.rglob("*")} == before


def test_a_run_whose_task_is_gone(runs, tmp_path, capsys):
    moved = tmp_path / "moved"
    moved.mkdir()
    for path in (runs / "run").glob("*.*"):
        (moved / path.name).write_bytes(path.read_bytes())
    text = (moved / "config.json").read_text()
    (moved / "config.json").write_text(text.replace(str(runs / "arm.toml"), "gone/arm.toml"))
    for words in (("film", moved, "--out", tmp_path / "new.gif"), ("fit", moved)):
        assert mujoco(*words) == 2
        error = capsys.readouterr().err
        assert "cannot find its task, mujoco,config=gone/arm.toml" in error and error.count("\n") == 1
        assert "change to the folder that the run was made in" in error


def test_where_there_is_no_renderer(runs, tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setitem(sys.modules, "mujoco.egl", None)
    monkeypatch.setitem(sys.modules, "mujoco.osmesa", None)
    assert mujoco("film", runs / "run", "--draws", 1, "--out", tmp_path / "new.gif") == 2
    error = capsys.readouterr().err
    assert "needs EGL or OSMesa" in error and error.count("\n") == 1 and not list(tmp_path.iterdir())


def test_help_needs_neither_jax_nor_mujoco():
    """It answers at once, and its examples are commands that exist."""
    script = (
        "import sys\nfrom jaxlfi.envs.mujoco import cli\n"
        "text = cli.parser().format_help()\n"
        "assert 'jaxlfi mujoco fit runs/arm' in text and 'jaxlfi mujoco film runs/arm' in text\n"
        "for line in cli.EXAMPLES.splitlines():\n"
        "    words = line.split('     ')[0].split()\n"
        "    if words[:2] == ['jaxlfi', 'mujoco']: cli.parser().parse_args(words[2:])\n"
        "assert not {'jax', 'numpy', 'mujoco'} & set(sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
