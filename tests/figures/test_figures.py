"""Figures: what is drawn is what was saved, for runs of all kinds, and nothing else is touched."""

import collections
import json
import sys
import warnings
from html.parser import HTMLParser
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib.colors import to_hex, to_rgb
from matplotlib.image import imread
from matplotlib.lines import Line2D
from scipy import stats

from jaxlfi.figures import (
    channels,
    curves,
    density,
    discrepancy,
    efficiency,
    load,
    losses,
    open_collection,
    page,
    pairs,
    polars,
    predictive,
    report,
    reporting,
    representative,
    samples,
    seeds,
    statistics,
    style,
    supports,
)
from jaxlfi.figures.history import robust_sd
from jaxlfi.io import formats
from jaxlfi.runs import folder as run_store

COMPARED = ("ok", "misspecified", "broad", "misspecified+edge", "misspecified+mode", "misspecified+centre")
TRUTH = np.log([0.01, 0.5, 1.0, 0.01])
NAMES = ("ln predator birth", "ln predator death", "ln prey birth", "ln prey death")
NATURAL = [name.removeprefix("ln ") for name in NAMES]
"""As pictures call them, whose axes are logarithmic."""


def write_run(
    folder: Path,
    *,
    configuration: str = "misspecified+edge",
    seed: int = 0,
    dim: int = 4,
    rounds: int = 6,
    simulation_budget: int = 30,
    components: int = 4,
    epochs: int = 12,
    records: int = 151,
    channels: tuple[str, ...] = ("predators X", "prey Y"),
    truth: bool = True,
    failures: float = 0.2,
) -> Path:
    """A run folder such as the command line writes, of an inference that never took place.

    Args:
        folder: to make.
        configuration: support and heuristic.
        seed: of the run.
        dim: parameters.
        rounds: rounds.
        simulation_budget: simulations of each round.
        components: of the mixture.
        epochs: of training.
        records: of a trajectory.
        channels: of a trajectory.
        truth: whether it is known.
        failures: fraction of the first round's simulations and samples that fail.
    """
    rng = np.random.default_rng([seed, *configuration.encode()])
    support, _, heuristic = configuration.partition("+")
    target = np.resize(TRUTH, dim)
    low, high = {"ok": (-5.0, 2.0), "broad": (-6.0, 4.0), "broadest": (-7.0, 7.0)}.get(support, (-5.0, 2.0))
    low, high = np.full(dim, low), np.full(dim, high)
    if support == "misspecified":
        low[0], high[1 % dim] = -3.0, -1.5 if dim > 1 else 2.0
    arrays: dict[str, list] = {}

    def keep(name: str, value: np.ndarray) -> None:
        arrays.setdefault(name, []).append(value)

    fraction = 1.0
    mean, scale = (low + high) / 2, (high - low) / 3
    for i in range(rounds):
        theta = (
            rng.uniform(low, high, (simulation_budget, dim))
            if i == 0
            else mean + scale * rng.normal(size=(simulation_budget, dim))
        )
        theta = theta.clip(low, high)
        fraction = failures * (0.7**i)
        failure = rng.binomial(1, fraction, simulation_budget) * rng.integers(1, 3, simulation_budget)
        kept = (failure == 0) & (np.cumsum(failure == 0) <= int(0.8 * simulation_budget))
        last = np.flatnonzero(kept)[-1] + 1 if kept.sum() == int(0.8 * simulation_budget) else simulation_budget
        counted = np.arange(simulation_budget) < last
        for name, value in {"theta": theta, "counted": counted, "kept": kept, "failure": failure}.items():
            keep(name, value)
        keep("proposal_low", low), keep("proposal_high", high)
        reach = target.clip(low, high)
        mean = reach + (mean - reach) * 0.55 + 0.06 * rng.normal(size=dim)
        scale = np.maximum(scale * 0.72, 0.12)
        low, high = low.copy(), high.copy()
        if heuristic == "edge":
            low = np.where(mean - 1.5 * scale < low, np.maximum(low - 0.35, -6.0), low)
            high = np.where(mean + 1.5 * scale > high, np.minimum(high + 0.35, 4.0), high)
        elif heuristic == "mode":
            low, high = (
                np.maximum(low - 0.1 * rng.random(dim), -6.0),
                np.minimum(high + 0.15 * rng.random(dim), 4.0),
            )
        elif heuristic == "centre":
            half = (high - low) / 2
            low, high = np.maximum(mean - half, -6.0), np.minimum(mean + half, 4.0)
        keep("support_low", low), keep("support_high", high)
        logits = rng.normal(size=components)
        logits[-1] = -np.inf if components > 1 else 0.0
        means = mean + 0.6 * scale * rng.normal(size=(components, dim))
        factor = np.tril(0.3 * rng.normal(size=(components, dim, dim))) * (1 - np.eye(dim)) + 0.9 * np.eye(dim)
        tril = scale[:, None] * factor
        keep("logits", logits), keep("means", means), keep("scale_tril", tril)
        steps = np.arange(1, epochs + 1)
        loss = -1.2 * i + 6 * np.exp(-4 * steps / epochs) + 0.1 * rng.normal(size=(2, epochs))
        keep("loss", loss)
        keep("chosen_epoch", np.full(2, epochs - 1))
        keep("mass_inside", np.float32(0.9))
        keep("validation_loss", loss + 0.6 + 0.8 * (steps / epochs) ** 2)
        draws = (mean + scale * rng.normal(size=(20, dim))).clip(low, high)
        keep("sample_theta", draws)
        keep("sample_theta_error", np.abs(draws - target) if truth else np.full((20, dim), np.nan))
        error = 0.4 + np.abs(draws - target).mean(-1) * rng.uniform(0.5, 1.0, 20)
        keep("sample_trajectory_error", np.where(rng.random(20) < fraction / 2, np.nan, error))
    stacked = {name: np.stack(values) for name, values in arrays.items()}
    counted, failure = stacked["counted"], stacked["failure"]
    stacked["attempted"] = counted.sum(1)
    stacked["succeeded"] = stacked["kept"].sum(1)
    stacked["failed"] = np.stack([(counted & (failure == code)).sum(1) for code in (1, 2)], -1)
    times = np.arange(records) * 0.2
    phase = np.arange(len(channels)) * 1.3

    def wave(shift: float) -> np.ndarray:
        return 120 * np.exp(1.1 * np.sin(0.75 * times[:, None] + phase + shift)) / (1 + phase)

    error = stacked["sample_theta_error"][-1].mean() if truth else 0.4
    predicted = np.stack([wave(0.5 * error * rng.normal()) * np.exp(0.15 * rng.normal()) for _ in range(20)])
    summaries = ("mean X", "mean Y", "log var X", "log var Y", "X with Y")
    x_of = lambda theta: theta[:, :1] * np.arange(1, 6) + theta[:, -1:] ** 2
    x = x_of(target[None])[0]
    final_x = x_of(draws) + 0.1 * rng.normal(size=(20, 5))
    final_x[np.isnan(stacked["sample_trajectory_error"][-1])] = np.nan
    folder.mkdir(parents=True)
    last = {name: stacked[name][-1] for name in ("logits", "means", "scale_tril", "support_low", "support_high")}
    many = (mean + scale * rng.normal(size=(1000, dim))).clip(low, high)
    np.savez(
        folder / "posterior.npz",
        **last,
        draws=np.exp(many),
        log=np.full(dim, True),
        parameters=np.array([f"parameter {d}" for d in range(dim)]),
    )
    dataset = [stacked["theta"][i][stacked["kept"][i]] for i in range(rounds)]
    np.savez(
        folder / "dataset.npz",
        theta=np.concatenate(dataset),
        x=np.concatenate([x_of(theta) for theta in dataset]),
        round=np.repeat(np.arange(rounds), [len(theta) for theta in dataset]),
    )
    np.savez(
        folder / "history.npz",
        **stacked,
        reasons=np.array(["too_many_events", "non_finite"]),
        seconds=rng.uniform(1, 2, rounds),
        final_trajectory=predicted,
        final_x=final_x,
    )
    names = np.array([NAMES[d % 4] + ("" if d < 4 else f" {d}") for d in range(dim)])
    np.savez(
        folder / "observation.npz",
        trajectory=wave(0.0) * rng.lognormal(0, 0.1, (records, len(channels))),
        x=x,
        summaries=np.array(summaries),
        record_label="month",
        truth=target if truth else np.full(dim, np.nan),
        names=names,
        channels=np.array(channels, dtype=str),
        times=times,
    )
    config = {
        "format": "jaxlfi-run",
        "task": "lotka_volterra",
        "names": names.tolist(),
        "units": ["1/time"] * dim,
        "configuration": None,
        "support": {"name": support, "low": stacked["proposal_low"][0].tolist()},
        "heuristic": {"name": heuristic or "none", "hyperparameters": {}},
        "preset": "quick",
        "seed": seed,
        "feasible_low": [-6.0] * dim,
        "feasible_high": [4.0] * dim,
        "command_line": "jaxlfi infer lotka_volterra --out <somewhere>",
        "versions": {"python": "3.11.7", "jax": "0.9.2"},
        "platform": {"system": "Linux", "cores": 2},
    }
    (folder / "config.json").write_text(json.dumps(config))
    return folder


