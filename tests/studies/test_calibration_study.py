"""Diagnose: exact posteriors pass, wrong ones are called by name, and chunks are picked up where they were left."""

import dataclasses
import html
import json
import os
import shutil
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlfi
from jaxlfi.bayessim.batch import RunSpec
from jaxlfi.bayessim.keys import run_keys
from jaxlfi.cli import parser as cli
from jaxlfi.distributions.support import Support
from jaxlfi.envs import gaussian_linear
from jaxlfi.estimators.base import untrained
from jaxlfi.estimators.mixture_network import MixtureNetwork
from jaxlfi.estimators.normaliser import identity
from jaxlfi.figures import calibration, checks, intervals, page, style
from jaxlfi.figures.collection import Collection
from jaxlfi.figures.history import History
from jaxlfi.heuristics import Edge, Fixed
from jaxlfi.io import files as atomic
from jaxlfi.io import formats, trees, workfolder
from jaxlfi.runs import folder as run_store
from jaxlfi.runs.result import Origin
from jaxlfi.studies import calibration as study
from jaxlfi.studies.calibration import CalibrationPlan, plan
from jaxlfi.studies.calibration.repeat import cost
from jaxlfi.tasks.host import SimulatorError
from tests.small import SETTINGS, TASK, command, gaussian, settings, whole_runs  # noqa: F401 - a fixture

X = np.array([-0.6, -0.3], np.float32)
BOX = gaussian().supports["ok"]
FAST = dataclasses.replace(SETTINGS.estimator, learning_rate=2e-2)
OVER, UNDER = "miscalibrated: over-confident", "miscalibrated: under-confident"


