"""Features that MJX ignores are refused by name: all options, flags and fields of MuJoCo are known."""

import re
import warnings
from pathlib import Path

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")
mjx = pytest.importorskip("mujoco.mjx")

import jax

from jaxlfi.envs.mujoco import mjx_ignored
from jaxlfi.envs.mujoco.logs import Log
from jaxlfi.envs.mujoco.mjx_ignored import (
    DISABLED,
    ELEMENTS,
    ENABLED,
    OPTIONS,
    READ,
    MjxWarning,
    refuse_ignored,
    warn_of_saturation,
)
from jaxlfi.envs.mujoco.model_task import mujoco_task
from jaxlfi.envs.mujoco.parameters import Parameter

SOURCE = "".join(
    (Path(mjx.__file__).parent / f"_src/{name}.py").read_text()
    for name in "forward passive smooth constraint solver collision_convex collision_driver collision_primitive "
    "collision_sdf collision_types sensor support derivative scan ray mesh math".split()
)
"""Of MJX, but for the modules that copy a model's fields."""
LAYOUT = re.compile(
    "n[A-Za-z0-9]+(_map)?|nuser_.*|plugin|name_.*adr|names(_map)?|paths|signature|vis|stat|.*_user|.*_group|(hfield|mesh|skin|tex)_pathadr|"
    "(flex|flexedge|flexvert|skin|light|mat|tex|text|bvh|oct|plugin|tuple|key|tree|efm0|efmC)_.*|mat_.*|"
    "mesh_(bvh|oct|normal|texcoord|poly|facenormal|facenum|facetexcoord|scale|extrema|pos|quat|vertnum).*|"
    "(B|D|ten_J)_.*|map[DM]2[DM]|body_(bvh|jnt|contype|conaffinity|margin|sameframe|simple|treeid).*|"
    "(cam|tendon|site)_(ipd|output|projection|width|matid|rgba|treeid|treenum|dataid|sameframe)|"
    "dof_(length|Madr|M0|simplenum|treeid)|geom_(aabb|sameframe)|numeric_(adr|size)|pair_signature|eq_active0|"
    ".*_actuatorid|actuator_(history|historyadr|length0|ctrladr|ctrlnum|ctrlspec|outadr|outnum|cranklength|plugin)|"
    "sensor_(history|historyadr|noise)|flg_(adhesion|surfacevel|gravcomp)|opt"
)
"""Fields of models for pictures, names and memory, and those that follow from others or come with what MJX refuses."""


def model(
    option="", flag="", joint="", actuator="", geom="", besides="", sensor='<jointpos name="angle" joint="hinge"/>'
):
    return f"""<mujoco><option timestep="0.005" {option}><flag {flag}/></option><worldbody>
      <geom name="floor" type="plane" size="5 5 0.1" pos="0 0 -1"/>
      <body name="rod"><joint name="hinge" axis="0 1 0" {joint}/>
      <geom name="rod" type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="1" {geom}/>
      <site name="tip" pos="0.3 0 0"/></body></worldbody>
      <actuator><general name="motor" joint="hinge" {actuator}/></actuator>
      <sensor>{sensor}</sensor>{besides}</mujoco>"""


