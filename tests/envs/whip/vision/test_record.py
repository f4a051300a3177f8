"""A reference object is recorded as a camera sees it."""

import numpy as np
import pytest

pytest.importorskip("mujoco")

from jaxlfi.envs.whip import cli, recording

OPTIMISED = True
"""161 pictures are drawn, labelled and searched."""


@pytest.mark.slow
def test_an_object_is_recorded_through_pictures(tmp_path, capsys):
    """Recorded with the ray caster, which runs everywhere; equal to labels up to the errors of the learnt detector."""
    for detector in ("learnt", "centreline"):
        words = ("--detector", detector, "--renderer", "raycast", "--out", tmp_path / f"{detector}.npz")
        assert cli.main(["record", "--object", "dlo-3", *map(str, words)]) == 0
    assert "161 frames" in capsys.readouterr().out
    learnt, by_labels = (recording.read(tmp_path / f"{name}.npz") for name in ("learnt", "centreline"))
    assert "pictures (raycast) by the detector learnt" in learnt.description
    np.testing.assert_array_equal(learnt.actions, by_labels.actions)
    np.testing.assert_allclose(learnt.gripper, by_labels.gripper, atol=1e-6)
    assert learnt.seen.mean() > 0.98
    both = learnt.seen & by_labels.seen
    off = 256 * np.linalg.norm(learnt.keypoints - by_labels.keypoints, axis=-1)[both]
    assert np.median(off) < 2 and np.quantile(off, 0.95) < 6