def make(out, support: str, heuristic, rounds: int, scale: float = 1.0, shift: float = 0.0):
    """The folder of a run of the small settings that ended with the exact posterior on its first support.

    The network is one that nobody has trained; `pretend` looks only at the wrong scale and shift in its normaliser.
    """
    task, box = gaussian(), gaussian().supports[support]
    small = settings(rounds=rounds, estimator=FAST, predictive=False)
    spec = RunSpec(support, support, box, heuristic, seed=0)
    config = run_store.run_config(task, Origin(TASK, support, support), spec, small)

    def fill(beside):
        posterior = gaussian_linear.posterior(X)
        belief = {"logits": posterior.logits, "means": posterior.means, "scale_tril": posterior.scale_tril}
        atomic.write_arrays(beside / "posterior.npz", belief | {"support_low": box.low, "support_high": box.high})
        atomic.write_arrays(beside / "observation.npz", {"trajectory": X, "x": X})
        nothing = np.zeros((0, 2), np.float32)
        atomic.write_arrays(beside / "history.npz", {"theta": nothing})
        empty = {"theta": nothing, "x": nothing, "round": np.zeros(0, np.int32), "weight": np.zeros(0, np.float32)}
        atomic.write_arrays(beside / "dataset.npz", empty)
        network = untrained(jax.random.key(0), FAST, len(X), task.inference.feasible, task.space)
        moments = {"mean": np.full(2, shift, np.float32), "scale": np.full(2, scale, np.float32)}
        wrong = identity(2, network.normaliser.name).replace(**moments)
        atomic.write_arrays(beside / "network.npz", trees.to_arrays(network.replace(normaliser=wrong)))

    workfolder.create(out, config, fill)
    return out


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run of two rounds on the misspecified support, adapted by EDGE."""
    out = tmp_path_factory.mktemp("diagnose") / "run"
    return make(out, "misspecified", Edge(), 2)


@pytest.fixture
def pretend(monkeypatch):
    """Let networks say the exact posterior, wider by a factor and off by a number of deviations."""

    def density(estimator, network, x):
        wrong, exact = network.normaliser, gaussian_linear.posterior(x)
        offset = wrong.mean * exact.marginal_scales * jnp.array([1.0, -1.0])
        return exact.replace(means=exact.means + offset, scale_tril=wrong.scale[0] * exact.scale_tril)

    monkeypatch.setattr(MixtureNetwork, "density", density)


@pytest.fixture(autouse=True)
def brief(monkeypatch):
    """Classifiers that are trained for a few passes: programs that were not optimised are slow."""
    monkeypatch.setattr(sys.modules["jaxlfi.diagnostics.c2st"], "MAX_EPOCHS", 30)


def results(out) -> dict[str, dict]:
    return {check["name"]: check for check in json.loads((out / "diagnostics.json").read_text())["checks"]}


NAMES = ("rank of first", "rank of second", "coverage of densest regions", "coverage from random points (TARP)")
CASES = {
    "exact": ((1.0,), ("ok", "ok", "ok", "ok"), ("calibrated", "calibrated")),
    "narrow": ((0.4,), (OVER, OVER, OVER, OVER), ("too narrow", "too narrow")),
    "wide": ((2.5,), (UNDER, UNDER, UNDER, UNDER), ("too wide", "too wide")),
    "shifted": (
        (1.0, 1.2),
        ("miscalibrated: biased high", "miscalibrated: biased low", OVER, None),
        ("biased high", "biased low"),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_posteriors_are_called_what_they_are(case, pretend, tmp_path, capsys):
    how, expected, widths = CASES[case]
    folder = make(tmp_path / "one", "ok", Fixed(), 1, *how)
    assert command("diagnose", folder, "--draws", 60, "--no-figures") == 0
    found = results(folder / "diagnostics")
    for name, verdict in zip(NAMES, expected, strict=True):
        assert verdict is None or found[name]["verdict"] == verdict, name
        assert verdict is None or (found[name]["p_value"] > 0.01) == (verdict == "ok")
    assert (found["final support"]["numbers"]["truths_inside"], found["final support"]["verdict"]) == (100, "")
    # The run's own posterior is exact, whatever is pretended of others.
    assert found["posterior predictive"]["verdict"] == "ok"
    posterior, box = json.loads((folder / "diagnostics" / "diagnostics.json").read_text())["widths"]
    assert (posterior["reference"], box["reference"]) == ("posterior", "ok")
    for reference in (posterior, box):
        assert [row["name"] for row in reference["found"]] == ["first", "second", "all together"]
        for row, verdict in zip(reference["found"], widths, strict=False):
            assert verdict in row["verdict"] or (case, row["verdict"]) == ("exact", "undecided"), row["sentence"]
            assert row["sentence"].startswith(f"{row['name']}: {row['verdict']}")
            factor = row["factor"]
            if case in ("exact", "narrow"):  # off by what was pretended; the box cuts wide ones off
                assert factor["low"] / 1.2 < 1 / how[0] < 1.2 * factor["high"], row["sentence"]
    output = capsys.readouterr().out
    assert (
        f"  {posterior['found'][0]['sentence']}" in output
        and "At this run's posterior (100 truths drawn from it)" in output
    )
    assert "over-confident" in output if case == "narrow" else "rank of first" in output
    assert json.loads((folder / "diagnostics" / "diagnostics.json").read_text())["way"] == "amortised"
    arrays = atomic.read_arrays(folder / "diagnostics" / "diagnostics.npz")
    assert arrays["draws"].shape == (100, 60, 2) and arrays["ranks"].shape == (100, 2)
    # Truths at the posterior are the run's own draws: exact ones of its observation.
    exact, truths = gaussian_linear.posterior(X), arrays["posterior/theta"]
    np.testing.assert_allclose(truths.mean(0), exact.mean, atol=0.5 * exact.marginal_scales.max())
    assert np.all(truths.std(0) < 0.5 * arrays["theta"].std(0)) and np.asarray(BOX.contains(truths)).all()
    assert np.asarray(BOX.contains(arrays["draws"])).all()
    assert not (folder / "diagnostics" / "figures").exists()


@pytest.fixture(scope="module")
def repeated(folder):
    """Diagnostics of a run of two rounds, in two chunks of runs a reference, with pictures and reference samples."""
    out, reference = folder.parent / "repeated", folder.parent / "reference.csv"
    draws = np.asarray(gaussian_linear.posterior(X).sample(jax.random.key(5), 3000))
    draws = draws[np.asarray(gaussian().supports["misspecified"].contains(draws))][:200]
    rows = [f"{second},{first}" for first, second in draws]  # columns in another order
    reference.write_text("\n".join(["second,first", *rows]))
    asked = ("--truths", 20, "--draws", 20, "--against", reference, "--out", out)
    assert command("diagnose", folder, *asked) == 0
    return out


@pytest.mark.slow
def test_a_run_of_several_rounds_is_repeated_for_each_truth(repeated, folder):
    begun, found = (json.loads((repeated / f"{name}.json").read_text()) for name in ("plan", "diagnostics"))
    assert found["way"] == "repeated" and begun["chunk_length"] == 10 and found["versions"]["jax"]
    assert [one["name"] for one in found["references"]] == ["posterior", "ok"]
    assert found["run"]["support"]["name"] == "misspecified"
    arrays = atomic.read_arrays(repeated / "diagnostics.npz")
    theta = arrays["theta"]
    # Truths are drawn over the task's first support, also where the run's own does not reach.
    assert np.asarray(BOX.contains(theta)).all() and 4 <= np.sum(theta[:, 0] > 0) <= 16
    assert len(np.unique(theta[:, 0])) == 20
    # Each has a posterior of its own, on a support that was adapted to it.
    assert np.all(arrays["support_low"][:, 0] <= -3) and len(np.unique(arrays["support_high"][:, 0])) > 2
    inside = (arrays["draws"] >= arrays["support_low"][:, None]) & (arrays["draws"] <= arrays["support_high"][:, None])
    assert inside.all() and np.isfinite(arrays["log_prob"]).all()
    held = np.all((theta >= arrays["support_low"]) & (theta <= arrays["support_high"]), axis=1)
    np.testing.assert_array_equal(np.isfinite(arrays["truth_log_prob"]), held)
    # What is inferred follows the truth.
    assert np.corrcoef(arrays["draws"].mean(1)[:, 1], theta[:, 1])[0, 1] > 0.7


@pytest.mark.slow
def test_pictures_and_reference_samples(repeated):
    """The classifier cannot tell the run's posterior from its reference, unless columns were mistaken."""
    assert {path.name for path in (repeated / "figures").iterdir()} == {
        "widths.png", "ranks.png", "coverage.png", "tarp.png", "predictive.png",
    }  # fmt: skip
    check = results(repeated)["classifier, reference.csv"]
    assert check["numbers"] == {"accuracy": pytest.approx(0.5, abs=0.15), "rows": 200}