CYLINDER = {"geom": 'type="cylinder"'}
TENDON = '<tendon><fixed name="cord" {}><joint joint="hinge" coef="1"/></fixed></tendon>'
IGNORED = {
    "option/noslip_iterations": {"option": 'noslip_iterations="3"'},
    "option/noslip_iterations, option/noslip_tolerance": {"option": 'noslip_iterations="3" noslip_tolerance="1e-3"'},
    "option/ccd_iterations": {"option": 'ccd_iterations="9"', **CYLINDER},
    "option/ccd_tolerance": {"option": 'ccd_tolerance="1e-3"', **CYLINDER},
    "option/actuatorgroupdisable": {"option": 'actuatorgroupdisable="2"', "actuator": 'group="2"'},
    'flag spring="disable"': {"flag": 'spring="disable"', "joint": 'damping="1"'},
    'flag damper="disable"': {"flag": 'damper="disable"', "joint": 'stiffness="9"'},
    'flag multiccd="disable"': {"flag": 'multiccd="disable"', **CYLINDER},
    'flag nativeccd="disable"': {"flag": 'nativeccd="disable"', **CYLINDER},
    'flag sleep="enable"': {"flag": 'sleep="enable"'},
    "stiffnesspoly of joint hinge": {"joint": 'stiffness="5 30 30"'},
    "dampingpoly of joint hinge": {"joint": 'damping="0.1 0.5 0.5"'},
    "stiffnesspoly of tendon cord": {"besides": TENDON.format('stiffness="5 30 30"')},
    "dampingpoly of tendon cord": {"besides": TENDON.format('damping="0.1 0.5"')},
    "armature of actuator motor": {"actuator": 'armature="1"'},
    "damping of actuator motor": {"actuator": 'damping="1"'},
    "delay of actuator motor": {"actuator": 'delay="0.05" nsample="20"'},
    "actearly of actuator motor": {"actuator": 'dyntype="filter" dynprm="0.1" actearly="true"'},
    "delay of sensor angle": {"sensor": '<jointpos name="angle" joint="hinge" delay="0.05" nsample="20"/>'},
    "interval of sensor angle": {"sensor": '<jointpos name="angle" joint="hinge" interval="0.05" nsample="2"/>'},
    "cutoff of sensor 1": {
        "sensor": '<jointpos name="angle" joint="hinge"/><framelinacc objtype="site" objname="tip" cutoff="1"/>'
    },
    "fluidshape of geom rod": {"option": 'density="900"', "geom": 'fluidshape="ellipsoid"'},
    "gap of geom rod": {"geom": 'gap="0.01"'},
    "adhesion of geom rod": {"geom": 'adhesion="3"'},
    "surfacevel of geom rod": {"geom": 'surfacevel="1 0 0"'},
}
READ_BY_MJX = [
    {"option": 'ccd_iterations="9" sdf_iterations="3" noslip_tolerance="1e-3" sleep_tolerance="0.1" o_margin="0.1"'},
    {"option": 'density="900" viscosity="0.1" wind="1 0 0"'},
    {"option": 'actuatorgroupdisable="2"', "actuator": 'group="1"'},
    {"flag": 'midphase="disable" island="disable" autoreset="disable" multiccd="disable" eulerdamp="disable"'},
    {"flag": 'gravity="disable" contact="disable" limit="disable" frictionloss="disable" clampctrl="disable"'},
    {"geom": 'fluidshape="ellipsoid" margin="0.01"', "joint": 'stiffness="3" damping="1" armature="0.1"'},
    {"besides": TENDON.format('stiffness="3" damping="1"'), "actuator": 'dyntype="filter" dynprm="0.1"'},
]


def compiled(**changes):
    xml = model(**changes)
    if "cylinder" in xml:
        xml = xml.replace('type="capsule"', "", 1)
    return mujoco.MjModel.from_xml_string(xml)


@pytest.mark.parametrize("name", IGNORED)
def test_what_is_ignored_is_named(name):
    with pytest.raises(ValueError) as refusal:
        refuse_ignored(compiled(**IGNORED[name]))
    assert str(refusal.value) == f"model: MJX cannot simulate it: it ignores or misreads {name}"


@pytest.mark.parametrize("changes", READ_BY_MJX)
def test_what_is_read_or_makes_no_difference_passes(changes):
    refuse_ignored(compiled(**changes))


def test_options_of_a_later_release_are_refused(monkeypatch):
    """An option and a flag that no table knows."""
    for table, name in ((OPTIONS, "noslip_tolerance"), (DISABLED, "island")):
        monkeypatch.delitem(table, name)
    with pytest.raises(ValueError, match='misreads option/noslip_tolerance, flag island="disable"'):
        refuse_ignored(compiled(option='noslip_tolerance="1e-3"', flag='island="disable"'))


