"""Trainings that begin with an earlier policy: they begin with what it does, in whatever scaling."""

import dataclasses

import jax
import numpy as np
import pytest

pytest.importorskip("brax")

from rl.toy import SETTINGS, Line

from jaxlfi.cli import train as train_command
from jaxlfi.rl import domains, fine_tuning, ppo, training
from jaxlfi.rl.environment import Signals
from jaxlfi.rl.policy import Policy, load

pytestmark = pytest.mark.usefixtures("keys_of_brax")

LINE = Line()
OTHER = Line(
    name="path",
    observations=Signals(("position", "goal"), ("m", "m"), (-0.3, 0.2), (0.7, 3.0)),
    actions=Signals(("push",), ("m",), (-0.2,), (1.1,)),
)


@pytest.fixture(scope="module")
def earlier():
    rng = np.random.default_rng(5)
    shapes = ((2, 8), (8, 8), (8, 1))
    weights = tuple(rng.normal(0, 0.6, shape).astype(np.float32) for shape in shapes)
    biases = tuple(rng.normal(0, 0.3, shape[1]).astype(np.float32) for shape in shapes)
    signals = {what: dataclasses.asdict(getattr(LINE, what)) for what in ("observations", "actions")}
    return Policy(weights, biases, {"environment": "line", **signals})


def test_it_does_the_same_in_another_scaling(earlier):
    seen = np.random.default_rng(0).normal(0, 1.5, (2000, 2))
    ours = fine_tuning.started(earlier, OTHER, SETTINGS)
    assert ours.acted["scale"] == (1.1,) and ours.observed["centre"] == (-0.3, 0.2)
    before, after = earlier(seen), ours(seen)
    inside = np.abs(before - 0.1) < 0.499  # of the earlier limits, which lie within the new ones
    assert 0.3 < inside.mean() < 1.0
    np.testing.assert_allclose(after[inside], before[inside], atol=2e-6)


def plan(start, environment=LINE, **changes):
    draws = {"uniform": lambda key, n: domains.uniform(key, environment.supports["initial"], n)}
    return training.Plan(None, environment, SETTINGS.replace(**changes), None, draws, (0, 5), start=start)


@pytest.mark.slow  # what they begin with is tested by itself
def test_trainings_begin_with_it(earlier, tmp_path):
    """One whose learning rate is zero ends with it, in its own scaling; and may be stopped."""
    out, seen = tmp_path / "run", np.random.default_rng(1).normal(0, 0.5, (200, 2))
    training.begin(plan(earlier, OTHER, learning_rate=0.0, total_steps=40), out)
    training.resumed(out, OTHER, lambda updates, curves: None)
    for seed in (0, 5):
        policy = load(out / f"uniform/seed_00{seed}/policy.npz")
        assert policy.schema["environment"] == "path"
        np.testing.assert_allclose(policy(seen), fine_tuning.started(earlier, OTHER, SETTINGS)(seen), atol=1e-6)
    assert not training.finished(tmp_path) and training.finished(out)


def test_what_was_learnt_since_is_learnt_from_it(earlier):
    layers = list(zip(earlier.weights, earlier.biases, strict=True))
    domain = domains.point(LINE.nominal, SETTINGS.environments)
    first, own = (ppo.init(jax.random.key(0), LINE, SETTINGS, domain, some) for some in (layers, None))
    jax.tree.map(np.testing.assert_array_equal, first.params.value, own.params.value)
    seen = np.random.default_rng(1).normal(0, 0.5, (100, 2)).astype(np.float32)
    np.testing.assert_allclose(ppo.as_file(LINE, first.params)(seen), earlier(seen), atol=1e-6)
    assert np.abs(ppo.as_file(LINE, own.params)(seen) - earlier(seen)).max() > 0.1


PULL, CENTIMETRES = (Signals((name,), (unit,), (0.1,), (0.5,)) for name, unit in (("pull", "m"), ("push", "cm")))


@pytest.mark.parametrize(
    ("actions", "hidden", "message"),
    [
        (PULL, (8, 8), r"start: policy: expected actions \['pull'\], got one of \['push'\]"),
        (CENTIMETRES, (8, 8), r"start: policy: expected units of actions \['cm'\], got one of \['m'\]"),
        (
            LINE.actions,
            (8, 4),
            "start: expected a policy with the settings' hidden layers, 8 4, got one with 8 8: --hid",
        ),
    ],
)
def test_a_policy_that_does_not_fit_is_refused(actions, hidden, message, earlier, tmp_path):
    environment, settings = dataclasses.replace(LINE, actions=actions), SETTINGS.replace(hidden=hidden)
    draws = {"median": lambda key, n: domains.point(LINE.nominal, n)}
    with pytest.raises(ValueError, match=f"^{message}"):
        training.begin(training.Plan(None, environment, settings, None, draws, (0,), start=earlier), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_the_command_takes_one(earlier, tmp_path, capsys):
    words = ["rl.toy:Line", "--domain", "uniform", "--preset", "quick", "--out", str(tmp_path / "run")]
    file = earlier.save(tmp_path / "policy.npz")
    assert train_command.main([*words, "--start", str(tmp_path / "none.npz")]) == 2
    assert "none.npz" in capsys.readouterr().err
    assert train_command.main([*words, "--start", str(file)]) == 2
    assert "--hidden 8 8" in capsys.readouterr().err and not (tmp_path / "run").exists()
