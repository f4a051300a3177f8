"""The comparison with other libraries: its cases, measures, rows and tables, without any of those libraries."""

import csv
import importlib.abc
import sys
import time

import jax
import numpy as np
import pytest
from scipy import stats

from experiments.sota import __main__ as program
from experiments.sota import measures, ours, rows
from experiments.sota.cases import SETTINGS, Case, Simulator, case_of
from jaxlfi import Support, Task


def half_fails(key, theta):
    """A noisy sum, which fails where the first parameter is negative."""
    return (theta.sum() + 0.01 * jax.random.normal(key))[None], theta[0] >= 0


@pytest.fixture(scope="module")
def task() -> Task:
    box = Support([-1.0, -1.0], [1.0, 1.0])
    return Task(half_fails, name="half", names=("a", "b"), supports={"ok": box}, feasible=box, truth=[0.2, 0.3])


def found(draws, log_prob=None, **more) -> measures.Found:
    return measures.Found(draws, log_prob, 1.25, 0.5, 1000, 7, **more)


# ------------------------------------------------------------------------------------------------------- cases


def test_failed_simulations_are_nan_and_count(task, key):
    simulator = Simulator(task, key)
    theta = np.array([[0.5, 0.1], [-0.5, 0.1], [0.9, -0.4], [-0.1, 0.0]], np.float32)
    simulator.compile(theta)
    assert (simulator.simulated, simulator.failed) == (0, 0)
    first, second = simulator(theta), simulator(theta)
    assert first.shape == (4, 1) and first.dtype == np.float32
    np.testing.assert_array_equal(np.isnan(first[:, 0]), theta[:, 0] < 0)
    np.testing.assert_allclose(first[[0, 2], 0], theta[[0, 2]].sum(axis=1), atol=0.06)
    assert not np.array_equal(first[[0, 2]], second[[0, 2]])  # each batch has noise of its own
    assert (simulator.simulated, simulator.failed) == (8, 4)


@pytest.mark.slow
def test_cases_are_those_of_the_benchmark():
    first, fourth = case_of("gaussian_linear", 0), case_of("gaussian_linear", 3)
    np.testing.assert_array_equal(first.x, fourth.x)  # three published observations, repeated
    assert first.truth is None and first.reference.shape == (10_000, 10)
    np.testing.assert_allclose(first.reference.mean(axis=0), first.x / 2, atol=0.02)
    assert not np.array_equal(first.x, case_of("gaussian_linear", 1).x)
    made = case_of("gaussian_mixture", 3)
    assert np.linalg.norm(made.x - made.truth) < 5 and np.linalg.norm(made.reference.mean(axis=0) - made.x) < 1
    wrong = case_of("lotka_volterra-misspecified", 1)
    right = case_of("lotka_volterra", 1)
    np.testing.assert_array_equal(wrong.x, right.x)
    inside = lambda case: (case.truth >= case.box.low) & (case.truth <= case.box.high)
    assert np.all(inside(right)) and np.asarray(inside(wrong)).tolist() == [False, False, True, True]


# ---------------------------------------------------------------------------------------------------- measures


def test_measures_against_closed_forms(task):
    """Normal draws about the truth: the summed error is 2 E|N(0, s)|, and uniform ranks hold it nine times in ten."""
    quantiles = stats.norm.ppf((np.arange(1000) + 0.5) / 1000)
    draws = np.stack([0.2 + 0.1 * quantiles, 0.3 + 0.3 * quantiles], axis=1)
    case = Case(task, task.support("ok"), 0, np.zeros(1), np.array([0.2, 0.3]), None)
    np.testing.assert_array_equal(measures.points(case), [[0.2, 0.3]])
    row = measures.judged(case, found(draws, np.array([-np.inf])))
    assert float(row["error"]) == pytest.approx((0.1 + 0.3) * np.sqrt(2 / np.pi), abs=1e-3)
    assert row["ranks"] == "500 500" and row["inside"] == "2" and row["c2st"] == ""
    assert float(row["log_prob"]) == measures.FLOOR
    assert measures.judged(case, found(draws))["log_prob"] == ""
    at = lambda rank: measures.inside(np.array([rank]), 1000)
    assert [at(49), at(50), at(950), at(951)] == [0, 1, 1, 0]
    assert sum(map(at, range(1001))) / 1001 == pytest.approx(0.9, abs=1e-3)


