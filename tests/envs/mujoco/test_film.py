"""Films: poses against plain loops and closed forms, pixels against projections by hand, and the files."""

import dataclasses
import os
from types import SimpleNamespace

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

from envs_mujoco import ARM, driven, recorded
from PIL import Image

from jaxlfi.envs import gaussian_linear, opengl
from jaxlfi.envs.mujoco import figures, film, scene
from jaxlfi.envs.mujoco.logs import Log
from jaxlfi.envs.mujoco.measured import add_sensors
from jaxlfi.envs.mujoco.model_task import mujoco_task
from jaxlfi.envs.mujoco.parameters import Parameter
from jaxlfi.envs.mujoco.poses import recorded_positions, unmeasured_joints

PARAMETERS = [
    Parameter("joint/elbow/damping", (0.01, 0.2)),
    Parameter("initial/elbow/qpos", (-1.0, 1.0)),
    Parameter("control/delay", (0.0, 0.1)),
]
DRAWS = np.array([[0.03, 0.2, 0.0], [0.11, -0.3, 0.012]])
TIMES = 0.02 * np.arange(101)
STEP = 0.004


@pytest.fixture(scope="module")
def renderer():
    """Use OSMesa if it exists: the first backend imported stays for the process, and other tests draw with it."""
    with pytest.MonkeyPatch.context() as patch:
        for kind in ("osmesa", "egl"):
            patch.setenv("MUJOCO_GL", os.environ.get("MUJOCO_GL") or kind)
            try:
                opengl.context(8, 8).free()
            except RuntimeError:
                patch.undo()
            else:
                yield
                return
    pytest.skip("neither EGL nor OSMesa")


def run_of(*logs, draws=DRAWS, observed=None):
    """What a film needs of a run."""
    noises = {name: 0.01 for name in logs[0].signals if name != "motor"}
    task = mujoco_task(ARM, PARAMETERS, logs, noises=noises)
    observed = task.observation if observed is None else observed
    return SimpleNamespace(task=task, observed=observed, draws=lambda n: draws[:n], origin=SimpleNamespace())


def log_of(positions, times=TIMES):
    """A recording of both joints."""
    signals = {"motor": driven(times), "angle": positions[:, 0], "joint/elbow/qpos": positions[:, 1]}
    return Log(times, signals, "both")