def write_compare(folder: Path, configurations=COMPARED, count: int = 3, **options) -> Path:
    """A folder of several configurations with several seeds each, and its table."""
    rows = []
    for name in configurations:
        for seed in range(count):
            run = load(write_run(folder / name / f"seed_{seed:03d}", configuration=name, seed=seed, **options))
            errors = run.final_theta_error, run.final_trajectory_error
            row = name, seed, *errors, run.success_rate, run.seconds.sum()
            rows.append(dict(zip(run_store.TABLE_COLUMNS, row, strict=True)))
    config = {"format": "jaxlfi-compare", "task": "lotka_volterra", "preset": "quick"}
    config |= {"command_line": "jaxlfi compare lotka_volterra --preset quick --seeds 3"}
    (folder / "config.json").write_text(json.dumps(config))
    run_store.write_table(folder / "table.csv", rows)
    return folder


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """A comparison of six configurations with three seeds each."""
    return open_collection(write_compare(tmp_path_factory.mktemp("compare")))


def test_runs_that_never_took_place_have_names_of_the_format_alone(tmp_path):
    """Whatever else a picture is drawn from would not be in a user's folder."""
    made = write_run(tmp_path / "run")
    written = Path(__file__).parents[1] / "golden" / "formats" / str(formats.VERSION) / "run"
    names = lambda folder: {path.name: set(np.load(path)) for path in folder.glob("*.npz")}
    for file, arrays in names(made).items():
        assert arrays <= names(written)[file], file
    config = lambda folder: json.loads((folder / "config.json").read_text()).keys()
    assert config(made) - {"platform"} <= config(written)  # the kept folder says nothing of a machine


@pytest.fixture(autouse=True)
def untouched():
    """Every test leaves matplotlib's settings alone, keeps out of pyplot, and warns of nothing."""
    before = dict(matplotlib.rcParams)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield
    assert dict(matplotlib.rcParams) == before
    pyplot = sys.modules.get("matplotlib.pyplot")
    assert pyplot is None or not pyplot.get_fignums()


def drawn(draw, *arguments, width=style.TEXT_WIDTH, height=4.0, **options):
    """A figure after `draw`."""
    with style.context():
        figure = style.new_figure(width, height)
        draw(figure, *arguments, **options)
    return figure


def panel(figure, title):
    """The axes of a title."""
    return next(axes for axes in figure.axes if axes.get_title().replace("\n", " ").endswith(title))


def line(axes, label) -> Line2D:
    """The line of a label."""
    return next(artist for artist in axes.lines if artist.get_label() == label)


def marked(axes, gid):
    """What was drawn under a name."""
    return [artist for artist in axes.get_children() if artist.get_gid() == gid]


def points_of(image: Path) -> np.ndarray:
    """A png as [height, width, 4]."""
    return imread(image)


THIRTY = ("gripper x (m)", *(f"keypoint {i} {axis}" for i in range(14) for axis in "uv"), "action dx (m)")
"""As many channels as a whip has."""


def write_thirty(folder: Path) -> Path:
    """A run of thirty channels: the second hardly moves, to which all simulations are blind, the last not at all."""
    write_run(folder, records=16, channels=THIRTY)

    def still(arrays):
        arrays["trajectory"][:, 1] = 0.5 + 0.0007 * np.resize([-1, 1], 16)
        arrays["trajectory"][:, -1] = 0.0
        arrays["channel_noise"] = np.r_[0.0, 0.005, np.zeros(28)]

    def blind(arrays):
        arrays["final_trajectory"][..., 1] = 0.505
        arrays["final_trajectory"][..., -1] = 0.0

    change(folder, "observation.npz", still)
    change(folder, "history.npz", blind)
    return folder


def test_channels_are_in_units_of_noise_where_they_hardly_move(tmp_path):
    history = load(write_thirty(tmp_path / "run"))
    found = channels.errors(history)
    assert found.shape == (len(history.predictions), 30)
    np.testing.assert_allclose(found[:, 1], 1.0, rtol=0.02)  # and 7 in observed standard deviations
    moved = (history.predictions - history.observed)[..., 0]
    np.testing.assert_allclose(found[:, 0], np.sqrt(np.mean(moved**2, 1)) / history.observed[:, 0].std())


def test_channels_shows_each_seed_and_the_median_of_what_can_differ(tmp_path, compared):
    history = load(write_thirty(tmp_path / "run"))
    (axes,) = drawn(channels.draw, {"ok": [history]}).axes
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert labels == list(THIRTY[:-1])  # an action is that of the observation
    assert "sd" in axes.get_xlabel() and axes.get_xscale() == "log"
    dots, medians = marked(axes, "dots"), marked(axes, "median")
    for row in range(29):
        own = channels.errors(history)[:, row]
        np.testing.assert_allclose(dots[row].get_xdata(), own)
        assert medians[row].get_xdata()[0] == pytest.approx(np.median(own))
    (axes,) = drawn(channels.draw, compared.runs).axes
    expected = [channels.errors(h)[:, 0].mean() for h in compared.runs["ok"]]
    np.testing.assert_allclose(marked(axes, "dots")[0].get_xdata(), expected)


