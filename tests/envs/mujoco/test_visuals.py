"""Models without their looks move as those with them, number for number."""

import time
import warnings

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

from jaxlfi.envs.mujoco import visuals
from jaxlfi.envs.mujoco.logs import Log
from jaxlfi.envs.mujoco.model_task import mujoco_task, specification
from jaxlfi.envs.mujoco.parameters import Parameter
from jaxlfi.envs.mujoco.simulator import simulator_of

TEXT = """
<mujoco><option timestep="0.002"/>
  <asset>{mesh}<mesh name="foot" vertex="0 0 0 .2 0 0 0 .1 0 0 0 .3"/>
    <texture name="paint" type="2d" builtin="checker" width="64" height="64" rgb1="1 0 0" rgb2="0 1 0"/>
    <material name="paint" texture="paint"/></asset>
  <default><default class="seen"><geom contype="0" conaffinity="0" material="paint" group="2"/></default></default>
  <worldbody><geom name="ground" type="plane" size="2 2 .1"/>
    <body name="leg" pos="0 0 0.6"><freejoint/><inertial pos="0 0.01 0" mass="1" diaginertia=".02 .03 .025"/>
      <geom name="shell" class="seen" type="mesh" mesh="hull"{shell}/><site name="eye" pos="0 0 .1" material="paint"/>
      <geom type="sphere" size=".1" pos="0 0 -.3" friction="0.4"/>
      <body name="toe" pos=".1 0 -.3"><joint name="hinge" axis="0 1 0" damping="0.05"/>
        <geom type="mesh" mesh="foot" mass="0.3"/><geom class="seen" type="mesh" mesh="hull" mass="0"/></body></body>
  </worldbody>
  <sensor><jointpos name="angle" joint="hinge"/>{sensor}</sensor>
</mujoco>
"""


def sphere(rings):
    """A closed surface of many triangles."""
    polar, round_it = np.linspace(0, np.pi, rings), np.linspace(0, 2 * np.pi, 2 * rings, endpoint=False)
    points = [
        (0.2 * np.sin(a) * np.cos(b), 0.2 * np.sin(a) * np.sin(b), 0.3 * np.cos(a)) for a in polar for b in round_it
    ]
    faces = []
    for i in range(rings - 1):
        for j in range(2 * rings):
            a, b = 2 * rings * i + j, 2 * rings * i + (j + 1) % (2 * rings)
            faces += [(a, a + 2 * rings, b), (b, a + 2 * rings, b + 2 * rings)]
    text = lambda rows, form: " ".join(format(number, form) for row in rows for number in row)
    return f'<mesh name="hull" vertex="{text(points, ".6g")}" face="{text(faces, "d")}"/>'


def text(rings=12, shell="", sensor=""):
    return TEXT.format(mesh=sphere(rings), shell=shell, sensor=sensor)


def stripped(xml, names=()):
    spec = specification(xml)
    return visuals.without(spec, spec.compile(), names), spec


def moved(model, steps=400):
    """States of a fall with a spin, and a contact."""
    data = mujoco.MjData(model)
    data.qvel[:] = [0.3, -0.1, 0, 1, -2, 3, 4]
    rows = []
    for _ in range(steps):
        mujoco.mj_step(model, data)
        rows.append(np.concatenate([data.qpos, data.qvel, [data.ncon]]))
    return np.array(rows)


def test_what_is_only_seen_is_left_out_and_the_motion_is_the_same_bit_for_bit():
    bare, spec = stripped(text())
    whole, model = spec.compile(), bare.compile()
    assert (whole.nmesh, whole.ngeom, whole.ntex, whole.nmat) == (2, 5, 1, 1)
    assert (model.nmesh, model.ngeom, model.ntex, model.nmat) == (1, 3, 0, 0)
    assert len(spec.meshes) == 2  # the specification that was given stays as it is
    expected = moved(whole)
    assert expected[:, -1].max() > 0 and np.ptp(expected[:, 2]) > 0.2
    np.testing.assert_array_equal(moved(model), expected)


@pytest.mark.parametrize(
    ("xml", "names"),
    [
        (text(shell=' contype="1" conaffinity="1"'), ()),
        (text().replace('<inertial pos="0 0.01 0" mass="1" diaginertia=".02 .03 .025"/>', ""), ()),  # carries inertia
        (text(), ("geom/shell/size[0]",)),
        (text(), ("geom/sh*/friction[0]",)),
        (text(sensor='<distance name="gap" geom1="shell" geom2="ground" cutoff="1"/>'), ()),
    ],
)  # fmt: skip
def test_meshes_that_matter_stay(xml, names):
    bare, _ = stripped(xml, names)
    assert bare.compile().nmesh == 2


@pytest.mark.parametrize("sensor", ['<rangefinder name="ray" site="eye"/>'])
def test_models_that_see_stay_whole(sensor):
    bare, spec = stripped(text(sensor=sensor))
    assert bare is spec


def test_models_without_looks_stay_what_they_are():
    spec = specification('<mujoco><worldbody><body><joint/><geom size="0.1"/></body></worldbody></mujoco>')
    assert visuals.without(spec, spec.compile(), ()) is spec


def test_inference_compiles_without_them_and_films_show_them():
    times = 0.01 * np.arange(40)
    xml = text(100)
    parameter = Parameter("joint/hinge/damping", (0.01, 0.2))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        own = simulator_of(mujoco_task(xml, [parameter], Log(times, {"angle": 0 * times}), noises={"angle": 0.1}))
    theta = np.array([0.11])
    assert own.model.nmesh == own.build(theta).nmesh == 1 and own.look(theta).nmesh == 2
    assert own.build(theta).dof_damping[6] == own.look(theta).dof_damping[6] == 0.11
    rows, outcome = own.clean(theta[None])
    assert outcome.tolist() == [0] and np.ptp(rows) > 0.01
    spent = []
    for make in (own.look, own.build):
        begun = time.process_time()
        make(theta), make(theta)
        spent.append(time.process_time() - begun)
    assert spent[1] < 0.3 * spent[0]
