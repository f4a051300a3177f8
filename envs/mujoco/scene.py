"""Pictures of several poses of a model at once: one solid, others as translucent ghosts, by MuJoCo's renderer."""

import copy
from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from jaxlfi.envs import opengl
from jaxlfi.envs.mujoco.parameters import near

Pose = tuple[mujoco.MjModel, np.ndarray]
"""A model and the positions of its joints."""
GHOST = (0.11, 0.47, 0.85)
"""Colour of ghosts."""
OPAQUE = 0.9
"""Opacity of all ghosts together where they agree."""
MARGIN = 1.12
"""How much larger than the motion a picture is."""
PLANAR = 0.02
"""Extent of a motion along one direction, as a share of its largest extent, below which it is seen from there."""
_DEFAULT = (90.0, -45.0)
"""Azimuth and elevation of the view of models that name none."""


class Stage:
    """A fixed view that holds a whole motion; use it in `with`, or close it.

    Attributes:
        scene: what the last picture shows.
    """

    def __init__(
        self, motions: Sequence[tuple[mujoco.MjModel, np.ndarray]], width: int, height: int, camera: str | None = None
    ):
        """Make a context of OpenGL.

        Args:
            motions: models of the same sizes, and positions of their joints over time, shape [T, nq] each.
            width: of the pictures, in pixels.
            height: of the pictures, in pixels.
            camera: of the model, by name; by default a view that shows all of the motions.

        Raises:
            ValueError: for a camera that the model does not have.
            RuntimeError: where neither EGL nor OSMesa can be had.
        """
        self._model = lit(motions[0][0])
        self._size = width, height
        self._model.vis.global_.offwidth, self._model.vis.global_.offheight = width, height
        self._plain = not (self._model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX).any()
        self._camera = named(self._model, camera) if camera else fitted(motions, width / height)
        self._data = mujoco.MjData(self._model)
        self._option, self._hand = mujoco.MjvOption(), mujoco.MjvPerturb()
        own = self._model.ngeom + self._model.nsite + 4 * self._model.nwrap + 10 * self._model.ntendon
        self.scene = mujoco.MjvScene(self._model, maxgeom=100 + own * (len(motions) + 1))
        self._gl = opengl.context(width, height)
        self._gl.make_current()
        self._made = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._made)

    def __enter__(self) -> "Stage":
        """Itself."""
        return self

    def __exit__(self, *_) -> None:
        """Close it."""
        self.close()

    def close(self) -> None:
        """Let go of the context."""
        self._made.free()
        self._gl.free()

    def picture(
        self, solid: Float[np.ndarray, " qpos"] | None, ghosts: Sequence[Pose]
    ) -> UInt8[np.ndarray, "height width 3"]:
        """What does not move and one pose as they are, others in one colour, translucent.

        Args:
            solid: of the model of the first motion; None draws only what does not move.
            ghosts: of which only what moves is drawn.
        """
        kinds = mujoco.mjtCatBit.mjCAT_STATIC if solid is None else mujoco.mjtCatBit.mjCAT_ALL
        place(self._model, self._data, self._model.qpos0 if solid is None else solid)
        option, hand = self._option, self._hand
        mujoco.mjv_updateScene(self._model, self._data, option, hand, self._camera, kinds.value, self.scene)
        opacity = 1 - (1 - OPAQUE) ** (1 / max(len(ghosts), 1))
        for own, positions in ghosts:
            first = self.scene.ngeom
            place(own, self._data, positions)
            dynamic = mujoco.mjtCatBit.mjCAT_DYNAMIC.value
            mujoco.mjv_addGeoms(own, self._data, option, hand, dynamic, self.scene)
            for geom in self.scene.geoms[first : self.scene.ngeom]:
                geom.rgba[:], geom.matid, geom.transparent = (*GHOST, opacity * geom.rgba[3]), -1, 1
                geom.emission, geom.specular, geom.reflectance = 0.3, 0.1, 0.0
        if self._plain:
            self._add_backdrop()
        return self._drawn()

    def _add_backdrop(self) -> None:
        """Something white behind everything, where a model without a sky has black."""
        eye = self.scene.camera[0]
        forward, up = np.asarray(eye.forward, float), np.asarray(eye.up, float)
        far = 0.9 * self._model.vis.map.zfar * self._model.stat.extent
        side = 4 * far * max(self._size[0] / self._size[1], 1.0)
        turn = np.stack([np.cross(up, -forward), up, -forward], axis=1)
        geom = self.scene.geoms[self.scene.ngeom]
        mujoco.mjv_initGeom(
            geom,
            mujoco.mjtGeom.mjGEOM_PLANE,
            np.array([side, side, 1.0]),
            np.asarray(eye.pos, float) + far * forward,
            turn.ravel(),
            np.ones(4, np.float32),
        )
        geom.emission, geom.specular, geom.reflectance = 1.0, 0.0, 0.0
        self.scene.ngeom += 1

    def _drawn(self) -> np.ndarray:
        width, height = self._size
        pixels, area = np.empty((height, width, 3), np.uint8), mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(area, self.scene, self._made)
        mujoco.mjr_readPixels(pixels, None, area, self._made)
        return pixels[::-1].copy()


