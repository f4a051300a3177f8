"""The camera against MuJoCo's own and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxlfi.envs.whip.parameters import MEDIAN
from jaxlfi.envs.whip.quaternions import rotation
from jaxlfi.envs.whip.vision.camera import FIELD_OF_VIEW, Camera, project, side_camera

TILTED = Camera(
    position=jnp.array([0.31, -0.83, 0.42]),
    orientation=jnp.asarray(Rotation.from_euler("xyz", [75.0, 8.0, -12.0], degrees=True).as_quat(scalar_first=True)),
    field_of_view=jnp.asarray(50.0),
)


def displaced(x: float, y: float, z: float) -> Camera:
    return side_camera(MEDIAN.replace(camera=(x, y, z)))


def mujocos(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Projection in double precision by the pose that MuJoCo computes for a camera of these numbers."""
    mujoco = pytest.importorskip("mujoco")
    numbers = lambda array: " ".join(map(str, np.asarray(array).tolist()))
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><camera pos="{numbers(camera.position)}" quat="{numbers(camera.orientation)}" '
        f'fovy="{float(camera.field_of_view)}"/></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    np.testing.assert_allclose(rotation(camera.orientation).ravel(), data.cam_xmat[0], atol=1e-6)
    right, up, back = ((points - data.cam_xpos[0]) @ data.cam_xmat[0].reshape(3, 3)).T
    half = np.tan(np.deg2rad(model.cam_fovy[0]) / 2)
    return np.stack([0.5 + 0.5 * right / (-back * half), 0.5 - 0.5 * up / (-back * half)], axis=-1)


@pytest.mark.parametrize("camera", [TILTED, displaced(0.02, -0.01, 0.025)], ids=["tilted", "side"])
def test_projection_against_mujoco(camera):
    points = np.random.default_rng(3).uniform([0.1, -0.3, 0.0], [0.8, 0.2, 0.5], (50, 3))
    np.testing.assert_allclose(project(camera, jnp.asarray(points, jnp.float32)), mujocos(camera, points), atol=2e-6)


def test_the_side_camera_looks_along_y_with_z_up():
    """As `xyaxes="1 0 0 0 0 1"` says in a model's XML."""
    np.testing.assert_allclose(rotation(side_camera(MEDIAN).orientation), [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-7)
    assert float(side_camera(MEDIAN).field_of_view) == pytest.approx(FIELD_OF_VIEW)


def test_the_side_camera_sees_sixty_centimetres():
    points = jnp.array([[0.45, 0.0, 0.25], [0.60, 0.0, 0.25], [0.45, 0.0, 0.15], [0.15, 0.0, 0.55]])
    expected = [[0.5, 0.5], [0.75, 0.5], [0.5, 0.5 + 0.1 / 0.6], [0.0, 0.0]]
    np.testing.assert_allclose(project(side_camera(MEDIAN), points), expected, atol=2e-6)


def test_displacing_the_camera():
    """Moving the camera right and up shifts the image left and down; moving it back makes objects smaller."""
    point = jnp.array([0.60, 0.0, 0.15])
    u = 0.5 + (0.60 - 0.45 - 0.02) / 0.6 * 0.9 / 0.925
    v = 0.5 - (0.15 - 0.25 - 0.01) / 0.6 * 0.9 / 0.925
    np.testing.assert_allclose(project(displaced(0.02, -0.025, 0.01), point), [u, v], atol=2e-6)


def test_what_is_not_in_front_is_not_seen():
    points = jnp.array([[0.5, -0.95, 0.2], [0.5, -0.901, 0.2], [0.5, 0.0, 0.2]])
    assert np.isnan(project(side_camera(MEDIAN), points)).all(axis=-1).tolist() == [True, True, False]


def test_contract(key):
    points = 0.5 * jax.random.uniform(key, (2, 4, 3))
    cameras = [TILTED, displaced(0.01, 0.02, -0.02)]
    batched = jax.jit(jax.vmap(project))(jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras), points)
    for i, camera in enumerate(cameras):
        np.testing.assert_allclose(batched[i], project(camera, points[i]), atol=1e-6)
    many = jax.vmap(lambda shift: side_camera(MEDIAN.replace(camera=shift)))(jnp.array([[0.0] * 3, [0.02, 0.01, 0.0]]))
    np.testing.assert_allclose(many.position[1], [0.47, -0.89, 0.25], atol=1e-6)
