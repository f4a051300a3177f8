"""Pictures by MuJoCo's renderer, OpenGL, of the same scenes and looks as `shading` draws: with shadows, smoothed edges.

It needs EGL or OSMesa, libraries of the system.
"""

import contextlib
import itertools
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import mujoco
import numpy as np

from jaxlfi.envs import opengl
from jaxlfi.envs.whip.frames import Frames
from jaxlfi.envs.whip.rig import HAND, SECTION
from jaxlfi.envs.whip.vision.camera import Camera
from jaxlfi.envs.whip.vision.looks import CLUTTER, Look, Surface
from jaxlfi.envs.whip.vision.raster import DLO

TEXTURE = 512
"""Side of the textures of table and wall, in pixels."""
COVERED = 2.0
"""Side of what a texture covers before it repeats, in m."""
SHADOWS, SAMPLES = 1024, 4
"""Side of the shadow maps in pixels, and samples a pixel."""
XML = f"""
<mujoco>
  <visual>
    <global offwidth="2048" offheight="2048"/>
    <quality shadowsize="{SHADOWS}" offsamples="{SAMPLES}"/>
    <map znear="0.01" zfar="30" shadowclip="1.5"/>
  </visual>
  <statistic center="0.45 0 0.2" extent="1"/>
  <asset>
    <texture name="table" type="2d" builtin="flat" width="{TEXTURE}" height="{TEXTURE}"/>
    <texture name="wall" type="2d" builtin="flat" width="{TEXTURE}" height="{TEXTURE}"/>
    <material name="table" texture="table" texrepeat="{2 / COVERED} {2 / COVERED}" texuniform="true" specular="0"/>
    <material name="wall" texture="wall" texrepeat="{2 / COVERED} {2 / COVERED}" texuniform="true" specular="0"/>
  </asset>
  <worldbody>
    <camera name="camera"/>
    <light name="first" type="directional"/>
    <light name="second" type="directional"/>
    <geom name="table" type="plane" size="0 0 1" material="table"/>
    <geom name="wall" type="plane" size="0 0 1" zaxis="0 -1 0" material="wall"/>
  </worldbody>
</mujoco>"""


class MuJoCoRenderer(contextlib.AbstractContextManager):
    """MuJoCo's renderer with its context of OpenGL, which is slow to make and is kept; use it in `with`, or close it.

    It can be used by several threads: what it draws, it draws in one of its own, as contexts are a thread's.

    Attributes:
        size: of the pictures, in pixels.
    """

    def __init__(self, size: int = 256):
        """Make the context.

        Raises:
            RuntimeError: where neither EGL nor OSMesa can be had.
        """
        self.size = size
        self._thread = ThreadPoolExecutor(1)
        self._stage = self._thread.submit(_Stage, size).result()

    def __exit__(self, *_) -> None:
        """Close it."""
        self.close()

    def close(self) -> None:
        """Let go of the context."""
        self._thread.submit(self._stage.free).result()
        self._thread.shutdown()

    def render(self, camera: Camera, frame: Frames, cube_side: float, look: Look) -> tuple[np.ndarray, np.ndarray]:
        """The picture of one frame and its labels, as `shading.shaded` has them.

        Returns:
            Colours from 0 to 255, shape [size, size, 3], and labels, shape [size, size].
        """
        plain = jax.device_get((camera, frame, look))
        return self._thread.submit(self._stage.render, plain[0], plain[1], float(cube_side), plain[2]).result()


