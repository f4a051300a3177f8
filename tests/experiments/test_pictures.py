"""Kept pictures are drawn from kept arrays, in natural units."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")

from experiments import real2sim, sim2sim
from experiments.policies import figures, results
from experiments.policies.study import STILLS
from jaxlfi.envs.whip.render import PALETTE
from jaxlfi.figures import style
from jaxlfi.io import files

RESULTS = Path("experiments/results")


def drawn(paint, *arguments):
    with style.context():
        figure = style.new_figure(style.TEXT_WIDTH, 5.0)
        paint(figure, *arguments)
        figure.draw_without_rendering()
    return figure


def test_moduli_are_recovered_in_kilopascals():
    figure = drawn(sim2sim.draw, {"mask": sim2sim.saved(RESULTS / "sim2sim" / "mask.npz")})
    labels = [axes.get_xlabel() for axes in figure.axes]
    assert labels == ["true length\n[mm]"] * 2 + ["true Young's modulus\n[kPa]"] * 2
    ticks = [label.get_text() for label in figure.axes[2].get_xticklabels()]
    assert "10" in ticks and "100" in ticks
    assert {text.get_text() for text in figure.legends[0].texts} >= {"truth", "first guess"}


def test_gaps_are_read_back_and_drawn_for_each_object(tmp_path):
    kept = files.read_arrays(RESULTS / "real2sim" / "gaps.npz")
    found = real2sim.saved_gaps(RESULTS / "real2sim" / "gaps.npz")
    assert list(found) == list(real2sim.OBJECTS) and set(found["dlo-3"]) == set(real2sim.CONFIGURATIONS)
    np.testing.assert_array_equal(found["dlo-2"]["initial+edge"]["pixels"], kept["dlo-2_initial_edge_pixels"])
    figure = drawn(real2sim.draw_gaps, found)
    line = next(line for line in figure.axes[0].lines if line.get_label() == "EDGE")
    np.testing.assert_allclose(line.get_ydata(), found["dlo-0"]["initial+edge"]["summary"][:, 0])
    assert figure.axes[4].get_ylabel().endswith("[px]")


def test_stills_show_gripper_table_and_the_settled_stack():
    labels = np.zeros((len(STILLS), 64, 64), np.uint8)
    labels[:, 20:40, 30:32] = len(PALETTE) - 1
    labels[0, 40:58, 50:53], labels[-1, 55:58, 50:62] = 1, 1
    strip = {"labels": labels, "value": np.array(1.9), "steps": np.array(4)}
    np.testing.assert_allclose(figures.grip(labels[0]), [31 / 64, 20 / 64])
    figure = drawn(figures.draw_stills, {"dlo-0-edge@dlo-0": strip})
    assert len(figure.axes) == len(figures.MOMENTS)
    assert figure.axes[0].get_title() == "start, 0.00 s" and figure.axes[-1].get_title() == "settled, 2.56 s"
    for axes in figure.axes:
        (gripper,) = [patch for patch in axes.patches if patch.get_gid() == "gripper"]
        left, top = gripper.get_xy()
        assert left + gripper.get_width() / 2 == pytest.approx(31 / 64)
        assert top + gripper.get_height() == pytest.approx(20 / 64)
    # The start is drawn around the settled stack, where it stood: below the middle of the picture.
    (contour,) = figure.axes[-1].collections
    (segment,) = [path.vertices for path in contour.get_paths()]
    assert segment[:, 1].min() == pytest.approx(40 / 64, abs=0.02) and segment[:, 1].max() == pytest.approx(
        58 / 64, abs=0.02
    )


def test_trajectories_are_bands_with_a_barycentre_and_returns_a_dot_a_seed():
    actions = np.full((2, 4, 16, 2), np.nan)
    actions[:, :, :3] = 0.02
    actions[1, :, :3, 1] = -0.02
    found = {"actions": actions, "value": np.array([[0.0] * 4 + [1.0, 2.0], [0.0] * 4 + [1.0, 1.0]])}
    study = results.Results({}, {("dlo-0-edge", "dlo-0"): found}, {}, [])
    figure = drawn(figures.draw_trajectories, study, "EDGE")
    first, last = figure.axes[0], figure.axes[6]
    bands = [patch for patch in first.patches if patch.get_gid() == "band"]
    # The last band spans both seeds' last two points: a rectangle of two steps along x.
    assert bands[-1].get_xy()[:, 0].min() == pytest.approx(0.04) and bands[-1].get_xy()[:, 1].min() == pytest.approx(
        -0.06
    )
    np.testing.assert_allclose(last.lines[1].get_ydata(), [1.5, 1.0])
    assert figure.axes[-7].get_xlabel() == "Δx [m]" and first.get_ylabel() == "dlo-0\nΔz [m]"
    assert len(figure.legends) == 1