@pytest.mark.slow
def test_the_classifier_judges_draws_that_densities_are_not_asked_for(task):
    """Where the exact posterior is known, densities are of other draws of it than the classifier sees."""
    rng = np.random.default_rng(0)
    reference = np.concatenate([rng.normal(0, 1, (1000, 1)), rng.normal(4, 1, (1000, 1))])
    case = Case(task, task.support("ok"), 0, np.zeros(1), None, reference)
    np.testing.assert_array_equal(measures.points(case), reference[:1000])
    row = measures.judged(case, found(rng.normal(6, 1, (1000, 1)), np.full(1000, -2.0)))
    # The best classifier of two unit normals at a distance of 2 is right in Phi(1) of the cases.
    assert float(row["c2st"]) == pytest.approx(stats.norm.cdf(1), abs=0.04)
    assert (row["log_prob"], row["error"], row["ranks"]) == ("-2.0000", "", "")


# ------------------------------------------------------------------------------------------- rows and tables


def row(setting, method, seed, simulations="1000", **values) -> rows.Row:
    identity = {"setting": setting, "method": method, "simulations": simulations, "seed": str(seed)}
    return dict.fromkeys(rows.COLUMNS, "") | identity | values


def test_rows_are_kept_one_by_one_and_half_a_line_is_none(tmp_path):
    path = tmp_path / "new" / "results.csv"
    assert rows.read(path) == []
    for seed in range(2):
        rows.append(path, row("mg1", "npe", seed, note="a, b"))
    assert [one["seed"] for one in rows.read(path)] == ["0", "1"] and rows.read(path)[0]["note"] == "a, b"
    with path.open("a") as file:
        file.write("mg1,npe,10")
    assert len(rows.read(path)) == 2
    rows.append(path, row("mg1", "npe", 2))
    assert [one["seed"] for one in rows.read(path)] == ["0", "1", "2"]
    wanted = program.wanted(["mg1", "two_moons"], ["npe"], [1000], range(2))
    assert [one["setting"] for one in rows.missing(wanted, rows.read(path))] == ["two_moons", "two_moons"]


def test_tables_have_means_deviations_counts_and_the_best():
    kept = [
        *(row("two_moons", "npe", seed, c2st=str(value), seconds="2") for seed, value in enumerate((0.6, 0.8))),
        *(row("two_moons", "apt", seed, c2st="0.65", seconds="4") for seed in range(1)),
        row("two_moons", "sbi-apt", 0, note="TimeoutError: gave up"),
        row("mg1", "npe", 0, error="3.0", ranks="1 2 3", inside="2", log_prob="-1"),
        row("mg1", "apt", 0, error="1.5", ranks="1 2 3", inside="1", log_prob="-4"),
        row("mg1", "npe", 0, simulations="10000", error="0.25"),
        row("mg1", "npe", 1, simulations="10000", note="TimeoutError: gave up"),
        row("two_moons", "snle", 0, c2st="0.7", seconds="9"),
    ]
    text = rows.tables(kept, ["two_moons", "mg1", "gaussian_linear"], ["npe", "apt", "sbi-apt", "snle"])
    first = [line for line in text.splitlines() if line.startswith("|")]
    assert first[:4] == [
        "| method | `two_moons` | `mg1` |",
        "|---|---|---|",
        "| `npe` | 0.70 ± 0.14 (2) | 3.00 (1) |",
        "| `apt` | **0.65** (1) | **1.50** (1) |",
    ]
    assert first[4] == "| `sbi-apt` | nothing (0 of 1) |  |"
    assert "nothing (0 of 1)" not in "".join(line for line in first if "snle" in line)  # which has no density
    assert "| `npe` | **-1.00** (1) |" in first and "| `apt` | 0.33 (1) |" in first and "| `npe` | 2 ± 0 (2) |" in first
    assert text.index("1,000 simulations") < text.index("10,000 simulations")
    assert first[-1] == "| `npe` | **0.25** (1 of 2) |"


# --------------------------------------------------------------------------------------------------- the program


def test_a_heuristic_is_for_the_wrong_support():
    every = program.wanted(list(SETTINGS), ["bayessim", "bayessim+edge"], [1000], range(1))
    adapted = [one["setting"] for one in every if one["method"] == "bayessim+edge"]
    assert adapted == ["lotka_volterra-misspecified"] and len(every) == len(SETTINGS) + 1


def test_budgets_count_failures():
    for method in ours.NAMES:
        settings = ours.settings_of(method, 1000)
        assert settings.rounds * settings.simulations_per_round == 1000
        assert settings.simulation_budget == settings.simulations_per_round


