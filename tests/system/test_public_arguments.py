"""Arguments of any type, shape and value for the public API: it works, or an error says what was expected."""

import concurrent.futures
import dataclasses

import jax
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import jaxlfi
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.space import Space
from jaxlfi.estimators.posterior import truncated
from jaxlfi.heuristics import hyperparameters as heuristics
from jaxlfi.runs import infer as inferring
from tests.small import SETTINGS, gaussian

EXAMPLES = 60
NUMBERS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 5),
    st.sampled_from([2**31, -(2**63), 10**30, 1e308, -0.0, 1e-320]),
    st.floats(),
)
TEXTS = st.one_of(
    st.text(max_size=5), st.sampled_from(["", "ok", "natural", "inference", "..", "/", "[x]", "a\nb", "\0", "\ud800"])
)
ARRAYS = st.builds(
    lambda shape, kind, value: np.full(shape, value).astype(kind),
    st.sampled_from([(), (0,), (1,), (2,), (3,), (2, 2), (0, 2), (1, 1, 1)]),
    st.sampled_from(["f4", "f8", "i4", "?", "U3", "c8", "O", "f2"]),
    st.sampled_from([0, 1, -1, 3]),
) | st.sampled_from([np.full(2, np.nan), np.full(2, np.inf), np.array([1.0, np.nan]), np.full(2, 1e38)])  # fmt: skip
ANYTHING = st.recursive(
    st.one_of(NUMBERS, TEXTS, ARRAYS, st.binary(max_size=3), st.builds(object), st.just(len), st.just(dict),
    st.just(jaxlfi.QUICK)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.lists(inner, max_size=3).map(tuple), st.dictionaries(TEXTS, inner, max_size=2)
    ),
    max_leaves=4,
)  # fmt: skip


class ReachedError(Exception):
    """The arguments were accepted: the run would begin."""


def right_or_refused(call, *args, **kwargs):
    """Call, and let nothing pass but a result and errors that say what was expected."""
    try:
        return call(*args, **kwargs)
    except ReachedError:
        return None
    except (ValueError, TypeError) as error:
        assert "expected" in str(error), f"{type(error).__name__}: {error}"
    return None


@given(ANYTHING, ANYTHING)
@settings(max_examples=2 * EXAMPLES)
@example([1.0, 2.0], [0.0, 3.0])
@example([0.0, np.nan], [1.0, 2.0])
@example(["a"], ["b"])
def test_boxes(low, high):
    right_or_refused(jaxlfi.Support, low, high)


@given(ANYTHING, ANYTHING)
@settings(max_examples=EXAMPLES)
def test_spaces(names, log):
    right_or_refused(Space, names, log)


FIELDS = [field.name for field in dataclasses.fields(jaxlfi.Settings)]


@given(st.sampled_from(FIELDS), ANYTHING)
@settings(max_examples=3 * EXAMPLES)
def test_settings(name, value):
    right_or_refused(lambda: jaxlfi.QUICK.replace(**{name: value}).check())


@given(
    st.sampled_from([jaxlfi.MixtureNetwork, jaxlfi.MaskedFlow, jaxlfi.SplineFlow, jaxlfi.MixtureLikelihood]), st.data()
)
@settings(max_examples=3 * EXAMPLES)
def test_estimators(kind, data):
    name = data.draw(st.sampled_from([field.name for field in dataclasses.fields(kind)]))
    value = data.draw(ANYTHING)
    right_or_refused(lambda: jaxlfi.QUICK.replace(estimator=kind(**{name: value})).check())


@given(st.sampled_from([jaxlfi.Edge, jaxlfi.Mode, jaxlfi.Truncate, jaxlfi.Matched]), st.data())
@settings(max_examples=3 * EXAMPLES)
def test_heuristics(kind, data):
    name = data.draw(st.sampled_from([field.name for field in dataclasses.fields(kind)]))
    value = data.draw(ANYTHING)
    right_or_refused(lambda: heuristics.check(kind(**{name: value}), 2))