def test_pictures_are_no_higher_than_a_screen_and_their_axes_in_natural_units(tmp_path):
    """Checked at the report's resolution of 300 pixels per inch, with thirty channels."""
    collection = open_collection(write_thirty(tmp_path / "run"))
    for name, make in reporting.PICTURES.items():
        with style.context():
            if (made := make(collection)) is None:
                continue
        assert 300 * made[0].get_size_inches()[1] <= 3000, name
        for axes in made[0].axes:
            texts = [axes.get_xlabel(), axes.get_ylabel(), axes.get_title()]
            for text in texts:
                assert not text.startswith("ln ") and " ln " not in text and "ln(" not in text, (name, text)
            for text in texts[:2]:  # of parameters
                assert "[1/time]" in text or not ("bounds" in text or any(own in text for own in NATURAL)), (name, text)


# The mixture


@pytest.mark.parametrize("pair", [(0, 1), (2, 0), (3,)])
def test_marginal_density_is_scipys_and_integrates_to_one(pair):
    rng = np.random.default_rng(5)
    logits, means = rng.normal(size=3), rng.normal(size=(3, 4))
    tril = np.tril(0.3 * rng.normal(size=(3, 4, 4))) + 0.6 * np.eye(4)
    tril[:, range(4), range(4)] = np.abs(tril[:, range(4), range(4)]) + 0.2
    weight = density.weights(logits)
    mean, covariance = density.marginal(means, tril, pair)
    axis = np.linspace(-8, 8, 241)
    points = np.stack(np.meshgrid(*[axis] * len(pair)), -1)
    ours = density.density(points, weight, mean, covariance)
    full = tril @ np.swapaxes(tril, 1, 2)
    each = [stats.multivariate_normal(m[list(pair)], c[np.ix_(pair, pair)]) for m, c in zip(means, full, strict=True)]
    expected = sum(
        w * normal.pdf(points) for w, normal in zip(np.exp(logits) / np.exp(logits).sum(), each, strict=True)
    )
    np.testing.assert_allclose(ours, expected.reshape(ours.shape), rtol=1e-9, atol=1e-12)
    assert ours.sum() * (axis[1] - axis[0]) ** len(pair) == pytest.approx(1.0, abs=2e-3)


def test_absent_components_and_volumeless_ones_weigh_nothing():
    np.testing.assert_allclose(density.weights(np.array([0.0, -np.inf, 0.0])), [0.5, 0.0, 0.5])
    assert np.isnan(density.weights(np.full(2, -np.inf))).all()
    flat = density.density(np.zeros((1, 1)), np.ones(1), np.zeros((1, 1)), np.zeros((1, 1, 1)))
    assert flat == [0.0]


def test_grid_does_not_step_over_a_narrow_peak():
    mean, scale = np.array([0.1234]), np.array([0.003])
    grid = density.grid(-5, 5, mean, scale)
    assert np.all(np.diff(grid) > 0)
    assert grid[0] == -5
    assert grid[-1] == 5
    assert np.abs(grid - mean).min() < scale / 4


# Statistics that leave NaN out


def test_mean_and_sd_leave_nan_out():
    values = np.array([[1.0, np.nan, 3.0], [np.nan] * 3])
    np.testing.assert_allclose(statistics.mean(values, 1), [2.0, np.nan])
    np.testing.assert_allclose(statistics.sd(values, 1), [np.sqrt(2.0), np.nan])
    assert statistics.sd(np.array([4.0])) == 0
    assert statistics.median(np.array([np.nan, 1.0, 5.0])) == 3.0
    assert np.isnan(statistics.median(np.array([np.nan])))


# What the pictures draw


def test_samples_shows_proposals_boxes_means_and_truth(compared):
    history = representative(compared.runs["misspecified+edge"])
    figure = drawn(samples.draw, [history], height=5.0)
    axes = figure.axes[0]
    failed, kept, mean = (collection.get_offsets() for collection in axes.collections[:3])
    np.testing.assert_allclose(kept, history.theta[history.kept][:, :2])
    np.testing.assert_allclose(failed, history.theta[history.counted & (history.failure != 0)][:, :2])
    accumulated = [history.theta[: i + 1][history.kept[: i + 1]].mean(0)[:2] for i in range(history.rounds)]
    np.testing.assert_allclose(mean, accumulated)
    boxes = np.array([[*box.get_xy(), box.get_width(), box.get_height()] for box in axes.patches])
    low, high = history.proposal_low[:, :2], history.proposal_high[:, :2]
    np.testing.assert_allclose(boxes, np.concatenate([low, high - low], 1))
    assert len({to_hex(box.get_edgecolor()) for box in axes.patches}) == history.rounds
    np.testing.assert_allclose(marked(axes, "truth")[0].get_xydata(), TRUTH[None, :2])
    assert axes.get_xlabel() == "$\\theta_{1}$ predator birth\n[1/time]"


def test_samples_shows_the_last_mixture_and_the_path_of_the_mean(compared):
    history = representative(compared.runs["ok"])
    figure = drawn(samples.draw, [history], height=5.0)
    axes = figure.axes[1]
    w = np.exp(history.logits) / np.exp(history.logits).sum(1, keepdims=True)
    path = (w[..., None] * history.means).sum(1)[:, :2]
    np.testing.assert_allclose(marked(axes, "weighted mean")[0].get_xydata(), path)
    mesh = next(artist for artist in axes.collections if hasattr(artist, "get_coordinates"))
    corners = np.asarray(mesh.get_coordinates())
    area = np.diff(corners[0, :, 0])[None, :] * np.diff(corners[:, 0, 1])[:, None]
    inside = float((np.asarray(mesh.get_array()).reshape(area.shape) * area).sum())
    assert inside == pytest.approx(1.0, abs=0.05)
    assert [bar.get_xlabel() for bar in axes.child_axes] == ["posterior density"]
    box = axes.patches[0]
    np.testing.assert_allclose(box.get_xy(), history.support_low[-1, :2])


def test_samples_pairs_all_parameters():
    assert samples.pairs(1) == [(0,)]
    assert samples.pairs(2) == [(0, 1)]
    assert samples.pairs(3) == [(0, 1), (2, 0)]
    assert samples.pairs(4) == [(0, 1), (2, 3)]
    assert samples.pairs(5) == [(0, 1), (2, 3), (4, 0)]