class Absent(importlib.abc.MetaPathFinder):
    """Some packages, as if they were not installed."""

    def find_spec(self, name, path, target=None):
        if name.partition(".")[0] in ("torch", "sbi", "bayesflow"):
            raise ModuleNotFoundError(f"No module named {name!r}")
        return


@pytest.mark.parametrize("method", ["sbi-npe", "bayesflow-npe"])
def test_a_library_that_is_not_there_is_named_with_what_installs_it(method, monkeypatch, tmp_path):
    packages = ("torch", "sbi", "bayesflow", "experiments.sota.sbi_methods", "experiments.sota.bayesflow_methods")
    for name in [name for name in sys.modules if name.startswith(packages)]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "meta_path", [Absent(), *sys.meta_path])
    monkeypatch.setattr(sys, "argv", ["sota", "--methods", method, "--out", str(tmp_path)])
    monkeypatch.setenv("KERAS_BACKEND", "jax")
    with pytest.raises(SystemExit, match=r"pip install -e '.\[bench\]'") as stopped:
        program.main()
    assert method in str(stopped.value) and "\n" not in str(stopped.value)
    assert not list(tmp_path.iterdir())


def test_a_case_that_is_there_is_not_run_again(monkeypatch, tmp_path, capsys):
    """Two seeds, then a third; a library that fails or takes too long leaves a row that says so."""
    calls = []

    def infer(method, case, simulations):
        calls.append((method, case.seed, simulations))
        if method == "sbi-npe":
            raise RuntimeError("no acceptance\nat all")
        if method == "sbi-apt":
            time.sleep(5)
        return found(np.tile(case.truth, (measures.DRAWS, 1)), note="as usual")

    monkeypatch.setattr(program, "inference", lambda method: infer)

    def run(*arguments):
        names = ["--settings", "mg1", "--simulations", "1000", "--limit", "1", "--out", str(tmp_path)]
        monkeypatch.setattr(sys, "argv", ["sota", *names, *arguments])
        program.main()
        with (tmp_path / "results.csv").open(newline="") as file:
            return list(csv.DictReader(file))

    run("--methods", "npe", "sbi-npe", "sbi-apt", "--seeds", "1")
    kept = run("--methods", "npe", "--seeds", "2")
    run("--methods", "npe", "--first-seed", "1", "--seeds", "1")
    assert calls == [("npe", 0, 1000), ("sbi-npe", 0, 1000), ("sbi-apt", 0, 1000), ("npe", 1, 1000)]
    assert [one["note"] for one in kept] == [
        "as usual",
        "RuntimeError: no acceptance",
        "TimeoutError: gave up after 1 s",
        "as usual",
    ]
    assert [one["error"] for one in kept] == ["0.0000", "", "", "0.0000"]
    assert (kept[0]["seconds"], kept[0]["compile_seconds"], kept[0]["failed"]) == ("1.2", "0.5", "7")
    assert (tmp_path / "tables.md").read_text().strip() in capsys.readouterr().out
    assert (tmp_path / "config.json").exists()


def test_a_small_budget_is_refused(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["sota", "--simulations", "50"])
    with pytest.raises(SystemExit):
        program.main()
    assert "--simulations: expected at least 100" in capsys.readouterr().err


# ------------------------------------------------------------------------------------------- where sbi is installed


def test_the_prior_of_sbi_is_ours():
    """Uniform on the box in inference space, or the task's Gaussian; skipped without the `bench` extra."""
    pytest.importorskip("sbi")
    import torch

    from experiments.sota import sbi_methods

    linear, volterra = case_of("gaussian_linear", 0), case_of("lotka_volterra-misspecified", 0)
    theta = np.linspace(-0.5, 0.4, 10, dtype=np.float32)
    expected = stats.norm.logpdf(theta, scale=np.sqrt(0.1)).sum()
    assert sbi_methods._prior(linear).log_prob(torch.as_tensor(theta)).item() == pytest.approx(expected, rel=1e-4)
    box = sbi_methods._prior(volterra)
    inside, outside = np.asarray(volterra.box.centre), np.asarray(volterra.truth)
    width = np.asarray(volterra.box.width, float)
    assert box.log_prob(torch.as_tensor(inside)).item() == pytest.approx(-np.log(width).sum(), rel=1e-5)
    assert box.log_prob(torch.as_tensor(outside)).item() == -np.inf