@pytest.mark.slow
def test_pictures_show_the_saved_arrays(repeated):
    arrays = atomic.read_arrays(repeated / "diagnostics.npz")
    line = lambda axes, name: next(line for line in axes.lines if line.get_gid() == name)
    with style.context():
        figure = style.new_figure(3.5, 3.5)
        calibration.draw_ranks(figure, arrays)
        above, below = figure.axes[1], figure.axes[3]  # the second parameter
        stairs = next(patch for patch in above.patches if patch.get_gid() == "count")
        upper = np.sum(arrays["ranks"][:, 1] >= 10)  # 21 ranks in two bins: 0 to 9, and 10 to 20
        np.testing.assert_array_equal(arrays["bin_edges"], [0, 10, 21])
        np.testing.assert_array_equal(stairs.get_data().values, [20 - upper, upper])
        fraction = line(below, "difference").get_ydata()[1:-1] + arrays["level"]
        np.testing.assert_allclose(fraction, [np.mean(arrays["ranks"][:, 1] < k) for k in range(1, 21)])
        for draw, rank in ((calibration.draw_coverage, "density_ranks"), (calibration.draw_tarp, "distance_ranks")):
            figure = style.new_figure(3.5, 3.9)
            draw(figure, arrays)
            fraction = line(figure.axes[0], "fraction").get_ydata()[1:-1]
            np.testing.assert_allclose(fraction, [np.mean(arrays[rank] < k) for k in range(1, 21)])
        figure = style.new_figure(7.0, 2.3)
        checks.draw(figure, arrays)
        assert line(figure.axes[1], "observed").get_xdata()[0] == arrays["observed_distance"]
        middle = np.median(arrays["predictive_x"], axis=0)
        observed = line(figure.axes[0], "observed").get_ydata()
        np.testing.assert_array_equal(np.sign(observed), np.sign(X - middle))