class _Stage:
    """What belongs to one thread: a context of OpenGL, and a model of all that is the same in every picture."""

    def __init__(self, size: int):
        self._size = size
        self._model = mujoco.MjModel.from_xml_string(XML)
        self._data = mujoco.MjData(self._model)
        self._gl = opengl.context(size, size)
        self._gl.make_current()
        self._made = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._made)
        self._scene = mujoco.MjvScene(self._model, maxgeom=200)
        self._covers: dict[str, Any] = {}

    def free(self) -> None:
        """Let go of the context."""
        self._made.free()
        self._gl.free()

    def render(self, camera: Camera, frame: Frames, cube_side: float, look: Look) -> tuple[np.ndarray, np.ndarray]:
        """Draw one picture, as above."""
        self._light(look)
        for name in ("table", "wall"):
            self._cover(name, getattr(look, name), float(look.grain[1]), look)
        self._model.geom("wall").pos[1] = float(look.wall_distance)
        view = self._model.camera("camera")
        view.pos[:], view.quat[:] = camera.position, camera.orientation
        view.fovy[:] = float(camera.field_of_view)
        mujoco.mj_forward(self._model, self._data)
        of = mujoco.MjvCamera()
        of.type, of.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
        mujoco.mjv_updateScene(
            self._model,
            self._data,
            mujoco.MjvOption(),
            None,
            of,
            mujoco.mjtCatBit.mjCAT_ALL.value,
            self._scene,
        )
        tint = np.asarray(look.tint, np.float32)
        labels = [0] * self._scene.ngeom
        for label, centre, turn, half, colour in _boxes(frame, cube_side, look):
            geom = self._scene.geoms[self._scene.ngeom]
            mujoco.mjv_initGeom(
                geom, mujoco.mjtGeom.mjGEOM_BOX, half, centre, turn.ravel(), np.append(colour * tint, 1).astype("f4")
            )
            geom.segid, geom.specular, geom.shininess = self._scene.ngeom, float(look.gloss), 0.3
            self._scene.ngeom += 1
            labels.append(label)
        picture = self._drawn()
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = True
        self._scene.flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = True
        numbers = self._drawn().astype(np.int32) @ np.array([1, 2**8, 2**16])  # one more than `segid`
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = False
        self._scene.flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = False
        return picture, np.array([0, *labels], np.uint8)[numbers]

    def _drawn(self) -> np.ndarray:
        pixels = np.empty((self._size, self._size, 3), np.uint8)
        area = mujoco.MjrRect(0, 0, self._size, self._size)
        mujoco.mjr_render(area, self._scene, self._made)
        mujoco.mjr_readPixels(pixels, None, area, self._made)
        return pixels[::-1].copy()

    def _light(self, look: Look) -> None:
        head = self._model.vis.headlight
        head.ambient[:], head.diffuse[:], head.specular[:] = float(look.ambient), 0.0, 0.0
        for i, name in enumerate(("first", "second")):
            light = self._model.light(name)
            light.dir[:], light.castshadow[:] = -np.asarray(look.lights[i]), i == 0
            light.pos[:] = 1.2 * np.asarray(look.lights[i]) + [0.45, 0.0, 0.2]
            light.ambient[:], light.diffuse[:], light.specular[:] = 0.0, float(look.brightness[i]), 0.3

    def _cover(self, name: str, surface: Surface, grain: float, look: Look) -> None:
        """Give a table or a wall its texture, unless it has it."""
        covers = surface, grain, look.tint, look.waves, look.phases
        if name in self._covers and jax.tree.all(jax.tree.map(np.array_equal, self._covers[name], covers)):
            return
        texture = self._model.texture(name)
        bitmap = _bitmap(surface, grain, look, along=(0, 1) if name == "table" else (0, 2))
        start = texture.adr[0]
        self._model.tex_data[start : start + bitmap.size] = bitmap.ravel()
        mujoco.mjr_uploadTexture(self._model, self._made, texture.id)
        self._covers[name] = covers


def _boxes(
    frame: Frames, cube_side: float, look: Look
) -> Iterator[tuple[int, np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Label, centre, orientation as a matrix, half sizes and colour of every box in the scene."""
    colours = np.asarray(look.colours)
    for i in range(DLO - 1):
        yield i + 1, *_placed(frame.cubes[i], _matrix(frame.orientations[i]), [cube_side / 2] * 3), colours[i]
    nodes = np.asarray(frame.dlo, float)
    for first, second in itertools.pairwise(nodes):
        length = np.linalg.norm(second - first)
        along = (second - first) / max(length, 1e-9)
        across = np.cross(along, [0.0, 1.0, 0.0])
        across /= max(np.linalg.norm(across), 1e-9)
        turn = np.stack([across, np.cross(along, across), along], axis=1)
        # A little longer than from node to node, where the mitres would be.
        half = [SECTION / 2, SECTION / 2, length / 2 + SECTION / 16]
        yield DLO, *_placed((first + second) / 2, turn, half), colours[DLO - 1]
    x, z = np.asarray(frame.gripper, float)
    yield 0, *_placed([x, 0.0, z + HAND[2]], np.eye(3), HAND), np.asarray(look.gripper)
    clutter = look.clutter
    for i in range(CLUTTER + 1):
        if clutter.there[i]:
            turn = _matrix(clutter.orientations[i])
            yield 0, *_placed(clutter.centres[i], turn, clutter.half_sizes[i]), np.asarray(clutter.colours[i])


def _placed(centre, turn, half) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.asarray(centre, float), np.asarray(turn, float), np.asarray(half, float)


def _matrix(quaternion) -> np.ndarray:
    out = np.empty(9)
    mujoco.mju_quat2Mat(out, np.asarray(quaternion, float))
    return out.reshape(3, 3)


def _bitmap(surface: Surface, grain: float, look: Look, along: tuple[int, int]) -> np.ndarray:
    """A surface's pattern with its grain, shape [TEXTURE, TEXTURE, 3]."""
    place = (np.arange(TEXTURE) + 0.5) / TEXTURE * COVERED
    first, second = np.meshgrid(place, place)
    period, angle = float(surface.period), float(surface.angle)
    turned = np.cos(angle) * first + np.sin(angle) * second, np.cos(angle) * second - np.sin(angle) * first
    cells = [np.floor(turned[i] / period + float(surface.phase[i])) for i in range(2)]
    fraction = {0: 0 * first, 1: sum(cells) % 2, 2: cells[0] % 2}[int(surface.pattern)][..., None]
    colours, waves = np.asarray(surface.colours), np.asarray(look.waves)[:, along]
    phases = waves[:, 0, None, None] * first + waves[:, 1, None, None] * second
    noise = np.sin(phases + np.asarray(look.phases)[:, None, None]).sum(0) * (2 / len(waves)) ** 0.5
    painted = colours[0] * (1 - fraction) + colours[1] * fraction
    covered = painted * np.asarray(look.tint) * (1 + grain * noise[..., None])
    return np.round(255 * np.clip(covered, 0, 1)).astype(np.uint8)