def test_efficiency_shows_medians_of_seeds_and_each_in_the_end(compared):
    figure = drawn(efficiency.draw, compared.runs)
    histories = compared.runs["broad"]
    attempted = np.stack([h.attempted for h in histories])
    failed = np.stack([h.failed for h in histories])
    shown = line(panel(figure, "success rate [%]"), "broad")
    np.testing.assert_allclose(shown.get_xdata(), np.arange(1, histories[0].rounds + 1))
    np.testing.assert_allclose(shown.get_ydata(), np.median(100 * (attempted - failed) / attempted, axis=0))
    for title, values in {"failed simulations in all": failed, "simulations in all": attempted}.items():
        axes = next(axes for axes in figure.axes if axes.get_title() == title)
        np.testing.assert_allclose(line(axes, "broad").get_ydata(), values.sum(1))


def test_curves_are_medians_of_seeds_means_of_exp_of_negative_losses(compared):
    figure = drawn(curves.draw, compared.runs, alpha=0.5)
    histories = compared.runs["misspecified+mode"]
    error = np.stack([h.trajectory_error for h in histories])
    assert np.isnan(error).any()
    expected = np.median(np.where(np.isnan(error), 0.0, np.exp(-0.5 * error)).mean(2), axis=0)
    label = "misspecified + MODE"
    np.testing.assert_allclose(line(panel(figure, "trajectory"), label).get_ydata(), expected)
    for d, name in enumerate(NATURAL):
        theta = np.stack([h.theta_error[..., d] for h in histories])
        expected = np.median(np.exp(-0.5 * theta).mean(2), axis=0)
        np.testing.assert_allclose(line(panel(figure, name), label).get_ydata(), expected)


def test_discrepancy_shows_each_seed_and_their_median(compared):
    figure = drawn(discrepancy.draw, compared.runs)
    for place, (name, histories) in enumerate(compared.runs.items()):
        expected = {"trajectory": [h.final_trajectory_error for h in histories]}
        expected |= {n: [h.theta_error[-1, :, d].mean() for h in histories] for d, n in enumerate(NATURAL)}
        for title, values in expected.items():
            axes = panel(figure, title)
            dots = line(axes, style.configuration_label(name))
            np.testing.assert_allclose(dots.get_ydata(), values)
            assert to_hex(dots.get_color()) == style.looks([name])[name].colour.lower()
            assert np.abs(dots.get_xdata() - place).max() < 0.4
            assert marked(axes, "median")[place].get_ydata()[0] == pytest.approx(np.median(values))
    # An error of a logarithm is read as a factor.
    axes = panel(figure, NATURAL[0])
    assert axes.yaxis.get_major_formatter()(np.log(3)) == "×3" and axes.get_ylabel() == "discrepancy (factor)"


def test_support_draws_the_configurations_that_adapt(compared):
    assert set(supports.adapting(compared.runs)) == {n for n in COMPARED if "+" in n}
    assert set(supports.adapting({"ok": compared.runs["ok"]})) == {"ok"}
    figure = drawn(supports.draw, compared.runs)
    axes = panel(figure, NATURAL[1])
    histories = compared.runs["misspecified+edge"]
    upper = np.stack([np.concatenate([h.proposal_high[:1], h.support_high])[:, 1] for h in histories]).mean(0)
    shown = [artist.get_ydata() for artist in axes.lines if artist.get_label() == "misspecified + EDGE"]
    assert any(np.allclose(values, upper) for values in shown)
    assert marked(axes, "truth")[0].get_ydata()[0] == pytest.approx(TRUTH[1])
    assert sorted(limit.get_ydata()[0] for limit in marked(axes, "limit")) == [-6.0, 4.0]


def test_losses_of_one_run_by_epoch_and_of_several_by_round(compared):
    history = compared.runs["ok"][0]
    figure = drawn(losses.draw, {"ok": [history]})
    for i, shown in enumerate(panel(figure, "training loss").lines):
        np.testing.assert_allclose(shown.get_ydata(), history.loss[i].mean(0))
    figure = drawn(losses.draw, compared.runs)
    best = np.median([h.validation_loss.mean(1).min(-1) for h in compared.runs["ok"]], axis=0)
    np.testing.assert_allclose(line(panel(figure, "validation loss"), "OK").get_ydata(), best)


def test_losses_end_at_an_early_stop(tmp_path):
    folder = write_run(tmp_path / "run", rounds=2)
    change(
        folder,
        "history.npz",
        lambda a: a["loss"].__setitem__((slice(None), slice(None), slice(5, None)), np.nan),
    )
    history = load(folder)
    np.testing.assert_allclose(losses.by_round(history, "loss"), history.loss[:, :, 4].mean(1))


def test_predictive_bands_are_quantiles_over_the_observation(compared):
    history = compared.runs["ok"][0]
    figure = drawn(predictive.draw, [history])
    axes = figure.axes[1]
    simulated = history.final_trajectory[np.isfinite(history.trajectory_error[-1]), :, 1]
    np.testing.assert_allclose(marked(axes, "median")[0].get_ydata(), np.median(simulated, axis=0))
    np.testing.assert_allclose(marked(axes, "observed")[0].get_ydata(), history.observed[:, 1])
    assert marked(axes, "observed")[0].get_marker() == "None"
    band = axes.collections[0].get_paths()[0].vertices[:, 1]
    assert band.max() == pytest.approx(np.quantile(simulated, 0.95, axis=0).max())


def test_predictive_shows_few_records_as_points(tmp_path):
    history = load(write_run(tmp_path / "run", records=21))
    observed = marked(drawn(predictive.draw, [history]).axes[0], "observed")[0]
    assert (observed.get_marker(), observed.get_linestyle()) == ("o", "None")


def test_predictive_shows_the_channels_that_vary_most(tmp_path):
    """Thirty channels fit on a page; those that are left out vary least, and the caption says so."""
    channels = tuple(f"k{i}" for i in range(30))
    folder = write_run(tmp_path / "run", records=21, channels=channels, rounds=1)
    history = load(folder)
    with style.context():
        figure, _, caption = reporting.PICTURES["predictive"](open_collection(folder))
    ranges = np.ptp(history.observed, axis=0)
    expected = {channels[i] for i in np.argsort(ranges)[-10:]}
    assert {axes.get_ylabel() for axes in figure.axes} == expected
    assert figure.get_size_inches()[1] * 300 <= 2400 and "Of 30 channels, the 10" in caption
    assert len(predictive.shown([history, history])) == predictive.ROWS


def test_predictive_counts_records_by_their_label(tmp_path):
    folder = write_run(tmp_path / "run", records=21)
    label = lambda: drawn(predictive.draw, [load(folder)]).axes[-1].get_xlabel()
    assert label() == "month"
    change(folder, "observation.npz", lambda a: a.pop("record_label"))
    assert label() == "time"
    change(folder, "observation.npz", lambda a: a.update(times=np.arange(21)))
    assert label() == "record"


