"""Pictures of the whip's posterior predictive: keypoints over the camera's image, and a few of them as bands."""

import numpy as np
import pytest

pytest.importorskip("mujoco")

from matplotlib.image import imread

from jaxlfi.envs.whip import figures
from jaxlfi.envs.whip.render import PALETTE
from jaxlfi.figures import style


@pytest.fixture
def shown():
    """Four simulations of a DLO that swings beside cubes at rest."""
    rng = np.random.default_rng(0)
    swing = 0.4 + 0.1 * np.sin(np.arange(16))[:, None] * np.arange(1, 5) / 4
    dlo = np.stack([swing, np.broadcast_to(np.linspace(0.4, 0.6, 4), (16, 4))], axis=-1)
    cubes = np.broadcast_to(np.stack([np.full(6, 0.75), np.linspace(0.9, 0.7, 6)], axis=-1), (16, 6, 2))
    observed = np.concatenate([dlo, cubes], axis=1)
    labels = np.zeros((16, 32, 32), np.uint8)
    labels[:, 10:20, 12:14] = 7
    return figures.Predictive(
        observed=observed,
        simulated=observed + 0.002 * rng.normal(size=(4, 16, 10, 2)),
        labels=labels,
        gripper=np.tile([0.4, 0.3], (16, 1)),
        palette=PALETTE,
        times=0.16 * np.arange(16),
        lines={"table": np.array([[0.0, 0.92], [1.0, 0.92]])},
    )


def test_keypoints_lie_over_the_image_and_four_places_are_bands(shown):
    with style.context():
        figure = style.new_figure(style.TEXT_WIDTH, 5.6)
        figures.draw_predictive(figure, shown)
        figure.draw_without_rendering()
    pictures = [axes for axes in figure.axes if axes.images]
    assert [axes.get_title() for axes in pictures][::7] == ["0.00 s", "2.40 s"] and len(pictures) == figures.PICTURES
    observed = pictures[-1].lines[-1]
    np.testing.assert_allclose(np.transpose(observed.get_data()), shown.observed[-1])
    bands = [axes for axes in figure.axes if not axes.images]
    for axes, (keypoint, axis) in zip(bands, figures.BANDS.values(), strict=True):
        assert axes.get_xlabel() == "time [s]"
        (median,) = [own for own in axes.lines if own.get_gid() == "median"]
        np.testing.assert_allclose(median.get_ydata(), np.median(shown.simulated[:, :, keypoint, axis], axis=0))
        # What rests is seen to rest, and down is down.
        low, high = axes.get_ylim()
        assert abs(high - low) >= figures.LEAST - 1e-9 and (low > high) == bool(axis)
    assert "image" in bands[0].get_ylabel()
    (words,) = figure.legends
    assert {"observed keypoint", "gripper", "table"} <= {text.get_text() for text in words.texts}


def test_the_picture_fits_on_a_screen(shown, tmp_path):
    height, width, _ = imread(figures.save_predictive(tmp_path / "predictive.png", shown)).shape
    assert height < width < 3000