@pytest.mark.slow
def test_the_page_says_first_what_the_widths_are_worth(repeated):
    text, found = (repeated / "report.html").read_text(), json.loads((repeated / "diagnostics.json").read_text())
    assert text.count("data:image/png;base64,") == 5
    for reference in found["widths"]:
        for row in reference["found"]:
            assert html.escape(row["sentence"]) in text
            assert text.index(html.escape(row["sentence"])) < text.index("<h2>")
    assert "rank of first" in text and "classifier, reference.csv" in text
    (repeated.parent / "empty").mkdir()
    shutil.copy(repeated / "diagnostics.npz", repeated.parent / "empty")
    with pytest.raises(ValueError, match=r"diagnostics\.json: expected the results of diagnostics"):
        checks.report(repeated.parent / "empty")


@pytest.mark.slow
def test_the_picture_of_the_widths_shows_the_saved_arrays(repeated):
    arrays = atomic.read_arrays(repeated / "diagnostics.npz")
    with style.context():
        figure = style.new_figure(7.0, 3.0)
        intervals.draw(figure, arrays)
    left, right = figure.axes
    line = lambda axes, name: next(line for line in axes.lines if line.get_gid() == name)
    for r, name in enumerate(("posterior/", "")):
        theta, draws = arrays[f"{name}theta"], arrays[f"{name}draws"]
        low, high = np.quantile(draws, [0.05, 0.95], axis=1, method="weibull")
        held = np.mean((theta >= low) & (theta <= high), axis=0)
        np.testing.assert_allclose(line(left, f"held-{r}-1").get_xdata()[:2], held)
        np.testing.assert_allclose(line(right, f"factor-{r}").get_xdata(), arrays["widths_factor"][r, :, 0])
    assert [text.get_text() for text in figure.legends[0].get_texts()] == list(arrays["widths_reference"])


@pytest.mark.slow
def test_the_page_of_the_run_says_what_was_measured(repeated, folder, tmp_path):
    """It reports the diagnostics in its own folder; before those, that nothing was measured."""
    copy = tmp_path / "run"
    shutil.copytree(folder, copy)
    config = json.loads((copy / "config.json").read_text())
    assert config["widths"].startswith("not measured; nothing corrects")
    line = lambda: page._widths(collection(copy, config))
    assert "not measured" in line() and "jaxlfi diagnose" in line()
    assert "87" not in page._widths(collection(copy, config | {"widths": "about 87 % of the right ones"}))
    shutil.copytree(repeated, copy / "diagnostics")
    found = json.loads((repeated / "diagnostics.json").read_text())
    assert html.escape(found["line"]) in line() and "(measured at this run's posterior with 20" in found["line"]
    (copy / "diagnostics" / "diagnostics.json").write_text("{")
    assert "not measured" in line()


def collection(folder, config):
    """As much of a run's folder as that line needs."""
    history = History(
        **{field.name: None for field in dataclasses.fields(History)} | {"folder": folder, "config": config}
    )
    return Collection(folder, config, {"ok": [history]}, (), ())