def swing(damping, start, delay, steps=501):
    """Positions of the arm's joints before each step, by a loop of single steps."""
    model = mujoco.MjModel.from_xml_string(ARM)
    model.dof_damping[1] = damping
    data, found = mujoco.MjData(model), []
    data.qpos[1] = start
    for step in range(steps):
        found.append(data.qpos.copy())
        data.ctrl[0] = driven(0.02 * (max(step - round(delay / STEP), 0) // 5))
        mujoco.mj_step(model, data)
    return np.array(found)


MEASURED = swing(0.05, 0.1, 0.0)[::5] + np.array([0.01, -0.02])


# ------------------------------------------------------------------------------------------------------------ poses


@pytest.mark.parametrize(("slower", "count"), [(1.0, 51), (2.5, 126), (0.5, 26)])
def test_ghosts_are_the_plain_loop_and_the_recording_is_the_log(slower, count):
    shown = film.motion(run_of(log_of(MEASURED)), 2, slower)
    np.testing.assert_allclose(shown.times, 0.04 / slower * np.arange(count))
    for draw, positions in zip(DRAWS, shown.simulated, strict=True):
        np.testing.assert_allclose(positions, swing(*draw)[(shown.times / STEP).round().astype(int)], atol=1e-9)
    for joint in range(2):
        expected = np.interp(shown.times, TIMES, MEASURED[:, joint])
        np.testing.assert_allclose(shown.recorded[:, joint], expected, atol=1e-6)
    assert (
        shown.unmeasured == []
        and shown.failed == 0
        and shown.traces.names
        == (
            "angle [rad]",
            "joint/elbow/qpos [rad]",
        )
    )
    np.testing.assert_allclose(shown.traces.simulated[1], swing(*DRAWS[1])[::5], atol=1e-9)


def test_a_joint_that_is_not_measured():
    shown = film.motion(run_of(recorded()), 2)
    assert shown.recorded is None and shown.unmeasured == ["elbow"] and not shown.traces.posed
    assert shown.simulated.shape == (2, 51, 2)


def test_samples_that_are_missing_are_bridged():
    gaps = MEASURED.copy()
    gaps[1::2, 1] = np.nan
    shown = film.motion(run_of(log_of(gaps)), 1)
    np.testing.assert_allclose(shown.recorded[:, 1], gaps[::2, 1], atol=1e-6)


def test_an_episode_by_its_number():
    short = log_of(MEASURED[:31], TIMES[:31])
    shown = film.motion(run_of(log_of(MEASURED), short), 1, episode=1)
    assert shown.times[-1] == pytest.approx(0.6) and shown.traces.simulated.shape == (1, 31, 2)
    np.testing.assert_allclose(shown.traces.recorded, MEASURED[:31], atol=1e-6)
    np.testing.assert_allclose(shown.simulated[0], swing(*DRAWS[0])[: 16 * 10 : 10], atol=1e-9)


def test_simulations_that_fail_are_counted():
    shown = film.motion(run_of(log_of(MEASURED), draws=np.array([DRAWS[0], [-1e9, 0.0, 0.0]])), 2)
    assert shown.failed == 1 and len(shown.models) == len(shown.simulated) == len(shown.traces.simulated) == 1
    with pytest.raises(ValueError, match="draws: expected at least one whose simulation succeeds, got 1 that fail"):
        film.motion(run_of(log_of(MEASURED), draws=np.array([[-1e9, 0.0, 0.0]])), 1)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"episode": 1}, "episode: expected one of 0 to 0, got 1"),
        ({"slower": 0.0}, "slower: expected 0.02 to 20, as the recording takes 2 s .* got 0"),
        ({"slower": 21.0}, "slower: .* got 21"),
        ({"slower": float("nan")}, "slower: .* got nan"),
    ],
)
def test_films_that_cannot_be(arguments, expected):
    with pytest.raises(ValueError, match=expected):
        film.motion(run_of(log_of(MEASURED)), 1, **arguments)


def test_runs_of_other_tasks_and_rows():
    with pytest.raises(ValueError, match="task: expected one of a MuJoCo model, got gaussian_linear"):
        film.motion(SimpleNamespace(task=gaussian_linear.task()))
    gone = SimpleNamespace(task=None, origin=SimpleNamespace(reference=None))
    with pytest.raises(ValueError, match="cannot find its task, which was made in Python"):
        film.motion(gone)
    with pytest.raises(ValueError, match=r"of shape \[101, 2\], got \[7, 2\]"):
        film.motion(run_of(log_of(MEASURED), observed=np.zeros((7, 2))), 1)


JOINTS = """
<mujoco>
  <worldbody>
    <body name="box"><freejoint/><geom size="0.1"/></body>
    <body name="base"><joint name="slide" type="slide"/><geom size="0.1"/>
      <body name="ball"><joint name="socket" type="ball"/><geom size="0.1" pos="0.3 0 0"/></body>
    </body>
  </worldbody>
  <sensor><ballquat name="turn" joint="socket"/></sensor>
</mujoco>
"""