def correlated(rng, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Normal draws of two parameters and their covariance."""
    covariance = np.array([[0.5, 0.42], [0.42, 0.9]])
    return rng.multivariate_normal([1.0, -2.0], covariance, n), covariance


@pytest.mark.parametrize("enclosed", [0.5, 0.8, 0.95])
def test_contours_of_normal_draws_are_their_ellipses(enclosed):
    draws, covariance = correlated(np.random.default_rng(0), 40_000)
    x, y, density_ = pairs.smoothed(draws, np.array([[-50.0, -50.0], [50.0, 50.0]]))
    assert density_.sum() == pytest.approx(1)
    np.testing.assert_allclose([density_.sum(0) @ x, density_.sum(1) @ y], [1.0, -2.0], atol=0.03)
    inside = density_ >= pairs.levels(density_, [enclosed])[0]
    area = inside.sum() * (x[1] - x[0]) * (y[1] - y[0])
    ellipse = np.pi * stats.chi2(2).ppf(enclosed) * np.sqrt(np.linalg.det(covariance))
    assert area == pytest.approx(ellipse, rel=0.2)  # the kernel widens, by a quarter of a standard deviation
    # The ellipse leans to the right: the first axis is horizontal.
    assert inside[y > -1.5][:, x > 1.5].sum() > 3 * inside[y > -1.5][:, x < 0.5].sum()


def test_a_density_does_not_fade_at_the_support():
    """Draws that are uniform in a box have one density up to its bounds, and none beyond."""
    box = np.array([[0.0, 10.0], [1.0, 14.0]])
    draws = np.random.default_rng(1).uniform(*box, (100_000, 2))
    x, y, fraction = pairs.smoothed(draws, box)
    assert x.min() > 0 and x.max() < 1 and y.min() > 10 and y.max() < 14
    np.testing.assert_allclose(fraction, fraction.mean(), rtol=0.15)


def test_draws_all_in_one_place_have_a_density():
    for draws in (np.zeros((50, 2)), np.column_stack([np.zeros(50), np.linspace(0, 1, 50)])):
        for box in ([[0.0, 0.0], [1.0, 1.0]], [[-np.inf] * 2, [np.inf] * 2]):
            _, _, fraction = pairs.smoothed(draws, np.array(box))
            assert np.isfinite(fraction).all() and fraction.sum() == pytest.approx(1)


def test_pairs_shows_all_draws_with_support_and_truth(compared):
    histories = [representative(compared.runs[name]) for name in ("misspecified", "misspecified+edge")]
    figure = drawn(pairs.draw, histories)
    panels = [axes for axes in figure.axes if axes.axison]
    assert len(panels) == 2 * 10
    for place, history in enumerate(histories):
        marginal, pair = panels[10 * place], panels[10 * place + 1]
        (outline,) = marked(marginal, "marginal")
        corners = outline.get_xy()
        assert corners[:, 0].min() == pytest.approx(history.draws[:, 0].min())
        assert corners[:, 0].max() == pytest.approx(history.draws[:, 0].max())
        assert marked(marginal, "truth")[0].get_xdata()[0] == pytest.approx(TRUTH[0])
        np.testing.assert_allclose(marked(pair, "truth")[0].get_xydata(), TRUTH[None, :2])
        boxes = [[*box.get_xy(), box.get_width(), box.get_height()] for box in pair.patches]
        low, high = history.supports
        expected = [np.concatenate([low[i, :2], (high - low)[i, :2]]) for i in ((-1, 0) if place else (-1,))]
        np.testing.assert_allclose(boxes, expected)
        inside = (history.draws[:, :2] >= [pair.get_xlim()[0], pair.get_ylim()[0]]) & (
            history.draws[:, :2] <= [pair.get_xlim()[1], pair.get_ylim()[1]]
        )
        assert inside.all(1).mean() > 0.97
    assert panels[1].get_xlim() == panels[11].get_xlim()


def test_pairs_are_arranged_by_how_many_fit(tmp_path):
    assert pairs.arrangement(3, 4) == (1, 3)
    assert pairs.arrangement(4, 4) == (2, 2)
    assert pairs.arrangement(4, 2) == (1, 4)
    assert pairs.arrangement(1, 6) == (1, 1)
    assert not pairs.drawable(load(write_run(tmp_path / "seven", dim=7, rounds=1)))


def test_polars_measure_all_in_the_units_of_ok(compared):
    """Widths of its first support, and standard deviations of its first round's summaries."""
    chosen = [compared.runs[name][0] for name in ("misspecified", "ok")]
    bare, ok = chosen
    figure = drawn(polars.draw, chosen)
    circles = [axes for axes in figure.axes if axes.axison]
    assert len(circles) == 4
    with np.load(ok.folder / "dataset.npz") as dataset:
        first = dataset["x"][dataset["round"] == 0]
    deviation = (np.percentile(first, 84, axis=0) - np.percentile(first, 16, axis=0)) / 2
    for column, history in enumerate(chosen):
        width = ok.proposal_high[0] - ok.proposal_low[0]
        np.testing.assert_allclose(width, 7.0)
        expected = [history.theta_error[-1] / width, np.abs(history.final_x - history.x) / deviation]
        for axes, errors in zip(circles[column::2], expected, strict=True):
            (mean,) = marked(axes, "mean")
            np.testing.assert_allclose(mean.get_ydata()[:-1], np.nanmean(errors, axis=0))
            assert mean.get_ydata()[0] == mean.get_ydata()[-1]
            assert axes.get_ylim()[1] > np.nanmean(errors, axis=0).max()
    assert circles[0].get_ylim() == circles[1].get_ylim()
    assert [label.get_text() for label in circles[2].get_xticklabels()][2] == "log var X"
    assert polars.reference([bare]) is bare


def test_polars_leave_out_what_has_no_unit_or_no_value(tmp_path):
    folder = write_run(tmp_path / "run")
    constant = lambda a: a["x"].__setitem__((slice(None), 1), 3.0)
    change(folder, "dataset.npz", constant)
    history = load(folder)
    mean = marked(drawn(polars.draw, [history]).axes[-1], "mean")[0]
    assert len(mean.get_xdata()) == 4 + 1
    change(folder, "history.npz", lambda a: a["final_x"].fill(np.nan))
    failed = load(folder)
    assert set(polars.panels([failed])) == {"parameters"}
    both = drawn(polars.draw, [history, failed])
    assert [text.get_text() for text in both.axes[-1].texts] == ["none"]


def test_records_of_a_trajectory_are_no_spokes(tmp_path):
    folder = write_run(tmp_path / "run")
    assert set(polars.panels([load(folder)])) == {"parameters", "summaries"}
    records = np.array([f"x_{place}" for place in range(1, 6)])
    change(folder, "observation.npz", lambda a: a.update(summaries=records))
    assert set(polars.panels([load(folder)])) == {"parameters"}


def test_failed_simulations_have_an_entry_where_there_are_some(tmp_path):
    for failures in (0.3, 0.0):
        history = load(write_run(tmp_path / f"{failures}", failures=failures))
        assert history.failed.any() == (failures > 0)
        (legend,) = drawn(samples.draw, [history]).legends
        assert ("failed" in [text.get_text() for text in legend.get_texts()]) == (failures > 0)


@pytest.mark.parametrize("dim", [2, 5])
def test_a_pair_plot_begins_right_below_its_title(tmp_path, dim):
    figure = drawn(pairs.draw, [load(write_run(tmp_path / "run", dim=dim))])
    figure.draw_without_rendering()
    title, first = (axes.get_position() for axes in figure.axes[:2])
    assert 0 < (title.y0 - first.y1) + title.height < 0.6 / figure.get_figheight()


def test_the_robust_sd_of_normal_numbers_is_their_standard_deviation():
    x = np.random.default_rng(2).normal(5.0, [0.3, 20.0], (40_000, 2))
    x[:100] = 1e6  # but for a few
    np.testing.assert_allclose(robust_sd(x), [0.3, 20.0], rtol=0.03)


def test_seeds_marks_mean_and_median(compared):
    values = compared.values("theta_error")
    figure = drawn(seeds.draw, values, "error")
    (axes,) = figure.axes
    assert axes.get_yscale() == "log"
    means = [mark.get_ydata()[0] for mark in marked(axes, "mean")]
    np.testing.assert_allclose(means, [v.mean() for v in values.values()])
    for name, every in values.items():
        np.testing.assert_allclose(marked(axes, name)[0].get_ydata(), every)
        medians = [artist.get_ydata() for artist in axes.lines]
        assert any(len(m) == 2 and np.allclose(m, np.median(every)) for m in medians)


# Colours


def test_a_configuration_has_one_look_everywhere():
    together = style.looks([*COMPARED, "broader", "broadest", "mine", "other+mine"])
    for name in COMPARED:
        assert style.looks([name])[name] == together[name]
    assert len({look.colour for look in together.values()}) == len(together)
    assert len({look.marker for look in together.values()}) == len(together)
    assert together["misspecified+edge"].label == "misspecified + EDGE"
    assert style.looks(["broad+edge"])["broad+edge"].colour != together["misspecified+edge"].colour


def test_colours_stay_apart_for_the_colour_blind():
    colours = [*style.SUPPORT_COLOURS.values(), *style.HEURISTIC_COLOURS.values()]
    # Machado, Oliveira and Fernandes (2009), severity 1.
    deficiencies = {
        "normal": np.eye(3),
        "protan": [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ],
        "deutan": [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ],
        "tritan": [
            [1.255528, -0.076749, -0.178779],
            [-0.078411, 0.930809, 0.147602],
            [0.004733, 0.691367, 0.303900],
        ],
    }
    for matrix in deficiencies.values():
        lab = np.array([cielab(np.clip(np.asarray(matrix) @ linear(to_rgb(colour)), 0, 1)) for colour in colours])
        distance = np.linalg.norm(lab[:, None] - lab[None], axis=-1)[np.triu_indices(len(lab), 1)]
        assert distance.min() > 20


def linear(rgb) -> np.ndarray:
    """sRGB to linear light."""
    rgb = np.asarray(rgb)
    return np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


def cielab(rgb: np.ndarray) -> np.ndarray:
    """Linear light to CIELAB (D65)."""
    matrix = [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ]
    xyz = np.asarray(matrix) @ rgb / [0.95047, 1.0, 1.08883]
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def test_labels_name_symbol_and_unit():
    assert style.parameter_label(["ln rate"], ["1/s"], 0) == "$\\theta_{1}$ rate\n[1/s]"
    assert style.parameter_label(["ln rate"], ["ln(1/s)"], 0) == "$\\theta_{1}$ rate\n[1/s]"
    assert style.parameter_label(["a_b", "cost$"], ["", "N"], 1) == "$\\theta_{2}$ cost\\$\n[N]"
    assert style.parameter_label(["a_b"], [""], 0) == "$\\theta_{1}$ a b"


# Whole reports


def drawable_pictures(collection) -> list[str]:
    """Names of the pictures of a collection, drawn but not written."""
    with style.context():
        return [name for name, make in reporting.PICTURES.items() if make(collection) is not None]


def names_of(paths: list[Path]) -> list[str]:
    """File names without their folders."""
    return [path.name for path in paths]


EVERYTHING = ["pairs", "samples", "efficiency", "curves", "discrepancy", "support", "losses"]
EVERYTHING += ["predictive", "channels", "polars", "seeds"]
OF_SEVERAL = {"discrepancy", "seeds"}
"""Pictures in which a single run would be a single dot."""


@pytest.mark.slow
def test_report_of_a_comparison(compared):
    paths = report(compared.folder, dpi=40)
    assert names_of(paths) == ["report.html", *(f"{name}.png" for name in EVERYTHING)]
    for path in paths[1:]:
        pixels = points_of(path)
        assert pixels[..., :3].std() > 0.02
        assert pixels.shape[1] in (round(40 * style.TEXT_WIDTH), round(40 * style.COLUMN_WIDTH))
    text = paths[0].read_text(encoding="utf-8")
    assert text.count("data:image/png;base64,") == len(EVERYTHING)
    assert "http" not in text.replace("http-equiv", "")
    assert "jaxlfi compare lotka_volterra" in text and "There are no simulated trajectories" not in text
    for name, values in compared.values("theta_error").items():
        row = next(line for line in text.splitlines() if style.configuration_label(name) in line)
        for number in (values.mean(), np.median(values), values.std(ddof=1)):
            assert f">{number:.3g}<" in row


@pytest.mark.parametrize(
    ("options", "missing"),
    [
        ({"dim": 1, "channels": ("x",)}, {"channels"}),
        ({"dim": 3, "truth": False}, set()),
        ({"dim": 4, "rounds": 1, "epochs": 1, "components": 1, "records": 21}, {"efficiency", "curves"}),
        ({"dim": 2, "failures": 1.0, "records": 1}, {"predictive", "channels"}),
        ({"dim": 2, "failures": 0.0, "configuration": "ok"}, {"efficiency", "support"}),
    ],
    ids=["one", "unknown-truth", "one-round", "all-failed", "constant"],
)
def test_report_of_one_run(tmp_path, options, missing):
    paths = report(write_run(tmp_path / "run", **options), dpi=30)
    assert names_of(paths[1:]) == [f"{name}.png" for name in EVERYTHING if name not in missing | OF_SEVERAL]
    assert all(path.stat().st_size > 1000 for path in paths)
    assert "&lt;somewhere&gt;" in paths[0].read_text(encoding="utf-8")


def test_simulations_that_never_fail_are_no_picture(tmp_path):
    options = {"dim": 2, "rounds": 2, "records": 21}
    never, once = (write_compare(tmp_path / str(rate), ["ok"], 2, failures=rate, **options) for rate in (0.0, 0.5))
    assert reporting.PICTURES["efficiency"](open_collection(never)) is None
    assert reporting.PICTURES["efficiency"](open_collection(once)) is not None


def test_legends_fit_into_figures_of_one_column(tmp_path):
    four, one = (open_collection(write_run(tmp_path / str(d), dim=d, rounds=2, records=21)) for d in (4, 1))
    for name, collection in {"curves": one, "predictive": four, "polars": four}.items():
        with style.context():
            figure, _, _ = reporting.PICTURES[name](collection)
            figure.draw_without_rendering()
        width, height = figure.get_size_inches() * figure.dpi
        assert width == style.COLUMN_WIDTH * figure.dpi
        box = figure.legends[0].get_window_extent()
        assert box.x0 >= 0 and box.x1 <= width and box.y0 >= 0 and box.y1 <= height, name


def test_report_of_seeds(tmp_path):
    for seed in range(3):
        write_run(tmp_path / f"seed_{seed:03d}", seed=seed, dim=2)
    (tmp_path / "config.json").write_text(json.dumps({"format": "jaxlfi-runs", "task": "two"}))
    collection = open_collection(tmp_path)
    errors = sorted(h.final_theta_error for h in collection.runs["misspecified+edge"])
    assert representative(collection.runs["misspecified+edge"]).final_theta_error == errors[1]
    np.testing.assert_allclose(sorted(collection.values("theta_error")["misspecified+edge"]), errors)
    assert drawable_pictures(collection) == EVERYTHING


def test_report_of_a_comparison_without_truth(tmp_path):
    write_compare(tmp_path, ("mine", "other+rule"), 2, truth=False, dim=1, rounds=2)
    drawn_pictures = names_of(report(tmp_path, dpi=30)[1:])
    assert drawn_pictures == [f"{name}.png" for name in EVERYTHING]


def change(folder: Path, file: str, edit) -> None:
    """Edit the arrays of a file."""
    with np.load(folder / file) as stored:
        arrays = dict(stored)
    edit(arrays)
    np.savez(folder / file, **arrays)


def test_report_of_a_run_with_nothing_but_what_is_required(tmp_path):
    folder = write_run(tmp_path / "run", dim=2)
    needed = [
        "theta",
        "counted",
        "kept",
        "failure",
        "proposal_low",
        "proposal_high",
        "support_low",
        "support_high",
    ]
    needed += ["logits", "means", "scale_tril"]
    change(folder, "history.npz", lambda a: [a.pop(name) for name in list(a) if name not in needed])
    for file in ("observation.npz", "posterior.npz", "dataset.npz"):
        (folder / file).unlink()
    (folder / "config.json").write_text(json.dumps({"format": "jaxlfi-run"}))
    assert names_of(report(folder, dpi=30)) == ["report.html", "samples.png", "efficiency.png", "support.png"]
    history = load(folder)
    assert history.names == ("theta 1", "theta 2")
    np.testing.assert_array_equal(history.failed, (history.counted & (history.failure > 0)).sum(1))


@pytest.mark.parametrize("units", [7.5, "two", {"m": 1, "s": 2}, ["m"]])
def test_units_that_are_no_list_of_them_are_left_out(tmp_path, units):
    folder = write_run(tmp_path / "run", dim=2)
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"units": units}))
    assert load(folder).units == ("", "")