@pytest.mark.slow
def test_chunks_are_picked_up_to_the_same_arrays(repeated, folder, tmp_path):
    out = tmp_path / "again"
    shutil.copytree(repeated, out)
    first, second = out / "box" / "chunks" / "000.npz", out / "box" / "chunks" / "001.npz"
    second.unlink()
    before = first.stat().st_mtime_ns
    (out / "diagnostics.npz").unlink()
    assert command("diagnose", folder, "--truths", 20, "--draws", 20, "--no-figures", "--out", out) == 0
    assert first.stat().st_mtime_ns == before
    whole, again = (atomic.read_arrays(path / "diagnostics.npz") for path in (repeated, out))
    assert whole.keys() == again.keys()
    for name in whole:
        np.testing.assert_array_equal(whole[name], again[name], err_msg=name)
    left = {name: check for name, check in results(repeated).items() if "reference" not in name}
    found = results(out)
    # The classifier is trained anew, which amplifies the last bits of a program that was compiled again.
    trained = "classifier, draws or truths"
    assert found.pop(trained)["verdict"] == left.pop(trained)["verdict"]
    assert found == left


def refused(capsys, *arguments) -> str:
    capsys.readouterr()
    assert command("diagnose", *arguments) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1 and "error: " in message
    return message


@pytest.mark.slow
def test_other_settings_need_another_folder(repeated, folder, tmp_path, capsys):
    asked = (folder, "--no-figures", "--out", repeated, "--draws", 20)
    assert "another truths: choose another folder with --out" in refused(capsys, *asked, "--truths", 21)
    assert "another reference" in refused(capsys, *asked, "--truths", 20, "--reference", "posterior,broad")
    out = tmp_path / "out"
    shutil.copytree(repeated, out)
    (out / "box" / "chunks" / "001.npz").write_bytes(b"cut")
    asked = (folder, "--no-figures", "--draws", 20, "--truths", 20, "--out", out)
    assert "001.npz: expected a complete .npz" in refused(capsys, *asked)
    (out / "plan.json").write_text("{")
    assert "plan.json: expected a plan" in refused(capsys, *asked)
    (out / "plan.json").unlink()
    assert "expected a new or empty folder" in refused(capsys, *asked)


def test_bad_input_is_one_line(folder, tmp_path, capsys):
    wrong = {
        "columns.csv": "first,third\n1,2\n",
        "few.csv": "first,second\n1,2\n",
        "nan.csv": "\n".join(["first,second", *["nan,1"] * 30]),
        "text.csv": "first,second\na,b\n",
    }
    for name, text in wrong.items():
        (tmp_path / name).write_text(text)
    np.savez(tmp_path / "shape.npz", theta=np.zeros((30, 3)))
    np.savez(tmp_path / "other.npz", x=np.zeros((30, 2)))
    for given, expected in (
        (["--truths", 19], "truths: expected at least 20, got 19"),
        (["--draws", 0], "draws: expected at least 20, got 0"),
        (["--seed", -1], "seed: expected at least 0"),
        (["--reference", "x"], "reference: expected 'posterior', a support (broad, misspecified, ok), or one of each"),
        (["--reference", "ok,broad"], "or one of each with a comma between, got 'ok,broad'"),
        (["--reference", "posterior,posterior"], "got 'posterior,posterior'"),
        (["--reference", ""], "got ''"),
        (["--against", tmp_path / "none.csv"], "against: expected a readable file"),
        (["--against", tmp_path / "columns.csv"], "expected the columns first, second, got first, third"),
        (["--against", tmp_path / "few.csv"], "expected at least 20 rows of finite numbers"),
        (["--against", tmp_path / "nan.csv"], "expected at least 20 rows of finite numbers"),
        (["--against", tmp_path / "text.csv"], "could not convert"),
        (["--against", tmp_path / "shape.npz"], "shape [n, 2], got float64 [30, 3]"),
        (["--against", tmp_path / "other.npz"], "against: expected a readable file"),
    ):
        assert expected in refused(capsys, folder, *given)
    assert not (folder / "diagnostics").exists()