TASK = {
    "simulate": lambda key, theta: theta,
    "name": "task",
    "names": ("first", "second"),
    "supports": {"ok": jaxlfi.Support([-3.0, -3.0], [3.0, 3.0])},
    "feasible": jaxlfi.Support([-4.0, -4.0], [4.0, 4.0]),
    "truth": np.array([1.0, -0.5]),
}
TASK_FIELDS = [field.name for field in dataclasses.fields(jaxlfi.Task) if field.init]


@given(st.sampled_from(TASK_FIELDS), ANYTHING)
@settings(max_examples=5 * EXAMPLES)
def test_tasks(name, value):
    right_or_refused(jaxlfi.Task, **TASK | {name: value})


COMMAND = {
    "template": "echo [{theta}, {seed}]",
    "names": ("a", "b"),
    "supports": TASK["supports"],
    "feasible": TASK["feasible"],
}


@given(st.sampled_from(["template", "names", "supports", "feasible", "timeout", "channels", "name"]), ANYTHING)
@settings(max_examples=2 * EXAMPLES)
def test_tasks_of_commands(name, value):
    right_or_refused(jaxlfi.Task.from_command, **COMMAND | {name: value})


@given(st.sampled_from(["each", "timeout", "executor"]), ANYTHING)
@settings(max_examples=EXAMPLES)
def test_host_simulators(name, value):
    right_or_refused(jaxlfi.HostSimulator, lambda rng, theta: theta, **{"each": True} | {name: value})


@given(st.one_of(TEXTS, ANYTHING))
@settings(max_examples=EXAMPLES)
def test_folders_of_runs(folder):
    right_or_refused(jaxlfi.load, folder)


@given(ANYTHING, ANYTHING)
@settings(max_examples=EXAMPLES)
def test_trials(count, pooling):
    right_or_refused(jaxlfi.repeated, gaussian(), count, pooling)


@given(ANYTHING, ANYTHING)
@settings(max_examples=EXAMPLES)
def test_presets(method, preset):
    right_or_refused(jaxlfi.settings_for, gaussian(), method, preset)


ARGUMENTS = (
    "key", "task", "observation", "support", "heuristic", "settings", "space", "simulations", "executor",
    "simulation_timeout",
)  # fmt: skip


@given(st.sampled_from(ARGUMENTS), ANYTHING)
@settings(max_examples=4 * EXAMPLES)
@example("support", jaxlfi.Support([-3.0, -3.0, 0.0], [3.0, 3.0, 1.0]))
@example("simulations", {"theta": np.zeros((3, 2)), "trajectory": np.full((3, 2), np.nan)})
@example("simulations", {"theta": [["a", "b"]] * 3, "x": np.zeros((3, 2))})
@example("executor", concurrent.futures.ThreadPoolExecutor(1))
def test_inference(name, value):
    def accepted(*_, **__):
        raise ReachedError

    arguments = {"key": jax.random.key(0), "task": gaussian(), "settings": SETTINGS} | {name: value}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inferring.executing, "execute", accepted)
        right_or_refused(jaxlfi.infer, **arguments)


@pytest.fixture(scope="module")
def posterior():
    mixture = GaussianMixture(*map(jax.numpy.asarray, (np.zeros(1), np.zeros((1, 2)), np.eye(2)[None])))
    return truncated(mixture, mixture, jaxlfi.Support([-3.0, -3.0], [3.0, 3.0]), Space(("a", "b"), (False, False)))


@given(st.sampled_from(["key", "n", "space"]), ANYTHING)
@settings(max_examples=EXAMPLES)
def test_draws(posterior, name, value):
    right_or_refused(posterior.sample, **{"key": jax.random.key(0), "n": 3} | {name: value})


@given(st.one_of(ARRAYS, st.lists(st.one_of(NUMBERS, ARRAYS), max_size=3)), TEXTS)
@settings(max_examples=EXAMPLES)
def test_densities(posterior, theta, space):
    right_or_refused(posterior.log_prob, theta)
    right_or_refused(posterior.log_prob, [0.0, 0.0], space)