def lit(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy of a model that is lighter where it has no lights of its own."""
    own = copy.copy(model)
    if not own.nlight:
        head = own.vis.headlight
        head.ambient[:], head.diffuse[:], head.specular[:] = 0.45, 0.5, 0.2
    return own


def place(model: mujoco.MjModel, data: mujoco.MjData, qpos: Float[np.ndarray, " qpos"]) -> None:
    """Put a model into a pose, as far as it is seen."""
    data.qpos[:] = qpos
    for step in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight, mujoco.mj_flex, mujoco.mj_tendon):
        step(model, data)


def named(model: mujoco.MjModel, camera: str) -> mujoco.MjvCamera:
    """A model's own camera.

    Raises:
        ValueError: for one that it does not have.
    """
    known = [model.camera(i).name for i in range(model.ncam)]
    if camera not in known:
        raise ValueError(f"camera: expected one {near(camera, known)}, got {camera!r}")
    view = mujoco.MjvCamera()
    view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, known.index(camera)
    return view


def fitted(motions: Sequence[tuple[mujoco.MjModel, np.ndarray]], aspect: float) -> mujoco.MjvCamera:
    """A view that shows all of some motions, and what is fixed among them.

    Args:
        motions: models of the same sizes, and positions of their joints over time, shape [T, nq] each.
        aspect: width of the picture by its height.
    """
    model = motions[0][0]
    moving, centres, radii = _places(motions)
    view = mujoco.MjvCamera()
    view.type = mujoco.mjtCamera.mjCAMERA_FREE
    view.azimuth, view.elevation = _direction(model, centres[moving])
    azimuth, elevation = np.deg2rad([view.azimuth, view.elevation])
    forward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    across = np.stack([right, np.cross(right, forward)])
    ahead, sideways = centres @ forward, centres @ across.T
    ends = (sideways - radii[:, None]).min(axis=0), (sideways + radii[:, None]).max(axis=0)
    middle = (ends[0] + ends[1]) / 2
    depth = (ahead.min() + ahead.max()) / 2
    half = np.deg2rad(model.vis.global_.fovy) / 2
    slopes = np.tan(half) * np.array([aspect, 1.0])
    # Each sphere lies between four planes through the eye.
    reach = (np.abs(sideways - middle) + radii[:, None] * np.sqrt(1 + slopes**2)) * MARGIN / slopes
    view.distance = float((reach - (ahead - depth)[:, None]).max())
    view.lookat[:] = middle @ across + depth * forward
    return view


def _places(motions: Sequence[tuple[mujoco.MjModel, np.ndarray]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Spheres about all geoms over time: which of them move, their centres and radii."""
    model = motions[0][0]
    moves = model.body_weldid[model.geom_bodyid] != 0
    data, centres = mujoco.MjData(model), []
    for own, positions in motions:
        for qpos in positions:
            place(own, data, qpos)
            centres.append(data.geom_xpos.copy())
    found, radii = np.array(centres), model.geom_rbound
    extent = np.ptp(found[:, moves], axis=(0, 1)).max() + 2 * radii[moves].max() if moves.any() else np.inf
    seen = moves | ((radii > 0) & (radii < extent))
    count = len(found)
    flat = found[:, seen].reshape(-1, 3)
    return np.tile(moves[seen], count), flat, np.tile(radii[seen], count)


def _direction(model: mujoco.MjModel, centres: Float[np.ndarray, "n 3"]) -> tuple[float, float]:
    """Azimuth and elevation of a view: the model's own, or from the side of a motion in a plane."""
    own = float(model.vis.global_.azimuth), float(model.vis.global_.elevation)
    if own != _DEFAULT or len(centres) < 2:
        return own
    _, spread, axes = np.linalg.svd(centres - centres.mean(axis=0), full_matrices=False)
    if spread[1] <= PLANAR * spread[0]:  # along a line
        normal = np.cross(axes[0], [0.0, 0.0, 1.0]) if abs(axes[0, 2]) < 0.7 else np.array([0.0, 1.0, 0.0])
    elif spread[2] <= PLANAR * spread[0]:
        normal = axes[2]
    else:
        return 120.0, -25.0
    if abs(normal[2]) > 0.7:
        return 90.0, -55.0
    # From the side that has x to the right, or else y.
    azimuth = 180.0 - np.rad2deg(np.arctan2(-normal[1], normal[0])) % 180.0
    return float(azimuth), -12.0