def test_positions_of_all_kinds_of_joints_are_those_that_sensors_saw():
    signals = [f"body/box/pos[{i}]" for i in (2, 0, 1)] + [f"body/box/quat[{i}]" for i in range(4)]
    signals += ["joint/slide/qpos", *(f"turn[{i}]" for i in range(4))]
    spec = mujoco.MjSpec.from_string(JOINTS)
    add_sensors(spec, signals)
    model = spec.compile()
    assert unmeasured_joints(model, signals) == []
    assert unmeasured_joints(model, signals[1:-1]) == ["joint[0]", "socket"]
    data, rng = mujoco.MjData(model), np.random.default_rng(3)
    begin = rng.standard_normal(model.nq)
    poses, rows = [], []
    for share in np.linspace(0, 1, 5):
        data.qpos[:] = begin + 0.5 * share
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_forward(model, data)
        poses.append(data.qpos.copy())
        read = lambda name: data.sensor(name.partition("[")[0]).data[int(name[-2])] if "[" in name else data.qpos[7]
        rows.append([read(name) for name in signals])
    rows, poses = np.array(rows), np.array(poses)
    rows[2:4, 3:7] *= -1  # the same turns
    found = recorded_positions(model, signals, np.arange(5.0), rows, np.array([0.0, 1.5, 2.0, 4.0]))
    middle = (poses[1] + poses[2]) / 2
    mujoco.mj_normalizeQuat(model, middle)
    expected = np.stack([poses[0], middle, poses[2], poses[4]])
    for own in (slice(3, 7), slice(8, 12)):
        turned = np.sign(np.sum(found[:, own] * expected[:, own], axis=1, keepdims=True))
        np.testing.assert_allclose(found[:, own] * turned, expected[:, own], atol=1e-9)
    np.testing.assert_allclose(found[:, [0, 1, 2, 7]], expected[:, [0, 1, 2, 7]], atol=1e-9)


# --------------------------------------------------------------------------------------------------------- pictures

BALL = """
<mujoco>
  <worldbody>
    <camera name="side" pos="0 -2 0" xyaxes="1 0 0 0 0 1" fovy="40"/>
    <geom name="post" type="box" pos="-0.55 0 0.3" size="0.03 0.03 0.1" rgba="0.2 0.6 0.2 1"/>
    <body name="ball">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <camera name="carried" pos="0 -2 0" xyaxes="1 0 0 0 0 1" fovy="40"/>
      <geom type="sphere" size="0.06" rgba="0.9 0.2 0.1 1"/>
    </body>
  </worldbody>
</mujoco>
"""
WIDTH, HEIGHT = 300, 240


def stage(simulated, solid, camera="side"):
    """A picture of the ball where it was recorded, and of ghosts of it."""
    models = [mujoco.MjModel.from_xml_string(BALL)] * len(simulated)
    poses = None if solid is None else np.array([solid])
    with scene.Stage(models, np.array(simulated)[:, None], poses, WIDTH, HEIGHT, camera) as made:
        return made.picture(0).astype(int)


def pixel(x, z):
    """Column and row of a point of the plane y = 0, as the camera at the side sees it."""
    focal = HEIGHT / 2 / np.tan(np.deg2rad(20.0))
    return WIDTH / 2 + focal * x / 2, HEIGHT / 2 - focal * z / 2


def bluish(picture):
    return picture[..., 2] - picture[..., 0] > 30


def centre(mask):
    rows, columns = np.nonzero(mask)
    return columns.mean() + 0.5, rows.mean() + 0.5


def test_a_ghost_is_where_its_pose_puts_it(renderer):
    """Right is right and up is up in the picture."""
    picture = stage([[0.4, 0.2]], [-0.3, -0.25])
    np.testing.assert_allclose(centre(bluish(picture)), pixel(0.4, 0.2), atol=0.5)
    reddish = picture[..., 0] - picture[..., 2] > 40
    np.testing.assert_allclose(centre(reddish), pixel(-0.3, -0.25), atol=0.5)
    green = picture[..., 1] - np.maximum(picture[..., 0], picture[..., 2]) > 40
    np.testing.assert_allclose(centre(green), pixel(-0.55, 0.3), atol=1.5)
    radius = HEIGHT / 2 / np.tan(np.deg2rad(20.0)) * 0.06 / 2
    assert np.sqrt(bluish(picture).sum() / np.pi) == pytest.approx(radius, abs=0.7)