def test_every_option_is_known():
    """A new one of MuJoCo fails here until it is looked up in MJX; what is said to be read stands in MJX's sources."""
    assert set(mjx_ignored.option_names()) == READ | set(OPTIONS) and not READ & set(OPTIONS)
    for kind, table in ((mujoco.mjtDisableBit, DISABLED), (mujoco.mjtEnableBit, ENABLED)):
        assert sorted(mjx_ignored.flag_names(kind).values()) == sorted(table)
    public = {field.name for field in mjx.Option.fields()} | {"sdf_initpoints"}
    assert READ <= public
    for name in READ - {"enableflags", "density", "viscosity", "wind"}:
        assert re.search(rf"opt\.(_impl\.)?{name}\b", SOURCE), name
    never = {name for name, matters in DISABLED.items() if matters is mjx_ignored._never}
    for name in never - {"midphase", "autoreset", "island"}:
        assert re.search(rf"DisableBit\.{name.upper()}\b", SOURCE), name


def test_every_field_of_a_model_is_known():
    """A new one fails here until it is looked up in MJX."""
    plain = compiled()
    fields = [name for name in dir(plain) if not name.startswith("_") and not callable(getattr(plain, name))]
    fields = [name for name in fields if isinstance(getattr(plain, name), np.ndarray | int | float)]
    read = [name for name in fields if re.search(rf"[.'\"]{name}\b", SOURCE)]
    assert len(read) > 150 and not set(ELEMENTS) & set(read)
    unknown = [name for name in fields if name not in read and name not in ELEMENTS and not LAYOUT.fullmatch(name)]
    assert unknown == ["geom_fluid"]  # which matters in a fluid only


def test_saturated_servos_are_warned_of():
    servo = {"actuator": 'biastype="affine" biasprm="0 -20 -3" gainprm="20" forcerange="-0.5 0.5"'}
    with pytest.warns(
        MjxWarning, match="while the force of motor is at the end of its forcerange, implicitfast of MJX"
    ):
        warn_of_saturation(compiled(option='integrator="implicitfast"', **servo))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_saturation(compiled(**servo))
        warn_of_saturation(compiled(option='integrator="implicitfast"', actuator='forcerange="-0.5 0.5"'))


@pytest.mark.slow
@pytest.mark.parametrize("name", ['flag spring="disable"', "stiffnesspoly of joint hinge"])
def test_mjx_does_simulate_it_otherwise(name):
    """The refusal can be removed when MJX supports it."""
    own = compiled(**IGNORED[name])
    data, expected = mujoco.MjData(own), []
    for _ in range(40):
        mujoco.mj_step(own, data)
        expected.append(data.qpos[0])
    put = mjx.put_model(own)
    _, found = jax.jit(lambda start: jax.lax.scan(lambda d, _: (mjx.step(put, d),) * 2, start, length=40))(
        mjx.make_data(put)
    )
    assert np.abs(np.asarray(found.qpos)[:, 0] - expected).max() > 0.02


def test_tasks_and_parameters_are_refused():
    times = 0.02 * np.arange(30)
    log = Log(times, {"motor": np.sin(times), "angle": np.cos(times)})

    def task(parameter, **changes):
        return mujoco_task(model(**changes), [parameter], log, noises={"angle": 0.01}, engine="mjx")

    damping = Parameter("joint/hinge/damping", (0.1, 1.0))
    with pytest.raises(ValueError, match=r"expected native for .* got mjx: .* misreads option/noslip_iterations$"):
        task(damping, option='noslip_iterations="4"')
    with pytest.raises(ValueError, match="misreads stiffnesspoly of joint hinge"):
        task(Parameter("joint/hinge/stiffness[1]", (0.0, 3.0)))
    with pytest.raises(ValueError, match="'option/o_margin': expected numbers that MJX reads, got one that it ignores"):
        task(Parameter("option/o_margin", (0.0, 0.1)))
