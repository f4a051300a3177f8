"""Scores of segmentations, against small pictures counted by hand and SciPy's centres of mass."""

import warnings

import numpy as np
import pytest
from scipy import ndimage

from jaxlfi.envs.whip.vision.raster import DLO
from jaxlfi.envs.whip.vision.scores import centroids, overlaps, summary

SIZE = 20


def picture(**blocks) -> np.ndarray:
    """Labels that are 0 but for blocks, each of a label `l1` to `l7`: rows from, to, columns from, to."""
    labels = np.zeros((SIZE, SIZE), int)
    for name, (top, bottom, left, right) in blocks.items():
        labels[top:bottom, left:right] = int(name[1:])
    return labels


BLOCKS = {"l1": (0, 4, 0, 3), "l3": (6, 9, 10, 16), "l6": (15, 19, 2, 4), "l7": (10, 20, 17, 19)}
TRUE = np.stack([picture(**BLOCKS), picture(l2=(3, 8, 5, 9), l7=(0, 2, 0, 12))])
FOUND = np.stack(
    [
        # The first is moved by a row and two columns, the third has lost a column, the sixth is missed; the DLO is
        # two rows short, and there is a fifth.
        picture(l1=(1, 5, 2, 5), l3=(6, 9, 10, 15), l7=(12, 20, 17, 19), l5=(0, 2, 10, 14)),
        picture(l2=(3, 8, 5, 9), l4=(15, 17, 15, 17), l7=(0, 2, 0, 12)),  # four pixels of a fourth do not count
    ]
)
LINES = np.arange(16.0).reshape(2, 4, 2)


def scored(true=TRUE, found=FOUND, lines_true=LINES, lines_found=LINES):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return summary(true, found, lines_true, lines_found)


def test_overlaps_by_hand():
    """Each with its own pixels; what is not in the picture has none, and what is missed has 0."""
    nan = np.nan
    expected = [[3 / 21, nan, 15 / 18, nan, nan, 0, 16 / 20], [nan, 1, nan, nan, nan, nan, 1]]
    np.testing.assert_allclose(overlaps(TRUE, FOUND), expected, rtol=1e-12)
    np.testing.assert_allclose(overlaps(TRUE, TRUE), np.where(np.isnan(expected), nan, 1.0))


def test_four_pixels_are_nothing_and_five_are_something():
    four, five = picture(l2=(3, 5, 6, 8)), picture(l2=(3, 4, 6, 11))
    true = np.stack([four, five])
    np.testing.assert_array_equal(np.isnan(overlaps(true, true)[:, 1]), [True, False])
    np.testing.assert_array_equal(np.isnan(centroids(true)[:, 1, 0]), [True, False])


def test_centroids_against_scipy():
    """Columns first; NaN for what is not there."""
    found = centroids(TRUE)
    assert found.shape == (2, 6, 2)
    for i, cube in ((0, 1), (0, 3), (0, 6), (1, 2)):
        np.testing.assert_allclose(found[i, cube - 1], ndimage.center_of_mass(TRUE[i] == cube)[::-1])
        found[i, cube - 1] = np.nan
    assert np.isnan(found).all()
    uneven = np.random.default_rng(0).integers(0, DLO + 1, (3, SIZE, SIZE))
    for labels, places in zip(uneven, centroids(uneven), strict=True):
        expected = np.array(ndimage.center_of_mass(np.ones_like(labels), labels, range(1, DLO)))
        np.testing.assert_allclose(places, expected[:, ::-1])


def test_a_summary_by_hand():
    """One of four cubes in two pictures is missed, and one picture has a false detection."""
    off = np.array([[3.0, 4.0], [0.0, 0.0], [0.6, 0.8], [0.0, 2.0]])
    lines = LINES + np.stack([off, 0 * off])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = summary(TRUE, FOUND, LINES, lines)
    expected = {
        "DLO overlap": (0.8 + 1) / 2,
        "cubes overlap": (3 / 21 + 15 / 18 + 0 + 1) / 4,
        "centroid median (px)": 0.5,  # of sqrt(5), 0.5 and 0
        "centroid 99 % (px)": 0.5 + 0.98 * (5**0.5 - 0.5),
        "keypoint median (px)": 0.0,  # of 5, 2, 1 and five times 0
        "keypoint 99 % (px)": 2 + 0.93 * 3,
        "cubes missed": 1 / 4,
        "DLOs missed": 0.0,
        "seen but not there": 1 / 2,
    }
    assert {name: found[name] for name in expected} == pytest.approx(expected)
    assert found.keys() - expected.keys() == {"worst cube overlap"}


def test_the_worst_cube_is_one_of_those_in_the_pictures():
    """A cube that is in none of them has no overlap, and does not take part."""
    assert scored()["worst cube overlap"] == 0
    assert scored(TRUE, TRUE)["worst cube overlap"] == 1


def everything(shift: int = 0) -> np.ndarray:
    """All seven, of eight pixels each."""
    blocks = {f"l{label}": (2 * label, 2 * label + 2, shift, shift + 4) for label in range(1, 8)}
    return picture(**blocks)


def test_a_perfect_segmentation():
    true = np.stack([everything(), everything(5)])
    found = scored(true, true)
    assert {found[name] for name in found if "overlap" in name} == {1.0}
    assert {value for name, value in found.items() if "overlap" not in name} == {0.0}


def test_the_worst_cube():
    """Its overlap is the mean over pictures."""
    true, other = np.stack([everything(), everything()]), np.stack([everything(), everything()])
    other[1][other[1] == 4] = 0
    other[0, 8, 0] = 0  # one of the fourth's eight pixels
    other[:, 4, 0] = 0  # and of the second's
    found = scored(true, other)
    assert found["worst cube overlap"] == pytest.approx((7 / 8 + 0) / 2)
    assert found["cubes overlap"] == pytest.approx((4 * 2 + 2 * 7 / 8 + 7 / 8) / 12)
    assert found["cubes missed"] == pytest.approx(1 / 12)


def test_a_dlo_that_is_missed_and_one_that_is_not_there():
    """Its share is of those in the pictures, and distances are of what both have."""
    true = np.stack([everything()] * 4)
    lines_true, lines_found = np.zeros((4, 4, 2)), np.zeros((4, 4, 2))
    lines_true[0] = np.nan  # not in the picture
    lines_found[1] = np.nan  # missed
    lines_found[2] = [3.0, 4.0]
    found = scored(true, true, lines_true, lines_found)
    assert found["DLOs missed"] == pytest.approx(1 / 3)
    assert found["keypoint median (px)"] == pytest.approx(2.5)


def test_a_dlo_that_is_seen_but_not_there():
    """It counts as a cube does."""
    true = np.stack([everything(), np.where(everything() == DLO, 0, everything())])
    found = np.stack([everything(), everything()])
    lines_true = LINES.copy()
    lines_true[1] = np.nan
    assert scored(true, found, lines_true)["seen but not there"] == pytest.approx(1 / 2)