def test_an_older_folder_leaves_out_what_was_not_saved(tmp_path):
    folder = write_run(tmp_path / "run")
    change(folder, "posterior.npz", lambda a: a.pop("draws"))
    change(folder, "history.npz", lambda a: a.pop("final_x"))
    change(folder, "observation.npz", lambda a: [a.pop(name) for name in ("summaries", "record_label")])
    history = load(folder)
    assert not pairs.drawable(history)
    assert set(polars.panels([history])) == {"parameters"}
    assert history.summaries == ("x_1", "x_2", "x_3", "x_4", "x_5")


def test_report_survives_a_posterior_that_is_not_finite(tmp_path):
    folder = write_run(tmp_path / "run", rounds=3)
    change(folder, "history.npz", lambda a: [a[name].__setitem__(-1, np.nan) for name in ("logits", "means")])
    change(folder, "posterior.npz", lambda a: a["draws"].fill(np.nan))
    assert not pairs.drawable(load(folder))
    figure = drawn(samples.draw, [load(folder)])
    assert any("not finite" in text.get_text() for text in figure.axes[1].texts)


def without_trajectories(folder: Path, saved: bool) -> Path:
    """A run whose posterior was not simulated; `saved`: its arrays are there and hold NaN."""

    def edit(arrays):
        arrays["sample_trajectory_error"].fill(np.nan)
        for name in ("final_trajectory", "final_x"):
            arrays[name].fill(np.nan) if saved else arrays.pop(name)

    change(folder, "history.npz", edit)
    return folder