@pytest.mark.parametrize(
    "kind", ["none", "foreign", "unfinished", "runs", "compare", "grid", "changed", "older", "made in Python"]
)
def test_folders_that_cannot_be_diagnosed(kind, folder, tmp_path, capsys):
    if kind == "none":
        assert "not a folder" in refused(capsys, tmp_path / "nothing")
        return
    config = json.loads((folder / "config.json").read_text())
    changes, expected = {
        "foreign": ({"format": "other"}, "not of jaxlfi"),
        "unfinished": ({"status": "running"}, "expected a finished run"),
        "runs": ({"format": formats.RUNS, "runs": [{"folder": "seed_003"}]}, "one/seed_003"),
        "compare": ({"format": formats.COMPARE, "runs": [{"folder": "ok/seed_000"}]}, "one/ok/seed_000"),
        "grid": ({"format": formats.GRID}, "got a grid's"),
        "changed": ({"parameters": ["other", "second"]}, "expected the task as it was when the run was made"),
        "older": ({"version": 1}, "expected jaxlfi-run of version 4, got version 1, which jaxlfi"),
        "made in Python": ({"task": None}, "give --task MODULE:TASK"),
    }[kind]
    copy = tmp_path / "one"
    shutil.copytree(folder, copy)
    atomic.write_json(copy / "config.json", config | changes)
    assert expected in refused(capsys, copy)
    assert not (copy / "diagnostics").exists()


# -------------------------------------------------------------------------------------------------------- truths


def with_task(folder, **changes) -> jaxlfi.Run:
    """The run, of a task that differs."""
    return jaxlfi.load(folder).replace(task=dataclasses.replace(gaussian(), **changes))


def test_truths_that_fail_are_drawn_again_and_counted(folder):
    def simulate(key, theta):
        return gaussian_linear.simulate(key, theta), theta[0] < 0

    truths = study.draw_truths(with_task(folder, simulate=simulate), CalibrationPlan("ok", truths=200, seed=1))
    assert np.all(truths["theta"][:, 0] < 0) and np.all(truths["theta"][:, 0] > -3)
    residual = truths["x"] - truths["theta"] @ gaussian_linear.MIXING.T
    np.testing.assert_allclose(residual.std(0), gaussian_linear.NOISE, rtol=0.2)
    np.testing.assert_array_equal(truths["observed"], truths["x"])
    # Every success takes two tries on average.
    assert truths["failed"][1] == 0 and 140 < truths["failed"][0] < 270
    never = with_task(folder, simulate=lambda key, theta: (theta, theta[0] > 9))
    with pytest.raises(SimulatorError, match="got none in 16 tries for 20 of 20"):
        study.draw_truths(never, CalibrationPlan("ok", truths=20))


def test_reference_samples_are_read_in_natural_units(tmp_path):
    task = dataclasses.replace(
        gaussian(), supports={"ok": Support([0.1, 0.1], [9.0, 9.0])}, feasible=Support([0.1, 0.1], [9.0, 9.0]),
        truth=None, log=("second",),
    )  # fmt: skip
    theta = np.random.default_rng(0).uniform(0.5, 2.0, (30, 2))
    np.savez(tmp_path / "theta.npz", theta=theta)
    read = study.read_reference(tmp_path / "theta.npz", task)
    np.testing.assert_allclose(read, np.stack([theta[:, 0], np.log(theta[:, 1])], axis=1), rtol=1e-5)
    np.savez(tmp_path / "negative.npz", theta=theta * np.array([1.0, -1.0]))
    with pytest.raises(ValueError, match="positive ones of second"):
        study.read_reference(tmp_path / "negative.npz", task)


def on_host():
    """The Gaussian task with a host simulator."""

    def simulate(rng, theta):
        return theta @ gaussian_linear.MIXING.T + gaussian_linear.NOISE * rng.normal(size=theta.shape)

    return dataclasses.replace(gaussian(), simulate=jaxlfi.HostSimulator(simulate))


