"""Task: natural units and inference space, named supports and Phi, equality, and what a declaration is refused for."""

import dataclasses
import functools

import distrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlfi.distributions.support import Support
from jaxlfi.tasks import summaries
from jaxlfi.tasks.host import HostSimulator
from jaxlfi.tasks.task import Task


def simulate(key, theta):
    return theta


def make(**changes) -> Task:
    """Three parameters, the first and the last of them in logarithms."""
    arguments = {
        "simulate": simulate,
        "names": ("mass", "offset", "drag"),
        "units": ("kg", "m", ""),
        "supports": {
            "guess": Support([1.0, -2.0, 0.5], [4.0, 3.0, 8.0]),
            "wide": Support([0.01, -30.0, 0.1], [400.0, 3.0, 16.0]),
        },
        "feasible": Support([0.1, -5.0, 0.25], [10.0, 5.0, 16.0]),
        "log": ("drag", "mass"),
        "truth": [2.0, -1.0, 1.0],
    }
    return Task(**(arguments | changes))


def test_declarations_stay_in_natural_units():
    task = make()
    assert task.dim == 3 and task.names == ("mass", "offset", "drag")
    np.testing.assert_allclose(task.feasible.low, [0.1, -5.0, 0.25], rtol=1e-6)
    np.testing.assert_array_equal(task.supports["guess"].high, [4.0, 3.0, 8.0])
    np.testing.assert_array_equal(task.truth, [2.0, -1.0, 1.0])
    assert isinstance(task.truth, np.ndarray) and task.truth.dtype == np.float32
    assert task.units == ("kg", "m", "")


def test_the_inference_view_holds_them_in_inference_space():
    task = make()
    assert task.space.labels == ("ln mass", "offset", "ln drag")
    view = task.inference
    np.testing.assert_allclose(view.feasible.low, [np.log(0.1), -5.0, np.log(0.25)], rtol=1e-6)
    np.testing.assert_allclose(view.supports["guess"].high, [np.log(4.0), 3.0, np.log(8.0)], rtol=1e-6)
    np.testing.assert_allclose(view.truth, [np.log(2.0), -1.0, 0.0], rtol=1e-6)
    assert list(view.supports) == ["guess", "wide"] and view.prior is None
    assert make(truth=None).inference.truth is None


def test_the_inference_view_may_be_made_while_tracing():
    """It is kept: nothing of the trace may stay in it."""
    task = make()
    jax.jit(lambda theta: task.inference.feasible.to_unit(theta))(jnp.zeros(3))
    np.testing.assert_allclose(task.inference.feasible.low, [np.log(0.1), -5.0, np.log(0.25)], rtol=1e-6)


def test_without_logs_inference_space_is_natural():
    task = make(log=())
    assert task.space.labels == task.names
    np.testing.assert_array_equal(task.inference.supports["guess"].low, [1.0, -2.0, 0.5])
    np.testing.assert_array_equal(task.inference.truth, [2.0, -1.0, 1.0])


def test_replacing_takes_no_logarithm_twice():
    """Any number of times; boxes, truth and prior stay what was declared."""
    task = make()
    again = dataclasses.replace(dataclasses.replace(task, name="other"), name="task")
    assert again == task
    for box, same in ((again.feasible, task.feasible), (again.inference.feasible, task.inference.feasible)):
        np.testing.assert_array_equal(box.low, same.low)
        np.testing.assert_array_equal(box.high, same.high)
    np.testing.assert_array_equal(again.inference.truth, task.inference.truth)
    plain = dataclasses.replace(task, log=())
    assert plain.space.labels == task.names
    np.testing.assert_array_equal(plain.inference.feasible.low, np.float32([0.1, -5.0, 0.25]))


def test_names_of_their_own_survive():
    """A name that begins with "ln " is no logarithm, and one with a comma is one name."""
    box = Support([-3.0, 0.5], [1.0, 1.0])
    task = Task(simulate, ("ln k", "c,d"), {"s": box}, box, truth=[-1.0, 0.75])
    assert task.space.log == (False, False) and task.space.labels == ("ln k", "c,d")
    np.testing.assert_array_equal(task.inference.feasible.low, [-3.0, 0.5])
    np.testing.assert_array_equal(task.space.to_natural(task.inference.truth), [-1.0, 0.75])
    logged = dataclasses.replace(task, log=("c,d",))
    assert logged.space.labels == ("ln k", "ln c,d")
    np.testing.assert_allclose(logged.inference.feasible.low, [-3.0, np.log(0.5)], rtol=1e-6)