def test_a_camera_that_a_body_carries_follows_the_recording(renderer):
    picture = stage([[0.5, 0.2]], [0.3, 0.1], "carried")
    np.testing.assert_allclose(centre(bluish(picture)), pixel(0.2, 0.1), atol=0.5)


def test_the_recorded_pose_has_an_outline_that_ghosts_do_not_hide(renderer):
    picture = stage([[0.1, 0.0]] * 3, [0.1, 0.0])
    column, row = (round(place) for place in pixel(0.1, 0.0))
    assert bluish(picture)[row, column]
    dark = (picture.max(axis=-1) < 80) & (np.arange(WIDTH) > 130)  # the post is farther to the left
    np.testing.assert_allclose(centre(dark), pixel(0.1, 0.0), atol=0.5)
    assert not dark[row, column] and dark[row].sum() >= 2
    without = stage([[0.1, 0.0]] * 3, None)
    assert not (without[:, 130:].max(axis=-1) < 80).any() and bluish(without)[row, column]


def test_the_more_ghosts_the_deeper_the_colour_in_any_order(renderer):
    poses = [[0.0, 0.0], [0.0, 0.0], [0.4, 0.0], [0.4, 0.0], [0.4, 0.0], [-0.2, 0.2]]
    picture = stage(poses, None)
    np.testing.assert_allclose(picture, stage(poses[::-1], None), atol=1)
    # Opacities of 1, 2 and 3 of 6 ghosts; the share of the white behind them that is left, in red, which they lack.
    at = lambda x, z: picture[tuple(round(place) for place in pixel(x, z)[::-1])][0] / 255
    full = stage([[0.0, 0.0]], None)[round(pixel(0, 0)[1]), round(pixel(0, 0)[0])][0] / 255
    ghost = (full - (1 - scene.OPAQUE)) / scene.OPAQUE
    for count, place in ((1, (-0.2, 0.2)), (2, (0.0, 0.0)), (3, (0.4, 0.0))):
        left = (1 - scene.OPAQUE) ** (count / 6)
        assert at(*place) == pytest.approx(left + (1 - left) * ghost, abs=0.03)


@pytest.mark.parametrize(("width", "height"), [(WIDTH, HEIGHT), (200, 300)])
@pytest.mark.parametrize("joint", ['axis="0 1 0"', 'axis="1 0.2 0"', 'axis="0 0 1"', 'type="slide" axis="1 2 3"'])
def test_a_fitted_view_holds_the_whole_motion_and_not_much_more(renderer, joint, width, height):
    xml = f"""<mujoco><worldbody><body><joint {joint}/><geom type="capsule" fromto="0 0 0 1.5 0 -0.4" size="0.1"/>
      <geom type="box" pos="1.5 0.1 0.5" size="0.1 0.3 0.2" euler="20 30 40"/></body></worldbody></mujoco>"""
    models, simulated = [mujoco.MjModel.from_xml_string(xml)], np.linspace(-2, 1.4, 7)[None, :, None]
    with scene.Stage(models, simulated, None, width, height) as made:
        seen = np.any([bluish(made.picture(f).astype(int)) for f in range(7)], axis=0)
    assert not (seen[[0, -1]].any() or seen[:, [0, -1]].any())
    assert max(seen.any(axis=0).sum() / width, seen.any(axis=1).sum() / height) > 0.7


@pytest.mark.parametrize(("axis", "right"), [("0 1 0", 0), ("1 0 0", 1)])
def test_a_motion_in_a_plane_is_seen_from_its_side(axis, right):
    """The view has x, or else y, to the right."""
    model = mujoco.MjModel.from_xml_string(ARM.replace('axis="0 1 0"', f'axis="{axis}"'))
    view = scene.fitted([(model, np.random.default_rng(0).uniform(-1, 1, (20, 2)))], 1.0)
    assert view.elevation == -12.0
    turn = np.deg2rad(view.azimuth)
    assert [np.sin(turn), -np.cos(turn)][right] > 0.999