@pytest.mark.slow
def test_a_run_of_a_host_simulator_is_repeated(folder, tmp_path):
    out = tmp_path / "out"
    asked = (
        "--task",
        "tests.studies.test_calibration_study:on_host",
        "--truths",
        20,
        "--draws",
        20,
        "--reference",
        "ok",
    )
    assert command("diagnose", folder, *asked, "--no-figures", "--out", out) == 0
    assert json.loads((out / "diagnostics.json").read_text())["way"] == "repeated"
    arrays = atomic.read_arrays(out / "diagnostics.npz")
    residual = arrays["x"] - arrays["theta"] @ gaussian_linear.MIXING.T
    np.testing.assert_allclose(residual.std(0), gaussian_linear.NOISE, rtol=0.6)
    assert np.corrcoef(arrays["draws"].mean(1)[:, 1], arrays["theta"][:, 1])[0, 1] > 0.7


@pytest.mark.slow
def test_at_the_posterior_alone_only_what_holds_there_is_asked(folder, tmp_path, capsys):
    """Ranks and the classifier compare truths with draws under the prior, which these truths are not from."""
    out = tmp_path / "out"
    asked = ("--reference", "posterior", "--truths", 20, "--draws", 20, "--no-figures", "--out", out)
    assert command("diagnose", folder, *asked) == 0
    assert list(results(out)) == ["posterior predictive"]
    (widths,) = json.loads((out / "diagnostics.json").read_text())["widths"]
    # Two lines say that 20 truths do not tell, or what even they show; none that intervals are calibrated.
    assert "calibrated" not in {row["verdict"] for row in widths["found"][:2]}
    assert "At this run's posterior (20 truths drawn from it)" in capsys.readouterr().out
    arrays = atomic.read_arrays(out / "diagnostics.npz")
    assert "ranks" not in arrays and arrays["widths_held"].shape == (1, 2, 2, 3)
    # Each truth is the run's draw, and its posterior another run's, from its simulation alone.
    assert len(np.unique(arrays["posterior/theta"][:, 0])) == 20
    assert len(np.unique(arrays["posterior/draws"][:, 0, 0])) == 20


def test_a_posterior_where_simulations_fail_is_refused_in_one_line(folder, tmp_path, capsys):
    out = tmp_path / "out"
    asked = ("--task", "tests.studies.test_calibration_study:failing", "--truths", 20, "--draws", 20, "--out", out)
    message = refused(capsys, folder, *asked)
    assert "expected a valid simulation of each truth drawn from the run's posterior, got none in 16 tries" in message
    assert not out.exists()  # another reference can be asked for


def failing():
    """The Gaussian task, whose simulations all fail."""
    return dataclasses.replace(gaussian(), simulate=lambda key, theta: (theta, theta[0] > 99))


def test_chunks_are_divided_over_as_many_devices_as_they_were_begun_with(tmp_path, monkeypatch):
    (tmp_path / "diagnostics").mkdir()
    atomic.write_json(tmp_path / "diagnostics" / "plan.json", {"devices": 7})
    monkeypatch.setenv("XLA_FLAGS", "")
    cli.prepare_jax(cli.parser().parse_args(["diagnose", str(tmp_path), "--no-cache"]))
    assert os.environ["XLA_FLAGS"] == "--xla_force_host_platform_device_count=7"


@pytest.mark.parametrize("purpose", [plan.TRUTHS, plan.RUNS, plan.DRAWS])
def test_keys_are_not_those_of_a_run_of_the_same_seed(purpose):
    own = jax.random.key_data(CalibrationPlan("ok", seed=0).key(purpose))
    for key in jax.tree.leaves(run_keys(jax.random.key(0))):
        assert not np.array_equal(own, jax.random.key_data(key))


def test_the_cost_is_said_before_anything_is_made(folder):
    run = study.read_run(folder)
    plans = study.plans_of("posterior,ok", run.task, 30, 20, 0)
    assert cost(run, plans) == "cost: the run again for each of 60 truths, up to 3060 simulations in all."
    timed = run.replace(history=run.history | {"seconds": np.array([1.0, 0.5])})
    assert cost(timed, plans).endswith(" in all. One run took 1.5 s; side by side each takes less.")
    once = run.replace(settings=run.settings.replace(rounds=1))
    assert cost(once, plans) == "cost: 60 simulations, and the run's network conditioned on each"
