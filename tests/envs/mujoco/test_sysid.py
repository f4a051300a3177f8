"""Tasks of what a user of `mujoco.sysid` has."""

import numpy as np
import pytest

pytest.importorskip("mujoco")

import mujoco
from envs_mujoco import ARM, recorded

from jaxlfi.envs.mujoco.sysid import from_sysid

sysid = pytest.importorskip("mujoco.sysid")
if not hasattr(sysid, "Parameter"):
    pytest.skip("needs mujoco[sysid], of the extra bench", allow_module_level=True)

NAMES = ("angle", "velocity[0]", "velocity[1]", "velocity[2]")
QUIET = {"angle": 0.0, "velocity": 0.0}


def damping(spec, parameter):
    for joint, number in zip(("shoulder", "elbow"), parameter.value, strict=True):
        spec.joint(joint).damping[0] = number


def length(spec, parameter):
    spec.body("fore").pos[2] = -parameter.value[0]


def arm(*logs, start=(0.0, 0.0)):
    """The parameters and sequences of recordings."""
    spec = mujoco.MjSpec.from_string(ARM)
    model = spec.compile()
    series = lambda log, names: sysid.TimeSeries(log.times, np.stack([log.signals[name] for name in names], axis=1))
    state = sysid.create_initial_state(model, np.array(start))
    sequences = sysid.ModelSequences(
        "arm", spec, [f"swing {i}" for i in range(len(logs))], [state] * len(logs),
        [series(log, ["motor"]) for log in logs], [series(log, NAMES) for log in logs],
    )  # fmt: skip
    parameters = sysid.ParameterDict()
    parameters.add(sysid.Parameter("damping", [0.08, 0.03], [0.01, 0.001], [0.5, 0.2], modifier=damping))
    parameters.add(sysid.Parameter("length", 0.4, 0.3, 0.5, modifier=length))
    parameters.add(sysid.Parameter("gear", 1.5, 1.0, 2.0, frozen=True))
    return parameters, sequences


def test_the_same_bounds_recordings_and_simulations():
    log, second = recorded(start=(0.2, -0.1)), recorded(start=(0.2, -0.1), count=40)
    parameters, sequences = arm(log, second, start=(0.2, -0.1))
    task = from_sysid(
        parameters, sequences, feasible={"damping[1]": (1e-4, 1.0)}, log=["damping[0]", "damping[1]"],
        units={"length": "m"}, noise=QUIET,
    )  # fmt: skip
    assert task.name == "arm" and task.names == ("damping[0]", "damping[1]", "length")
    assert task.units == ("", "", "m") and task.log == ("damping[0]", "damping[1]")
    assert task.simulate.function.signals == NAMES
    np.testing.assert_allclose(task.supports["initial"].low, [0.01, 0.001, 0.3], rtol=1e-6)
    np.testing.assert_allclose(task.feasible.high, [0.5, 1.0, 0.5], rtol=1e-6)
    rows, outcome = task.simulate.function.clean([[0.08, 0.03, 0.4], [0.3, 0.03, 0.4]])
    expected = np.concatenate([np.stack([one.signals[name] for name in NAMES], axis=1) for one in (log, second)])
    np.testing.assert_allclose(rows[0], expected, atol=1e-9)
    np.testing.assert_allclose(task.observation, expected, atol=1e-6)
    assert not outcome.any() and np.abs(rows[1] - rows[0]).max() > 0.1
    assert parameters["damping"].value.tolist() == [0.08, 0.03]  # theirs stay as they are


def test_a_model_of_their_own_making():
    parameters, sequences = arm(recorded())
    built = []

    def build(own, spec):
        built.append(own["length"].value[0])
        return sysid.apply_param_modifiers(own, spec)

    own = from_sysid(parameters, sequences, build, noise=QUIET).simulate.function
    plain = from_sysid(parameters, sequences, noise=QUIET).simulate.function
    theta = [[0.1, 0.05, 0.45]]
    np.testing.assert_array_equal(own.clean(theta)[0], plain.clean(theta)[0])
    assert built == [0.45]


def test_noise_is_estimated_where_it_is_not_given():
    log = recorded(count=400)
    rng = np.random.default_rng(0)
    signals = {
        name: values + 0.05 * (name != "motor") * rng.standard_normal(400) for name, values in log.signals.items()
    }
    parameters, sequences = arm(type(log)(log.times, signals))
    task = from_sysid(parameters, sequences, noise={"velocity": 0.01})
    assert task.simulate.function.noise[0] == pytest.approx(0.05, rel=0.4)
    assert task.simulate.function.noise[1:].tolist() == [0.01] * 3


def test_what_does_not_fit():
    parameters, sequences = arm(recorded())
    with pytest.raises(ValueError, match=r"expected some of damping\[0\], damping\[1\], length, got damping"):
        from_sysid(parameters, sequences, log=["damping"], noise=QUIET)
    for one in parameters.values():
        one.frozen = True
    with pytest.raises(ValueError, match="expected one that is not frozen, got none"):
        from_sysid(parameters, sequences, noise=QUIET)