@pytest.mark.slow
def test_report_of_a_run_whose_posterior_was_not_simulated(tmp_path):
    expected = [name for name in EVERYTHING if name not in ("discrepancy", "channels", "predictive", "seeds")]
    folder = without_trajectories(write_run(tmp_path / "run", dim=3, rounds=2, epochs=1), saved=True)
    paths = report(folder, dpi=30)
    assert names_of(paths[1:]) == [f"{name}.png" for name in expected]
    text = paths[0].read_text(encoding="utf-8")
    assert "There are no simulated trajectories" in text
    assert "absolute difference from the true value" in text and "observed trajectory" not in captions(text)
    panels = drawn(curves.draw, open_collection(folder).runs).axes
    assert [axes.get_title().split(" ")[0] for axes in panels] == [style.symbol(d) for d in range(3)]
    change(folder, "history.npz", lambda a: [a.pop(name) for name in ("final_trajectory", "final_x")])
    assert drawable_pictures(open_collection(folder)) == expected


def captions(text: str) -> str:
    """The captions on a page."""
    return " ".join(part.split("</figcaption>")[0] for part in text.split("<figcaption>")[1:])


def test_a_comparison_where_one_posterior_was_not_simulated(tmp_path):
    write_compare(tmp_path, ("ok", "misspecified+edge"), 1, dim=3, rounds=2)
    without_trajectories(tmp_path / "ok" / "seed_000", saved=False)
    collection = open_collection(tmp_path)
    assert drawable_pictures(collection) == [name for name in EVERYTHING if name != "seeds"]
    figure = drawn(discrepancy.draw, collection.runs)
    assert [text.get_text().strip() for text in panel(figure, "trajectory").texts] == ["none"]
    figure = drawn(predictive.draw, *reporting.columns({"misspecified+edge": collection.runs["misspecified+edge"]}))
    assert len(figure.axes) == 2


def test_draws_are_read_into_inference_space(tmp_path):
    folder = write_run(tmp_path / "run", dim=3, rounds=1)
    natural = np.random.default_rng(4).uniform(0.1, 2.0, (50, 3))
    change(folder, "posterior.npz", lambda a: a.update(draws=natural, log=np.array([True, False, True])))
    draws = load(folder).draws
    np.testing.assert_allclose(draws[:, [0, 2]], np.log(natural[:, [0, 2]]))
    np.testing.assert_array_equal(draws[:, 1], natural[:, 1])
    natural[3, 0] = -0.1  # no logarithm
    change(folder, "posterior.npz", lambda a: a.update(draws=natural))
    assert not pairs.drawable(load(folder))
    change(folder, "posterior.npz", lambda a: a.update(log=np.array([True])))
    with pytest.raises(ValueError, match=r"posterior\.npz: expected log of shape \(3,\), got \(1,\)"):
        load(folder)


MARKUP = "<b>[red]$x_1$</b> &amp; \"'\\"