# ----------------------------------------------------------------------------------------------------- equality


def noisy(key, theta, scale):
    return theta * scale


def prior(mean: float = 0.0):
    return distrax.MultivariateNormalDiag(jnp.array([1.0, mean, 1.0]), jnp.ones(3))


def test_tasks_of_equal_content_are_equal_and_hash_alike():
    arrays = lambda: {"observation": np.arange(3.0), "times": jnp.arange(3.0), "prior": prior()}
    whole = lambda: make(simulate=functools.partial(noisy, scale=jnp.array([1.0, 2.0, 3.0])), **arrays())
    for same in (make, whole, lambda: make(simulate=HostSimulator(simulate))):
        first, second = same(), same()
        assert first is not second
        assert first == second and hash(first) == hash(second)
        assert len({first, second}) == 1


@pytest.mark.parametrize(
    "changes",
    [
        {"name": "other"},
        {"log": ("drag",)},
        {"simulate": lambda key, theta: theta},
        {"simulate": HostSimulator(simulate)},
        {"summary": lambda trajectory: trajectory},
        {"truth": [2.0, -1.0, 1.5]},
        {"truth": None},
        {"observation": np.arange(4.0)},
        {"observation": np.arange(3)},
        {"times": np.arange(3.0) + 1},
        {"prior": prior(0.5)},
        {"prior": None},
        {"prior": distrax.Independent(distrax.Laplace(jnp.zeros(3), jnp.ones(3)), 1)},
        {"prior_space": "inference"},
        {"supports": {"guess": Support([1.0, -2.0, 0.5], [4.0, 3.0, 8.0])}},
        {"feasible": Support([0.1, -5.0, 0.25], [10.0, 5.5, 16.0])},
        {"settings": {"rounds": 3}},
        {"failures": ("fell",)},
    ],
)
def test_tasks_of_other_content_differ(changes):
    known = {"observation": np.arange(3.0), "times": np.arange(3.0), "prior": prior()}
    assert make(**known) != make(**(known | changes))


def test_partials_are_compared_by_what_they_hold():
    one = make(simulate=functools.partial(noisy, scale=jnp.ones(3)))
    assert one == make(simulate=functools.partial(noisy, scale=jnp.ones(3)))
    assert one != make(simulate=functools.partial(noisy, scale=2 * jnp.ones(3)))
    assert one != make(simulate=functools.partial(simulate, scale=jnp.ones(3)))
    assert one != "task"


def test_a_task_made_again_finds_its_compiled_programs():
    compiled = jax.jit(lambda task, theta: task.space.to_natural(theta), static_argnums=0)
    compiled(make(), jnp.zeros(3))
    before = compiled._cache_size()
    compiled(dataclasses.replace(make()), jnp.ones(3))
    assert compiled._cache_size() == before


