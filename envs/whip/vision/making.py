"""Data sets of pictures of random scenes, or of the FEM reference objects; one that was interrupted goes on."""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.envs.whip.frames import Frames
from jaxlfi.envs.whip.parameters import WhipParameters, randomised
from jaxlfi.envs.whip.physics.engine import Engine
from jaxlfi.envs.whip.vision import looks, photograph, pictures, scenes
from jaxlfi.envs.whip.vision.camera import Camera, project, side_camera
from jaxlfi.envs.whip.vision.keypoints import along
from jaxlfi.envs.whip.vision.masks import EVEN
from jaxlfi.envs.whip.vision.renderers import RENDERERS, Renderer

A_ROLLOUT = 4
"""Pictures of a rollout, at different times and with different looks."""
STREWN = 3
"""One in so many pictures of random scenes has its cubes strewn about."""


@dataclasses.dataclass(frozen=True)
class Asked:
    """The data set that is asked for.

    Attributes:
        count: number of pictures.
        seed: of the scenes, looks and shots.
        renderer: name in `renderers.RENDERERS`.
        sharp: without a camera's blur, exposure and noise, as for training, which draws them anew in every step.
        objects: names of FEM reference objects that are seen in turn; without any, random DLOs of the simulator.
    """

    count: int
    seed: int
    renderer: str
    sharp: bool
    objects: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class View:
    """The content of one picture.

    Attributes:
        frame: of the scene.
        camera: through which it is seen.
        cube_side: side of the cubes, in m.
        facts: what the index says of it.
    """

    frame: Frames
    camera: Camera
    cube_side: float
    facts: dict[str, Any]


def make(asked: Asked, folder: Path, engine: Engine, on_picture: Callable[[int], Any] = lambda number: None) -> int:
    """Make a data set, or what is missing of it; returns the number of its pictures.

    Args:
        asked: for.
        folder: of the data set.
        engine: the physics of random scenes.
        on_picture: called with the number of pictures there are.

    Raises:
        PicturesError: if there is something else in the folder.
        RuntimeError: where the renderer cannot be had.
    """
    with RENDERERS[asked.renderer](pictures.SIZE) as renderer:
        first = pictures.begun(folder, {"made": dataclasses.asdict(asked)})
        on_picture(first)
        for number, view in views(asked, engine, first):
            rgb, labels = _taken(asked, number, renderer, view)
            pictures.add(folder, number, rgb, labels, source=asked.renderer, **view.facts)
            on_picture(number + 1)
    return pictures.finish(folder)


def look(asked: Asked, number: int, view: View) -> looks.Look:
    """The look of a picture of a data set."""
    return jax.device_get(_look(_keys(asked, number)[0], _single(view.frame)))


def _taken(asked: Asked, number: int, renderer: Renderer, view: View) -> tuple[np.ndarray, np.ndarray]:
    """A picture of a data set with its labels, as bytes."""
    rgb, labels = renderer.render(view.camera, view.frame, view.cube_side, look(asked, number, view))
    _, key_shot, key_taken = _keys(asked, number)
    return (rgb if asked.sharp else np.asarray(_photographed(key_shot, key_taken, rgb))), labels


def _keys(asked: Asked, number: int) -> jax.Array:
    """Keys of a picture's look, of its camera's faults, and of their noise."""
    return jax.random.split(jax.random.fold_in(jax.random.key(asked.seed), number), 3)