def test_what_stands_near_the_motion_is_in_the_picture_and_what_is_far_away_is_not():
    distance = []
    for where in ("0.25 0 0", "90 0 0"):
        xml = ARM.replace("<worldbody>", f'<worldbody><geom type="box" size="0.1 0.1 0.1" pos="{where}"/>')
        model = mujoco.MjModel.from_xml_string(xml)
        distance.append(scene.fitted([(model, np.zeros((1, 2)))], 1.0).distance)
    plain = scene.fitted([(mujoco.MjModel.from_xml_string(ARM), np.zeros((1, 2)))], 1.0).distance
    assert distance[0] > 1.05 * plain and distance[1] == pytest.approx(plain)


def test_cameras_that_are_not_there_and_models_in_which_nothing_moves():
    model = mujoco.MjModel.from_xml_string(BALL)
    with pytest.raises(ValueError, match=r"camera: expected one such as side.*, got 'sid'"):
        scene.named(model, "sid")
    with pytest.raises(ValueError, match=r"camera: expected none, .*; got 'side'"):
        scene.named(mujoco.MjModel.from_xml_string(ARM), "side")
    still = mujoco.MjModel.from_xml_string('<mujoco><worldbody><geom size="0.1"/></worldbody></mujoco>')
    with pytest.raises(ValueError, match="expected a geom that moves"):
        scene.fitted([(still, np.zeros((1, 0)))], 1.0)


# ------------------------------------------------------------------------------------------------------------ files


@pytest.fixture(scope="module")
def shown():
    return film.motion(run_of(log_of(MEASURED[:41], TIMES[:41])), 2)


def test_a_film_and_its_sheet(renderer, shown, tmp_path):
    again = tmp_path / "again.gif"
    for path in (tmp_path / "films/arm.gif", again):
        sheet = film.save(path, shown, size=(200, 180))
        assert sheet == path.with_suffix(".png") and Image.open(sheet).width > 1000
    assert path.read_bytes() == (tmp_path / "films/arm.gif").read_bytes()
    with Image.open(again) as images:
        assert images.n_frames == len(shown.times) == 21 and images.size == (200, 180) and images.info["loop"] == 0
        durations, pictures = [], []
        for number in range(images.n_frames):
            images.seek(number)
            durations.append(images.info["duration"])
            pictures.append(np.asarray(images.convert("RGB")).astype(int))
    assert durations == [40] * 21
    # The cursor moves evenly to the right.
    red = [(picture[..., 0] - picture[..., 1] > 80) & (picture[..., 2] < 120) for picture in pictures]
    places = [np.nonzero(mask)[1].mean() for mask in red]
    np.testing.assert_allclose(np.diff(places, 2), 0.0, atol=1.5)
    assert np.diff(places).min() >= 2


def test_what_comes_later_is_paler(shown):
    strip = figures.Strip(shown.traces, 300, 120)
    first, last = strip.at(0.0).astype(int), strip.at(0.8).astype(int)
    assert first.shape == (strip.height, 300, 3)
    ink = last.min(axis=-1) < 100
    columns = np.nonzero(ink)[1]
    later = ink & (np.arange(300) > np.median(columns))
    assert (first[later].min(axis=-1) > last[later].min(axis=-1)).mean() > 0.5
    assert (first >= last).mean() > 0.95


def test_many_signals_are_the_first_few(shown):
    many = dataclasses.replace(
        shown.traces,
        names=[f"signal {i}" for i in range(9)],
        recorded=np.zeros((41, 9)),
        simulated=np.zeros((2, 41, 9)),
    )
    assert many.drawn == figures.MOST == 4
    assert figures.Strip(many, 300, 200).at(0.3).shape == (200, 300, 3)