# --------------------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"units": ("kg", "m")}, r"^units: expected one for each of the 3 parameters, got 2"),
        (
            {"names": ("mass", "mass", "drag")},
            r"^names: expected at least one name, each once, got \('mass', 'mass', 'drag'\)",
        ),
        ({"log": ("drag", "speed")}, r"^log: expected names among \('mass'.*got \['speed'\]"),
        (
            {"feasible": Support([0.1, 1.0], [10.0, 5.0])},
            r"^feasible: expected bounds for 3 parameters, got 2",
        ),
        ({"supports": {}}, r"^supports: expected at least one named support, got none"),
        (
            {"supports": {"guess": Support([1.0], [4.0])}},
            r"^supports\['guess'\]: expected bounds for 3 parameters, got 1",
        ),
        (
            {"supports": {"guess": Support([1.0], [4.0])}, "log": ()},
            r"^supports\['guess'\]: expected bounds for 3 parameters, got 1",
        ),
        (
            {"supports": {"a": Support([1.0, -2.0, 0.0], [4.0, 3.0, 8.0])}},
            r"^supports\['a'\]: expected positive bounds for the log parameters \('drag', 'mass'\), got",
        ),
        (
            {"feasible": Support([-1.0, -5.0, 0.25], [10.0, 5.0, 16.0])},
            r"^feasible: expected positive bounds for the log parameters",
        ),
        (
            {"feasible": Support(jnp.array([0.1, 6.0, 0.2]), jnp.array([10.0, 5.0, 16.0])), "log": ()},
            r"expected low < high .* dimension \[1\]",
        ),
        ({"truth": [1.0, 2.0]}, r"^truth: expected 3 finite numbers, got shape \(2,\)"),
        ({"truth": [1.0, np.nan, 1.0]}, r"^truth: expected 3 finite numbers"),
        ({"truth": [1.0, 2.0, 0.0]}, r"^truth: expected positive values of the log parameters"),
        ({"names": "abc"}, r"^names: expected a sequence of names, got the string 'abc'"),
        ({"log": "drag"}, r"^log: expected a sequence of names, got the string 'drag'"),
        ({"names": (), "units": (), "log": (), "truth": None}, r"^names: expected at least one name"),
        ({"simulate": "spring"}, r"^simulate: expected a function, got str"),
        ({"feasible": ([0, 0, 0], [1, 1, 1])}, r"^feasible: expected a jaxlfi.Support, got tuple"),
        ({"supports": {"guess": [0, 1]}}, r"^supports\['guess'\]: expected a jaxlfi.Support, got list"),
        ({"prior_space": "log"}, r"^space: expected 'natural' or 'inference', got 'log'"),
        ({"summary": "nine"}, r"^summary: expected one of \['identity', 'series'\], got 'nine'"),
    ],
)
def test_bad_declarations_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        make(**changes)


@pytest.mark.parametrize("label", ["a/../../zz", "a+b", "", "../up", "a\\b", ".hidden", "/root", "a:b"])
def test_supports_that_could_not_name_a_folder_are_refused(label):
    with pytest.raises(ValueError, match=r"^supports: expected names of letters, digits, .* got") as caught:
        make(supports={label: make().supports["guess"]})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("label", ["ok", "Theta_0", "a.b-c d", "breit", "größer"])
def test_supports_have_names_of_letters_digits_and_a_few_signs(label):
    assert list(make(supports={label: make().supports["guess"]}).supports) == [label]


def test_a_plain_parameter_may_be_zero_or_negative_where_others_are_logs():
    task = make(truth=[1.0, 0.0, 1.0])
    np.testing.assert_allclose(task.inference.truth, [0.0, 0.0, 0.0], atol=1e-7)


class Scipylike:
    """Has `rvs`, as SciPy's frozen distributions do, and no `sample`."""

    def rvs(self, n):
        return np.zeros((n, 3))


class Breaking:
    """Its draws raise."""

    def sample(self, *, seed, sample_shape):
        raise RuntimeError("no\ndraws")

    def log_prob(self, theta):
        return theta.sum(-1)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ("uniform", "got str$"),
        (Scipylike(), "got Scipylike$"),
        (distrax.Normal(0.0, 1.0), "got draws of shape"),
        (distrax.Normal(jnp.zeros(3), jnp.ones(3)), r"log-densities of shape \[3\] \(distrax.Independent makes one"),
        (distrax.MultivariateNormalDiag(jnp.zeros(2), jnp.ones(2)), "got "),
        (distrax.MultivariateNormalDiag(jnp.zeros(4), jnp.ones(4)), "got "),
        (Breaking(), "got Breaking: no$"),
    ],
)
def test_wrong_priors_are_refused_in_one_line(wrong, message):
    expected = r"^prior: expected a distrax distribution over vectors of 3 parameters"
    with pytest.raises(ValueError, match=f"{expected}, .*{message}") as error:
        make(prior=wrong)
    assert "\n" not in str(error.value)


def test_right_priors_are_taken():
    for right in (prior(), distrax.Independent(distrax.Normal(jnp.zeros(3), jnp.ones(3)), 1)):
        assert make(prior=right).prior is right


