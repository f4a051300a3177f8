"""Pictures of a model's recorded motion and of simulations of it as ghosts, by MuJoCo's renderer."""

import contextlib
import copy
from collections.abc import Sequence

import mujoco
import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float, UInt8

from jaxlfi.envs import opengl
from jaxlfi.envs.mujoco.parameters import near

GHOST = (0.11, 0.47, 0.85)
"""Colour of ghosts."""
OPAQUE = 0.9
"""Opacity of all ghosts together where they agree."""
MARGIN = 1.08
"""Factor by which a picture is larger than the motion."""
PLANAR = 0.02
"""Extent of a motion along a direction, as a fraction of its largest extent, below which it is seen from there."""
POSES = 250
"""Largest number of poses of each motion that a view is fitted to."""
_CORNERS = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(8, 3)
_DEFAULT = (90.0, -45.0)
"""Azimuth and elevation of the view of models that name none."""
_STILL, _ALL = mujoco.mjtCatBit.mjCAT_STATIC.value, mujoco.mjtCatBit.mjCAT_ALL.value


class Stage(contextlib.AbstractContextManager):
    """A view of a whole motion; use it in `with`, or close it."""

    def __init__(
        self,
        models: Sequence[mujoco.MjModel],
        simulated: Float[np.ndarray, "n frames qpos"],
        recorded: Float[np.ndarray, "frames qpos"] | None,
        width: int,
        height: int,
        camera: str | None = None,
    ):
        """Make an OpenGL context.

        Args:
            models: of the N simulations, of the same sizes.
            simulated: positions of their joints, shape [N, F, nq].
            recorded: recorded positions, shape [F, nq]; None if they are unknown.
            width: of the pictures, in pixels.
            height: of the pictures, in pixels.
            camera: of the model, by name; by default a view that shows all of the motion.

        Raises:
            ValueError: for a camera that the model does not have.
            RuntimeError: if neither EGL nor OSMesa is available.
        """
        self._models, self._simulated, self._recorded = [lit(model) for model in models], simulated, recorded
        self._model, self._size = self._models[0], (width, height)
        self._model.vis.global_.offwidth, self._model.vis.global_.offheight = width, height
        motions = list(zip(models, simulated, strict=True)) + ([] if recorded is None else [(models[0], recorded)])
        self._camera = named(self._model, camera) if camera else fitted(motions, width / height)
        # A camera carried by a body stays at the recorded pose for ghosts, too.
        self._data, self._viewed = mujoco.MjData(self._model), mujoco.MjData(self._model)
        self._scene = mujoco.MjvScene(self._model, maxgeom=10_000 + self._model.ngeom)
        self._gl = opengl.context(width, height)
        self._gl.make_current()
        self._made = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._made)

    def __exit__(self, *_) -> None:
        """Close it."""
        self.close()

    def close(self) -> None:
        """Release the context."""
        self._made.free()
        self._gl.free()

    def picture(self, frame: int) -> UInt8[np.ndarray, "height width 3"]:
        """The recorded pose as it looks, with a dark outline, and in front of it the simulated ones, translucent.

        Ghosts are drawn one at a time and blended here: drawn together, they would hide one another and the recorded
        pose at random wherever they are at the same depth.
        """
        solid = self._model.qpos0 if self._recorded is None else self._recorded[frame]
        place(self._model, self._viewed, solid)
        still = self._drawn(self._model, solid, _STILL)
        picture = still if self._recorded is None else self._drawn(self._model, solid, _ALL)
        outlined = _differ(picture, still)
        colour, count = np.zeros(still.shape, np.float32), np.zeros((*still.shape[:2], 1), np.float32)
        for model, positions in zip(self._models, self._simulated, strict=True):
            ghost = self._drawn(model, positions[frame], _ALL, GHOST)
            there = _differ(ghost, still)[..., None]
            colour += there * ghost
            count += there
        opacity = 1 - (1 - OPAQUE) ** (count / len(self._models))
        picture = (1 - opacity) * picture + opacity * colour / np.maximum(count, 1)
        thickness = max(round(min(self._size) / 300), 1)
        inside = scipy.ndimage.binary_erosion(outlined, iterations=thickness, border_value=1)
        picture[outlined & ~inside] *= 0.2
        return picture.round().astype(np.uint8)

    def _drawn(
        self, model: mujoco.MjModel, positions: np.ndarray, kinds: int, colour: tuple[float, ...] | None = None
    ) -> UInt8[np.ndarray, "height width 3"]:
        """A picture of one pose of a model: of its static parts or of all, with moving parts in a colour."""
        scene, option, width, height = self._scene, mujoco.MjvOption(), *self._size
        place(model, self._data, positions)
        mujoco.mjv_updateScene(model, self._data, option, None, self._camera, kinds, scene)
        mujoco.mjv_updateCamera(self._model, self._viewed, self._camera, scene)
        # Only the pose counts as a difference to the still picture, not its shadow or mirror image.
        scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        for geom in scene.geoms[: scene.ngeom] if colour else ():
            if geom.category == mujoco.mjtCatBit.mjCAT_DYNAMIC:
                geom.rgba[:3], geom.matid, geom.emission, geom.specular = colour, -1, 0.3, 0.1
        if not (model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX).any():
            self._add_backdrop()
        pixels, area = np.empty((height, width, 3), np.uint8), mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(area, scene, self._made)
        mujoco.mjr_readPixels(pixels, None, area, self._made)
        return pixels[::-1].copy()

    def _add_backdrop(self) -> None:
        """Add a white backdrop behind everything: a model without a sky has a black one."""
        eye = self._scene.camera[0]
        forward, up = np.asarray(eye.forward, float), np.asarray(eye.up, float)
        far = 0.9 * self._model.vis.map.zfar * self._model.stat.extent
        side = 4 * far * max(self._size[0] / self._size[1], 1.0)
        turn = np.stack([np.cross(up, -forward), up, -forward], axis=1)
        where = np.asarray(eye.pos, float) + far * forward
        geom = self._scene.geoms[self._scene.ngeom]
        plane, size, white = mujoco.mjtGeom.mjGEOM_PLANE, np.array([side, side, 1.0]), np.ones(4, np.float32)
        mujoco.mjv_initGeom(geom, plane, size, where, turn.ravel(), white)
        geom.emission, geom.specular, geom.reflectance = 1.0, 0.0, 0.0
        self._scene.ngeom += 1


