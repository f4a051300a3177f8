"""TensorBoard's files: every scalar of every training once, whatever was written before."""

import sys
import time

import numpy as np
import pytest

pytest.importorskip("brax")

from rl.events import events, scalars

from jaxlfi.rl import tensorboard

NAMES = (("uniform", 0), ("median", 5))


def curves(updates):
    """Curves of two trainings; in one update of the second no episode ended."""
    random = np.random.default_rng(0)
    made = {name: random.normal(size=(6, 2)) for name in ("value", "length", "hit", "loss/policy_loss")}
    made["value"][1, 1] = np.nan
    made["episodes"] = np.arange(12).reshape(6, 2)
    made["seconds"] = np.full((6, 2), 4.0)
    return {name: rows[:updates] for name, rows in made.items()}


def expected(name, place, updates):
    rows = curves(updates)[name][:, place]
    return [(192 * (i + 1), pytest.approx(float(row))) for i, row in enumerate(rows) if np.isfinite(row)]


def check(out, updates):
    for place, folder in enumerate(("uniform/seed_000", "median/seed_005")):
        found = scalars(out / folder)
        assert set(found) == {
            *("episodes/return", "episodes/length", "episodes/hit", "episodes/count"),
            *("loss/policy_loss", "speed/steps_per_second"),
        }
        for tag, name in (
            *(("episodes/return", "value"), ("episodes/length", "length"), ("episodes/hit", "hit")),
            *(("loss/policy_loss", "loss/policy_loss"), ("episodes/count", "episodes")),
        ):
            assert found[tag] == expected(name, place, updates)
        assert found["speed/steps_per_second"] == [(192 * (i + 1), 48.0) for i in range(updates)]


def test_what_is_new_is_written_while_it_trains(tmp_path):
    with tensorboard.Scalars(tmp_path, NAMES, 192) as out:
        for updates in (2, 3, 3, 6):
            out.write(curves(updates))
            check(tmp_path, updates)
    check(tmp_path, 6)


@pytest.mark.parametrize("cut", [0, 7])
def test_a_training_that_was_resumed_has_every_step_once(tmp_path, cut):
    """What a killed process left, a last event cut off among it, is replaced."""
    with tensorboard.Scalars(tmp_path, NAMES, 192) as out:
        out.write(curves(3))
    (left,) = (tmp_path / "median/seed_005").iterdir()
    left.write_bytes(left.read_bytes()[: left.stat().st_size - cut])
    with tensorboard.Scalars(tmp_path, NAMES, 192) as out:
        out.write(curves(4))
        out.write(curves(6))
    check(tmp_path, 6)


def test_times_are_those_at_which_updates_ended(tmp_path):
    with tensorboard.Scalars(tmp_path, NAMES, 192) as out:
        out.write(curves(6))
    (file,) = (tmp_path / "uniform/seed_000").iterdir()
    times = [event.wall_time for event in events(file) if any(v.tag == "episodes/hit" for v in event.summary.value)]
    np.testing.assert_allclose(np.diff(times), 4.0, atol=1e-3)
    assert abs(times[-1] - time.time()) < 60


def test_other_files_are_left_alone(tmp_path):
    (tmp_path / "uniform/seed_000").mkdir(parents=True)
    (tmp_path / "uniform/seed_000/policy.npz").write_text("precious")
    with tensorboard.Scalars(tmp_path, NAMES, 192) as out:
        out.write(curves(1))
    assert (tmp_path / "uniform/seed_000/policy.npz").read_text() == "precious"


def test_without_tensorboardx_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX.event_file_writer", None)
    with pytest.raises(ImportError, match=r"pip install 'jaxlfi\[policy\]'"):
        tensorboard.Scalars(tmp_path, NAMES, 192)