def test_markup_in_names_is_shown_as_it_is(tmp_path):
    """Names of folders, configurations, tasks, parameters and warnings are text, on the page and in the pictures."""
    folder = tmp_path / MARKUP.replace("/", "|")
    write_run(folder, dim=1, rounds=1, records=11, channels=(MARKUP,))
    config = json.loads((folder / "config.json").read_text())
    config |= {"task": None, "configuration": MARKUP, "warnings": [MARKUP], "units": [MARKUP], "preset": MARKUP}
    (folder / "config.json").write_text(json.dumps(config))
    change(folder, "observation.npz", lambda a: a.update(names=np.array([MARKUP]), summaries=np.array([MARKUP] * 5)))
    text = report(folder, dpi=30)[0].read_text(encoding="utf-8")
    assert "<b>" not in text and "[red]" in text
    parser = Texts()
    parser.feed(text)
    assert any(found.startswith(folder.name) for found in parser.found["h1"])
    assert MARKUP.replace("_", " ") in parser.found["td"]  # as in the pictures' legends
    assert MARKUP in parser.found["p"] and MARKUP in parser.found["dd"]


class Texts(HTMLParser):
    """The text in each kind of element."""

    def __init__(self):
        super().__init__()
        self.found, self._open = collections.defaultdict(list), []

    def handle_starttag(self, tag, attrs):
        self._open.append(tag)

    def handle_endtag(self, tag):
        while self._open and self._open.pop() != tag:
            pass

    def handle_data(self, data):
        self.found[self._open[-1] if self._open else ""].append(data)


def test_unfinished_runs_are_named_and_left_out(tmp_path):
    write_compare(tmp_path, ("ok", "misspecified"), 2, dim=2, rounds=3)
    (tmp_path / "ok" / "seed_001" / "history.npz").unlink()
    shorter = tmp_path / "misspecified" / "seed_000"
    change(shorter, "history.npz", lambda a: a.update({n: v[:2] for n, v in a.items() if v.shape[:1] == (3,)}))
    collection = open_collection(tmp_path)
    assert {name: len(runs) for name, runs in collection.runs.items()} == {"ok": 1, "misspecified": 1}
    assert {Path(path).parent.name for path in collection.unfinished} == {"ok", "misspecified"}
    notes = [text for text in page.render(collection, []).splitlines() if "note" in text and "left out" in text]
    assert len(notes) == 1 and "misspecified/seed_000" in notes[0] and "ok/seed_001" in notes[0]


# Folders that are none


def spoil_array(name, edit):
    """Spoil one array of history.npz."""
    return lambda folder: change(folder, "history.npz", lambda a: a.__setitem__(name, edit(a[name])))


SPOILED = {
    "no config": (lambda f: (f / "config.json").unlink(), "found none"),
    "config is no JSON": (lambda f: (f / "config.json").write_text("{"), "expected JSON"),
    "config of another program": (lambda f: (f / "config.json").write_text("[1]"), "'format'"),
    "foreign format": (lambda f: (f / "config.json").write_text('{"format": "other"}'), "got 'other'"),
    "no history": (lambda f: (f / "history.npz").unlink(), "expected the file"),
    "history is no npz": (lambda f: (f / "history.npz").write_bytes(b"PK\x03\x04 broken"), "expected a complete .npz"),
    "empty history": (lambda f: (f / "history.npz").write_bytes(b""), "expected a complete .npz"),
    "missing array": (lambda f: change(f, "history.npz", lambda a: a.pop("means")), "missing means"),
    "wrong shape": (spoil_array("support_low", lambda v: v[:, :1]), "expected support_low of shape (2, 4)"),
    "wrong samples": (
        spoil_array("sample_theta_error", lambda v: v[0]),
        "expected sample_theta_error of shape",
    ),
    "wrong numbers of simulations": (spoil_array("attempted", lambda v: v[None]), "expected attempted of shape (2,)"),
    "wrong summary": (lambda f: change(f, "observation.npz", lambda a: a.update(x=np.zeros(()))), "expected x of one"),
    "no rounds": (spoil_array("theta", lambda v: v[:0]), "at least one round"),
    "pickles": (spoil_array("theta", lambda v: np.array([{}], dtype=object)), "expected a complete .npz"),
    "texts": (spoil_array("logits", lambda v: v.astype("S3")), "expected numbers, got texts as logits"),
}


@pytest.mark.parametrize(("spoil", "message"), SPOILED.values(), ids=SPOILED)
def test_damaged_folders_are_refused_in_one_line(tmp_path, spoil, message):
    folder = write_run(tmp_path / "run", rounds=2)
    spoil(folder)
    with pytest.raises(ValueError, match="expected") as caught:
        report(folder)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not (folder / "figures").exists()
    assert not (folder / "report.html").exists()


def test_simulations_whose_rounds_are_of_another_shape_give_no_scale(tmp_path):
    folder = write_run(tmp_path / "run", rounds=2)
    arrays = {"x": np.zeros((8, len(load(folder).x))), "round": np.repeat([0, 1], 4)}
    np.savez(folder / "dataset.npz", **arrays)
    assert load(folder).x_scale is not None
    np.savez(folder / "dataset.npz", **arrays | {"round": np.repeat([0, 1], 4)[:, None]})
    assert load(folder).x_scale is None


def test_missing_and_empty_folders_are_refused(tmp_path):
    with pytest.raises(ValueError, match="expected a run folder, found none"):
        report(tmp_path / "nowhere")
    (tmp_path / "config.json").write_text('{"format": "jaxlfi-compare"}')
    with pytest.raises(ValueError, match="expected finished rounds"):
        report(tmp_path)
    with pytest.raises(ValueError, match="found a file"):
        report(tmp_path / "config.json")
    (tmp_path / "config.json").write_text('{"format": "jaxlfi-grid"}')
    with pytest.raises(ValueError, match="a sensitivity grid: `report` draws it"):
        open_collection(tmp_path)


def test_a_damaged_table_and_unlike_runs_are_refused(tmp_path):
    write_compare(tmp_path, ("ok", "misspecified"), 1, dim=2, rounds=2)
    table = tmp_path / "table.csv"
    whole = table.read_text()
    table.write_text(whole.replace("theta_error", "error", 1))
    with pytest.raises(ValueError, match=r"table\.csv: expected a table.*missing theta_error"):
        report(tmp_path)
    table.write_text(whole)
    write_run(tmp_path / "broad" / "seed_000", configuration="broad", dim=3, rounds=2)
    with pytest.raises(ValueError, match="expected runs of the same parameters"):
        report(tmp_path)


def test_configurations_come_in_the_order_of_the_config_or_the_papers(tmp_path, compared):
    assert list(compared.runs) == list(COMPARED)
    order = ["misspecified+edge", "ok", "mine"]
    write_compare(tmp_path, order, 1, dim=1, rounds=1)
    config = {"format": "jaxlfi-compare", "configurations": order}
    (tmp_path / "config.json").write_text(json.dumps(config))
    assert list(open_collection(tmp_path).runs) == order