def _differ(one: np.ndarray, other: np.ndarray) -> Bool[np.ndarray, "height width"]:
    """Which pixels of two pictures differ; several times faster than `any` over so short an axis."""
    red, green, blue = np.moveaxis(one != other, -1, 0)
    return red | green | blue


def lit(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy of a model, with more light if it has no lights of its own."""
    own = copy.copy(model)
    if not own.nlight:
        head = own.vis.headlight
        head.ambient[:], head.diffuse[:], head.specular[:] = 0.45, 0.5, 0.2
    return own


def place(model: mujoco.MjModel, data: mujoco.MjData, qpos: Float[np.ndarray, " qpos"]) -> None:
    """Put a model into a pose, as far as pictures need."""
    data.qpos[:] = qpos
    for step in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight, mujoco.mj_flex, mujoco.mj_tendon):
        step(model, data)


def named(model: mujoco.MjModel, camera: str) -> mujoco.MjvCamera:
    """A model's own camera.

    Raises:
        ValueError: for one that it does not have.
    """
    known = [model.camera(i).name for i in range(model.ncam)]
    if not any(known):
        raise ValueError(f"camera: expected none, as those of the model have no names; got {camera!r}")
    if camera not in known:
        raise ValueError(f"camera: expected one {near(camera, known)}, got {camera!r}")
    view = mujoco.MjvCamera()
    view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, known.index(camera)
    return view


def fitted(motions: Sequence[tuple[mujoco.MjModel, np.ndarray]], aspect: float) -> mujoco.MjvCamera:
    """A view that shows all of some motions, and what is static among them.

    Args:
        motions: models of the same sizes, and positions of their joints over time, shape [T, nq] each.
        aspect: width of the picture divided by its height.
    """
    model = motions[0][0]
    moved, corners = _places(motions)
    view = mujoco.MjvCamera()
    view.type = mujoco.mjtCamera.mjCAMERA_FREE
    view.azimuth, view.elevation = _direction(model, moved)
    azimuth, elevation = np.deg2rad([view.azimuth, view.elevation])
    forward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    across = np.stack([right, np.cross(right, forward)])
    ahead, sideways = corners @ forward, corners @ across.T
    middle, depth = (sideways.min(axis=0) + sideways.max(axis=0)) / 2, (ahead.min() + ahead.max()) / 2
    slopes = np.tan(np.deg2rad(model.vis.global_.fovy) / 2) * np.array([aspect, 1.0])
    # Each corner lies between four planes through the eye.
    view.distance = float((np.abs(sideways - middle) * MARGIN / slopes - (ahead - depth)[:, None]).max())
    view.lookat[:] = middle @ across + depth * forward
    return view


def _places(motions: Sequence[tuple[mujoco.MjModel, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Displacements of geoms from their means over time, and corners of the boxes of these and nearby geoms; [n, 3]."""
    model = motions[0][0]
    data, places, orientations = mujoco.MjData(model), [], []
    for own, positions in motions:
        for qpos in positions[:: -(-len(positions) // POSES)]:
            place(own, data, qpos)
            places.append(data.geom_xpos.copy())
            orientations.append(data.geom_xmat.reshape(-1, 3, 3).copy())
    local = model.geom_aabb[:, None, :3] + _CORNERS * model.geom_aabb[:, None, 3:]
    corners = np.array(places)[:, :, None] + np.einsum("tgij,gkj->tgki", np.array(orientations), local)
    moves = model.body_weldid[model.geom_bodyid] != 0
    if not moves.any():
        raise ValueError("model: expected a geom that moves, got none: there is nothing to film")
    low, high = corners[:, moves].min(axis=(0, 1, 2)), corners[:, moves].max(axis=(0, 1, 2))
    reach = (high - low).max() / 2
    still = corners[0, (model.geom_rbound > 0) & ~moves].reshape(-1, 8, 3)  # planes have no bounds
    still = still[((still > low - reach) & (still < high + reach)).all(axis=(1, 2))]
    shown = np.concatenate([corners[:, moves].reshape(-1, 3), still.reshape(-1, 3)])
    moved = np.array(places)[:, moves] - np.mean(places, axis=0)[moves]
    return moved.reshape(-1, 3), shown


def _direction(model: mujoco.MjModel, moved: Float[np.ndarray, "n 3"]) -> tuple[float, float]:
    """Azimuth and elevation of a view: the model's own, or perpendicular to a planar motion."""
    own = float(model.vis.global_.azimuth), float(model.vis.global_.elevation)
    if own != _DEFAULT:
        return own
    spread, axes = np.linalg.eigh(moved.T @ moved)
    spread, axes = np.sqrt(np.maximum(spread[::-1], 0.0)), axes.T[::-1]
    if spread[1] <= PLANAR * spread[0]:  # along a line
        normal = np.cross(axes[0], [0.0, 0.0, 1.0]) if abs(axes[0, 2]) < 0.7 else np.array([0.0, 1.0, 0.0])
    elif spread[2] <= PLANAR * spread[0]:
        normal = axes[2]
    else:
        return 120.0, -25.0
    if abs(normal[2]) > 0.7:
        return 90.0, -55.0
    # Seen with x to the right, or else y, however rounding turns a normal along an axis.
    normal = -normal if normal[1] < 0.1 * normal[0] else normal
    return float(np.rad2deg(np.arctan2(normal[1], normal[0]))), -12.0
