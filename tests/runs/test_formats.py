"""Folders of earlier versions: each in tests/golden/formats loads, or one line names the jaxlfi that reads it."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import jaxlfi
from jaxlfi import figures
from jaxlfi.figures import checks, style
from jaxlfi.io import files, formats, workfolder
from jaxlfi.io.formats import require_version, written_by
from jaxlfi.rl import policy
from jaxlfi.studies.calibration.folder import read_plan
from tests.small import command, whole_runs  # noqa: F401 - a fixture

FORMATS = sorted(path for path in (Path(__file__).parents[1] / "golden" / "formats").iterdir() if path.is_dir())
NAMED = re.compile(r"jaxlfi \d+\.\d+\.\d+ of \d{4}-\d\d-\d\d")
RUNS = [path.parent for folder in FORMATS for path in sorted(folder.rglob("posterior.npz"))]
name_of = lambda path: str(path.relative_to(FORMATS[0].parent))


def read_now(path: Path) -> bool:
    """Whether a folder is of the version that is written."""
    return files.read_json(path / "config.json")["version"] == formats.VERSION


def loads(path: Path) -> bool:
    """Whether a finished run is of a version that is read."""
    return read_now(path) or files.read_json(path / "config.json")["version"] in formats.READ


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """Pictures of few pixels."""
    save = style.save
    monkeypatch.setattr(style, "save", lambda figure, path, dpi: save(figure, path, 30))


def test_there_is_a_folder_of_this_version():
    assert any(read_now(run) for run in RUNS)


@pytest.mark.parametrize(  # test_load.py has what networks of earlier versions lack
    "folder",
    [pytest.param(one, marks=[pytest.mark.slow] * (one.match("2/flow") or one.match("2-first/*"))) for one in RUNS],
    ids=name_of,
)
def test_a_run_is_loaded_as_it_was_or_its_version_is_named(folder):
    if not loads(folder):
        with pytest.raises(ValueError, match=NAMED) as refused:
            jaxlfi.load(folder)
        assert "\n" not in str(refused.value)
        return
    run, saved = jaxlfi.load(folder), files.read_arrays(folder / "posterior.npz")
    np.testing.assert_array_equal(run.mixture.means, saved["means"])
    assert run.task is not None and {"theta", "support_low", "seconds"} <= set(run.history)
    # The network gives the posterior that it gave: of draws by any other stream of random numbers, the moments.
    own, before = np.asarray(run.draws()), saved["draws"]
    assert own.shape == before.shape
    np.testing.assert_allclose(own.mean(0), before.mean(0), atol=0.25 * before.std(0).max())
    np.testing.assert_allclose(own.std(0), before.std(0), rtol=0.2)
    if run.network is not None:
        assert np.isfinite(run.posterior.log_prob(before)).mean() > 0.99


@pytest.mark.parametrize(  # the first has the fewest arrays, the last all of them
    "folder",
    [
        pytest.param(one, marks=[pytest.mark.slow] * (one not in (FORMATS[0], FORMATS[-1])))
        for one in FORMATS
        if (one / "run").is_dir()
    ],
    ids=name_of,
)
def test_the_pictures_of_a_run_are_drawn(folder, tmp_path):
    """Pictures are drawn from the arrays of any version so far."""
    shutil.copytree(folder / "run", tmp_path / "run")
    assert {path.suffix for path in figures.report(tmp_path / "run")} == {".html", ".png"}


@pytest.mark.parametrize("folder", [one for one in FORMATS if (one / "grid").is_dir()], ids=name_of)
def test_studies_are_read(folder, tmp_path):
    for name in ("grid", "comparison"):
        if read_now(folder / name):
            shutil.copytree(folder / name, tmp_path / name)
            assert command("report", tmp_path / name) == 0 and command("resume", tmp_path / name) == 0
    if read_now(folder / "grid"):
        assert workfolder.read(folder / "grid", formats.GRID)["status"] == "finished"
        assert read_plan(folder / "flow" / "diagnostics" / "plan.json")["draws"] == 20
        shutil.copytree(folder / "flow" / "diagnostics", tmp_path / "diagnostics")
        assert len(checks.report(tmp_path / "diagnostics")) == 6


@pytest.mark.parametrize("folder", [one for one in FORMATS if (one / "stopped").is_dir()], ids=name_of)
def test_a_run_that_was_stopped_goes_on_or_its_version_is_named(folder, tmp_path, capsys, whole_runs):  # noqa: F811
    shutil.copytree(folder / "stopped", tmp_path / "run")
    status = command("resume", tmp_path / "run", "--no-figures")
    if status == 0:
        assert len(jaxlfi.load(tmp_path / "run").history["seconds"]) == 2
    else:
        error = capsys.readouterr().err
        assert status == 2 and NAMED.search(error) and error.count("\n") == 1


@pytest.mark.parametrize("path", [path for folder in FORMATS for path in folder.glob("policy.npz")], ids=name_of)
def test_a_policy_acts_as_it_did(path):
    rng, observation = np.random.default_rng(0), np.array([1.2, -0.5])
    first, second = (rng.normal(size=shape).astype(np.float32) for shape in ((2, 3), (3, 2)))
    hidden = np.tanh((observation - [1.0, 0.0]) / [0.5, 2.0] @ first + 1)
    expected = np.clip(hidden @ second + 1, -1, 1) * [0.5, 2.0] + [1.0, 0.0]
    np.testing.assert_allclose(policy.load(path)(observation), expected, rtol=1e-5)


@pytest.mark.parametrize("path", [path for folder in FORMATS for path in folder.glob("recording.npz")], ids=name_of)
def test_a_recording_and_weights_are_read(path):
    pytest.importorskip("mujoco")
    from jaxlfi.envs.whip import recording
    from jaxlfi.envs.whip.vision import weights

    assert recording.read(path).actions.shape == (16, 2)
    assert weights.load(path.with_name("segmenter.npz"), "segmenter").about["versions"]["jaxlfi"]


def test_the_line_names_who_reads_a_file():
    record = {"versions": {"jaxlfi": "0.3.0"}, "started": "2027-01-02T03:04:05+00:00"}
    assert written_by(record) == "jaxlfi 0.3.0 of 2027-01-02" and written_by({}) == written_by({"versions": 3}) == ""
    require_version("x", "jaxlfi-run", 2, 2)
    for got, expected in ((3, "got version 3, which a newer jaxlfi"), (1, "got version 1, which an older jaxlfi")):
        with pytest.raises(ValueError, match=rf"^x: expected jaxlfi-run of version 2, {expected} wrote and reads$"):
            require_version("x", "jaxlfi-run", 2, got)
    with pytest.raises(ValueError, match=r"got version 3, which jaxlfi 0\.3\.0 of 2027-01-02 wrote and reads"):
        require_version("x", "jaxlfi-run", 2, 3, record)
    for got in (None, "2", 2.0, True, 0, -1):
        with pytest.raises(ValueError, match=r"of version 2, got version [^,]*$"):
            require_version("x", "jaxlfi-run", 2, got, record)


MORE = {
    "history.npz": {"messages": np.array(["failed: singular matrix", ""]), "unlike": np.zeros(7)},
    "observation.npz": {"verdict": np.array("like the simulations"), "mask": np.zeros(3, bool)},
    "posterior.npz": {"notes": np.array(["a", "b"])},
    "dataset.npz": {"sources": np.array(["a"] * 3)},
}


def test_readers_do_without_what_they_do_not_know(tmp_path):
    """A file with one more array, of texts or of another shape, is read as one without it."""
    folder = next(run for run in RUNS if read_now(run) and run.name == "run")
    shutil.copytree(folder, tmp_path / "run")
    for name, arrays in MORE.items():
        path = tmp_path / "run" / name
        files.write_arrays(path, files.read_arrays(path) | arrays)
    config = files.read_json(tmp_path / "run" / "config.json")
    files.write_json(tmp_path / "run" / "config.json", config | {"unlike_observation": {"verdict": "none"}})
    run, plain = jaxlfi.load(tmp_path / "run"), jaxlfi.load(folder)
    assert run.history.keys() == plain.history.keys()
    assert figures.report(tmp_path / "run") and run.save(tmp_path / "again").is_dir()
