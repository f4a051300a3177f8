"""A reference object as a robot: a gripper that is commanded, and a camera in whose images keypoints are found."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxlfi.envs.whip.aftermath import Aftermath, displaced, retreat
from jaxlfi.envs.whip.observer import Observer
from jaxlfi.envs.whip.reference_objects.objects import ReferenceObject
from jaxlfi.envs.whip.reference_objects.observation import HEX, IMAGE_SIZE, SEEN_THROUGH, Perception, found
from jaxlfi.envs.whip.reference_objects.scene import PLACE, SIMULATOR
from jaxlfi.envs.whip.reference_objects.simulation import ReferenceRig, UnstableError, stacked
from jaxlfi.envs.whip.rig import START
from jaxlfi.envs.whip.vision.camera import Camera, side_camera
from jaxlfi.robots.clock import Simulated
from jaxlfi.robots.robot import Command, Observation

POINTS = 29
"""Points of a centreline as it is rendered: those of the longest DLO of Phi, so that one program serves all objects."""


class ReferenceRobot:
    """A `jaxlfi.robots.robot.Robot` whose commands each take a control interval, which passes on a simulated clock.

    Attributes:
        about: what is to be recorded of it.
        simulated_clock: of the loop that controls it.
        camera: that sees it.
        observations: its observations so far, each of shape [28].
        actions: displacements so far, the last of which may have made the simulation unstable, each of shape [2].
        film: true frames so far: one, then the ten of each command.
    """

    def __init__(
        self,
        key: jax.Array,
        dlo: ReferenceObject,
        place=PLACE,
        camera: Camera | None = None,
        perception: Perception | None = None,
    ):
        """Let the object come to rest, and see it.

        Args:
            key: of the camera's noise.
            dlo: the object in the gripper.
            place: the scene.
            camera: that sees it; by default the side camera of the scene.
            perception: what finds keypoints in a frame; by default `observation.found`.

        Raises:
            UnstableError: if the object cannot come to rest.
        """
        self.camera = side_camera(place) if camera is None else camera
        words = SEEN_THROUGH if perception is None else perception.words
        self.about = {
            "camera": self.camera,
            "source": "simulated",
            "description": f"{dlo.name} acted on by a policy, seen through {words}",
            "image_size": IMAGE_SIZE,
            "colours": HEX,
            "provenance": {"simulator": SIMULATOR},
        }
        self.simulated_clock = Simulated()
        self.observations: list[np.ndarray] = []
        self.actions: list[np.ndarray] = []
        self._perception = _found if perception is None else perception
        self._key, self._side, self._observer = key, jnp.float32(place.cube_side), Observer()
        self._rig = ReferenceRig(dlo, place)
        self._target = np.array(START)
        self.film = [stacked([self._rig.reset()])]
        self._see()

    def observe(self) -> Observation:
        """What is seen at the end of the last control interval."""
        number = len(self.observations) - 1
        return Observation(self.observations[-1], number, target=self._target, extras={"seen": self._seen})

    def act(self, command: Command) -> None:
        """Move the set-point, over a control interval.

        Raises:
            ValueError: for displacements of more than 0.06 m.
            UnstableError: if the simulation becomes unstable.
        """
        self.actions.append(command.displacement)
        self.film.append(self._rig.step(command.displacement))
        self._target = command.target
        self._see()

    def stop(self) -> None:
        """Nothing moves between commands."""

    def aftermath(self) -> Aftermath:
        """What the episode leaves behind once the gripper has retracted and the cubes have come to rest; ends it."""
        before, now = self.film[0].cubes[0], self.film[-1].cubes[-1]
        try:
            for action in retreat(self._target, np):
                now = self._rig.step(action).cubes[-1]
        except UnstableError:
            return Aftermath(displaced(before, now, float(self._side)), np.array(True))
        return Aftermath(displaced(before, now, float(self._side)), np.array(False))

    def _see(self) -> None:
        frame = jax.tree.map(lambda leaf: leaf[-1], self.film[-1])
        padding = frame.replace(dlo=padded(frame.dlo, POINTS))
        single = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), padding)
        key = jax.random.fold_in(self._key, len(self.observations))
        keypoints, seen = self._perception(key, self.camera, single, self._side)
        self._seen = np.asarray(seen)
        self.observations.append(self._observer.observe(frame.gripper, np.asarray(keypoints), self._seen))


_found = jax.jit(found)


def padded(line: Float[np.ndarray, "n 3"], points: int) -> Float[np.ndarray, "points 3"]:
    """The same polyline with more points: its first segments are halved.

    Raises:
        ValueError: if it has more points than that, or fewer than half.
    """
    line, more = np.asarray(line), points - len(line)
    if not 0 <= more < len(line):
        raise ValueError(f"points: expected {len(line)} to {2 * len(line) - 1}, got {points}")
    halves = (line[:more] + line[1 : more + 1]) / 2
    first = np.stack([line[:more], halves], axis=1).reshape(-1, 3)
    return np.concatenate([first, line[more:]])