def views(asked: Asked, engine: Engine, first: int) -> Iterator[tuple[int, View]]:
    """The numbers of pictures from a first one on, and what is to be seen in them."""
    seed = jax.random.fold_in(jax.random.key(asked.seed), 2**31 - 1)
    rolled = functools.partial(_of_objects, asked.objects) if asked.objects else functools.partial(_simulated, engine)
    for begin in range(first - first % (A_ROLLOUT * scenes.BATCH), asked.count, A_ROLLOUT * scenes.BATCH):
        several = rolled(jax.random.fold_in(seed, begin), begin // A_ROLLOUT)
        for place in range(A_ROLLOUT * scenes.BATCH):
            if first <= begin + place < asked.count:
                yield begin + place, several(place // A_ROLLOUT, place % A_ROLLOUT)


def _simulated(engine: Engine, key: jax.Array, begin: int) -> Callable[[int, int], View]:
    """A batch of random scenes; of one that is unstable, only its start is seen."""
    key_rollouts, key_strewn = jax.random.split(key)
    rolled = scenes.rollouts(key_rollouts, engine, scenes.BATCH)

    def view(rollout: int, which: int) -> View:
        one = jax.tree.map(lambda leaf: leaf[rollout], rolled)
        steps = len(one.frames.gripper)
        order = np.random.default_rng((begin + rollout, 7)).permutation(steps)
        step = int(order[which]) if one.valid else 0
        scene = {"rollout": begin + rollout, "step": step, **_numbers(one.parameters)}
        frame, side = jax.tree.map(lambda leaf: leaf[step], one.frames), float(one.parameters.cube_side)
        number = A_ROLLOUT * rollout + which
        if number % STREWN == 0:
            frame = jax.device_get(_strewn(jax.random.fold_in(key_strewn, number), _single(frame), side))
        return _view(frame, side_camera(one.parameters), side, scene)

    return view


def _of_objects(names: Sequence[str], key: jax.Array, begin: int) -> Callable[[int, int], View]:
    """Reference objects in turn, at places and under actions that differ from rollout to rollout."""
    from jaxlfi.envs.whip.reference_objects.objects import load
    from jaxlfi.envs.whip.reference_objects.scene import PLACE
    from jaxlfi.envs.whip.reference_objects.simulation import ReferenceRig

    @functools.lru_cache(maxsize=2)
    def rolled(rollout: int):
        dlo = load(names[(begin + rollout) % len(names)])
        key_place, key_actions = jax.random.split(jax.random.fold_in(key, rollout))
        drawn = jax.device_get(randomised(key_place, jnp.asarray(dlo.length), jnp.asarray(dlo.light_young)))
        place = PLACE.replace(stack=tuple(map(float, drawn.stack)), camera=tuple(map(float, drawn.camera)))
        return dlo, place, ReferenceRig(dlo, place).rollout(np.asarray(scenes.random_actions(key_actions)))[1]

    def view(rollout: int, which: int) -> View:
        dlo, place, frames = rolled(rollout)
        order = np.random.default_rng((begin + rollout, 7)).permutation(len(frames.gripper))
        step = int(order[which])
        scene = {"rollout": begin + rollout, "frame": step, "object": dlo.name}
        return _view(jax.tree.map(lambda leaf: leaf[step], frames), side_camera(place), float(place.cube_side), scene)

    return view


def _view(frame: Frames, camera: Camera, cube_side: float, scene: dict[str, Any]) -> View:
    (x, z), along = frame.gripper, np.asarray(_along(_single(frame).dlo))
    points = np.concatenate([[[x, 0.0, z]], along, frame.cubes])
    places = np.asarray(project(camera, jnp.asarray(points, jnp.float32)), float)
    grip, *keypoints = np.round(places, 5).tolist()
    return View(frame, camera, cube_side, {"grip": grip, "keypoints": keypoints, "scene": scene})


def _numbers(parameters: WhipParameters) -> dict[str, Any]:
    return {name: np.round(np.asarray(value, float), 9).tolist() for name, value in vars(parameters).items()}


def _single(frame: Frames) -> Frames:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), frame)


_look = jax.jit(looks.draw)
_strewn = jax.jit(scenes.strewn)
_along = jax.jit(lambda line: along(line, jnp.asarray(EVEN)))


@jax.jit
def _photographed(key_shot, key_taken, rgb):
    taken = photograph.taken(key_taken, photograph.draw(key_shot), rgb.astype(jnp.float32) / 255)
    return jnp.round(255 * taken).astype(jnp.uint8)