# --------------------------------------------------------------------------------------------------- supports


def test_supports_by_name_by_default_and_own():
    """Named and natural boxes come back in inference space; one that is in inference space comes back as it is."""
    task = make()
    assert task.support() is task.inference.supports["guess"]
    assert task.support("wide") is task.inference.supports["wide"]
    own = task.support(Support([1.0, -5.0, 0.5], [2.0, 5.0, 1.0]))
    np.testing.assert_allclose(own.low, [0.0, -5.0, np.log(0.5)], rtol=1e-6)
    np.testing.assert_allclose(own.high, [np.log(2.0), 5.0, 0.0], rtol=1e-6, atol=1e-7)
    inner = Support([-2.0, -5.0, -1.0], [2.0, 5.0, 1.0])
    assert task.support(inner, space="inference") is inner
    np.testing.assert_array_equal(task.support(task.feasible).low, task.inference.feasible.low)
    with pytest.raises(ValueError, match=r"^support: expected one of \['guess', 'wide'\] or a box .* got 'narrow'"):
        task.support("narrow")
    with pytest.raises(ValueError, match=r"^support: expected one of .* got \(\[0, 0, 0\], \[1, 1, 1\]\)"):
        task.support(([0, 0, 0], [1, 1, 1]))


@pytest.mark.parametrize(
    ("box", "space", "message"),
    [
        (Support([0.5, -5.1, 0.5], [2.0, 5.0, 1.0]), "natural", r"inside .* Phi; in dimension 1 it is \[-5.1, 5\]"),
        (Support([-2.0, -5.1, -1.0], [2.0, 5.0, 1.0]), "inference", r"inside .* Phi; in dimension 1 it is \[-5.1, 5\]"),
        (Support([-2.0, 0.0, 0.5], [2.0, 5.0, 1.0]), "natural", r"^support: expected positive bounds for the log"),
        (Support([0.5, 0.0], [2.0, 5.0]), "natural", r"^support: expected bounds for 3 parameters, got 2"),
        (Support([0.5, 0.0], [2.0, 5.0]), "inference", r"^support: expected bounds for 3 parameters, got 2"),
        (Support(jnp.array([1.0, 2.0, 1.0]), jnp.array([2.0, 1.0, 2.0])), "natural", r"low < high"),
        (Support([1.0, 0.0, 0.5], [2.0, 5.0, 1.0]), "log", r"^space: expected 'natural' or 'inference', got 'log'"),
    ],
)
def test_own_boxes_are_checked(box, space, message):
    with pytest.raises(ValueError, match=message):
        make().support(box, space=space)


def test_a_named_support_may_be_wider_than_phi():
    """The paper's "broadest" is; the same box as one's own is refused."""
    wide = make().supports["wide"]
    assert float(wide.low[1]) == -30.0
    assert float(make().support("wide").low[1]) == -30.0
    with pytest.raises(ValueError, match="feasible domain Phi"):
        make().support(Support(wide.low, wide.high))


def test_reasons_end_with_non_finite():
    assert make().reasons == ("failed", "non_finite")
    assert make(failures=("diverged", "timeout")).reasons == ("diverged", "timeout", "non_finite")


def test_units_default_to_none_and_the_summary_to_the_trajectory():
    task = make(units=None)
    assert task.units == ("", "", "")
    np.testing.assert_array_equal(task.summary(jnp.array([[1.0, 2.0], [3.0, 4.0]])), [1.0, 2.0, 3.0, 4.0])
    assert task.summary is summaries.SUMMARIES["identity"]
    total = lambda trajectory: trajectory.sum(keepdims=True)
    assert make(summary=total).summary is total


def test_summaries_are_named_once_each():
    assert make().named_summaries(2) == ("x_1", "x_2")
    assert make(summary_names=("mean", "slope")).named_summaries(2) == ("mean", "slope")
    with pytest.raises(ValueError, match=r"^summary_names: expected one for each of the summary's 3 numbers, got 2"):
        make(summary_names=("mean", "slope")).named_summaries(3)


def test_a_host_simulator_is_known():
    assert make(simulate=HostSimulator(simulate)).on_host and not make().on_host
