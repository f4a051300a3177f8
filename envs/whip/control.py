"""Running policies on robots in the whipping task: settings of the control loop, and its log as a recording."""

import argparse
import dataclasses
import json
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.envs.whip import rules
from jaxlfi.envs.whip.environment import ACTIONS, LIMITS, OBSERVATIONS
from jaxlfi.envs.whip.frames import COLOURS
from jaxlfi.envs.whip.observer import FLAGS
from jaxlfi.envs.whip.parameters import median
from jaxlfi.envs.whip.recording import Recording
from jaxlfi.envs.whip.rig import CONTROL_INTERVAL, KEYPOINTS
from jaxlfi.envs.whip.vision.camera import Camera, side_camera
from jaxlfi.io.serialise import json_safe
from jaxlfi.registry import ROBOTS
from jaxlfi.rl import deployment
from jaxlfi.rl.policy import Policy
from jaxlfi.robots.client import SocketRobot
from jaxlfi.robots.episode import Act, Log
from jaxlfi.robots.loop import Loop
from jaxlfi.robots.robot import Robot

ABOUT = {
    "camera": dict,
    "source": str,
    "description": str,
    "image_size": int,
    "colours": dict,
    "facts": dict,
    "provenance": dict,
}
"""Information that a robot may give about itself: fields of `Recording`, and their types."""


def is_over(observation: np.ndarray) -> bool:
    """Whether an episode ends: the top cube is hit, or the gripper has been measured outside of its workspace."""
    return bool(observation[FLAGS + rules.TOP] > 0.5 or rules.outside(np.asarray(observation[:2], np.float32)))


LOOP = Loop(LIMITS, moved=(0, 1), size=OBSERVATIONS.size, rate=1 / CONTROL_INTERVAL, steps=rules.STEPS, over=is_over)
"""The control loop as in training: 16 steps at 6.25 Hz."""


def recording_of(log: Log, about: Mapping[str, Any]) -> Recording:
    """The log of a whole episode as a recording, which inference can use.

    Keypoints outside of the image are clipped to its edge.

    Args:
        log: log of the loop.
        about: fields of `Recording` (`described`).

    Raises:
        ValueError: for a log that is not a recording, such as one of a robot that was stopped before the end.
    """
    steps, observations = len(log.actions), np.asarray(log.observations)
    if log.stopped or steps != rules.STEPS:
        raise ValueError(f"expected {rules.STEPS} control steps, got {steps}{log.stopped and ': '}{log.stopped}")
    if abs(log.period / CONTROL_INTERVAL - 1) > 0.01:
        raise ValueError(f"expected control steps of {CONTROL_INTERVAL} s, as simulations have, got {log.period:g} s")
    seen = log.extras.get("seen", np.ones((len(log.times), KEYPOINTS), bool))
    return Recording(
        times=log.times,
        gripper=observations[:, :2],
        keypoints=np.clip(observations[:, 2:FLAGS].reshape(-1, KEYPOINTS, 2), 0.0, 1.0),
        seen=np.asarray(seen, bool),
        actions=log.actions,
        frame_rate=round(float(1 / np.median(np.diff(log.times))), 6),
        control_interval=log.period,
        hits=observations[:, FLAGS:] > 0.5,
        **about,
    )


def arrays(log: Log) -> dict[str, np.ndarray]:
    """The arrays of a log that are not part of a recording, with names of their own."""
    kept = ("times", "observations", "asked", "actions", "targets", "held", "lateness")
    return {f"log/{name}": getattr(log, name) for name in kept}


def summary(log: Log) -> str:
    """A one-line summary of an episode."""
    hit = [name for name, flags in zip(COLOURS, log.observations[:, FLAGS:].T, strict=True) if (flags > 0.5).any()]
    over = "" if log.over is None else f", over after {log.over}"
    return (
        f"{len(log.actions)} steps at {1 / log.period:g} Hz{over}, {int(log.held.sum())} without a usable observation, "
        f"{log.missed} deadlines missed, hit {', '.join(hit) or 'nothing'}"
    )


def loop_of(act: Act, arguments: argparse.Namespace) -> Loop:
    """The loop that a policy was trained for, as changed by the arguments of `jaxlfi whip control`.

    Raises:
        ValueError: for arguments that would loosen limits, and for numbers that are not positive.
    """
    says = isinstance(act, Policy) and deployment.KEY in act.schema
    loop = Loop.of(act, over=is_over) if says else LOOP
    low, high = (None, None) if arguments.workspace is None else np.reshape(arguments.workspace, (2, 2)).T.tolist()
    limits = loop.limits.tightened(arguments.max_step, arguments.max_speed, low, high)
    given = {"rate": arguments.rate, "max_age": arguments.max_age, "watchdog": arguments.watchdog}
    changes = {name: value for name, value in given.items() if value is not None}
    return dataclasses.replace(loop, limits=limits, holds=arguments.holds, **changes)


def robot_of(
    word: str, seed: int, remote: bool, perception: Any = None, token: str | None = None
) -> tuple[Robot, dict[str, Any]]:
    """The robot that a word stands for, and the information about it for a recording.

    Args:
        word: "socket://HOST:PORT", the name of a reference object, or "module:Factory" with options after commas.
        seed: the seed of a reference object's camera.
        remote: whether hosts other than this one are allowed.
        perception: function that finds keypoints in a reference object's frames; by default `observation.found`.
        token: token that a driver asks for; needed if it is on another host.

    Raises:
        ValueError: for other words, and for objects that are not robots.
        RobotError: if no driver answers.
    """
    if word.startswith("socket:"):
        robot = SocketRobot(word, OBSERVATIONS.names, ACTIONS.names, remote, token=token)
    elif ":" in word:
        robot = ROBOTS.load(word)
    else:
        from jaxlfi.envs.whip.reference_objects import objects
        from jaxlfi.envs.whip.reference_objects.robot import ReferenceRobot

        robot = ReferenceRobot(jax.random.key(seed), objects.load(word), perception=perception)
    try:
        return robot, described(getattr(robot, "about", {}))
    except BaseException:
        robot.stop()
        raise


def described(about: Mapping[str, Any]) -> dict[str, Any]:
    """A robot's information about itself as fields of a recording; without a camera, the nominal one, which is noted.

    Raises:
        ValueError: for fields that a recording does not have, or that have another type there.
    """
    if not isinstance(about, Mapping):
        raise ValueError(f"robot: expected a mapping as information about itself, got {about!r}")
    if unknown := set(about) - set(ABOUT):
        raise ValueError(
            f"robot: expected {', '.join(ABOUT)} as information about itself, got {', '.join(sorted(unknown))}"
        )
    fields = {"source": "real", "description": "a policy on a robot", **about}
    for name, value in fields.items():
        if name != "camera" and (type(value) is not ABOUT[name] or not _is_json(value)):
            raise ValueError(
                f"robot: expected {ABOUT[name].__name__} as its {name}, which JSON can hold, got {value!r}"
            )
    if "camera" not in about:
        noted = {**fields.get("provenance", {}), "camera": "nominal: the robot did not say"}
        return {**fields, "camera": side_camera(median()), "provenance": noted}
    camera, shapes = about["camera"], {"position": (3,), "orientation": (4,), "field_of_view": ()}
    if isinstance(camera, Camera):
        return fields
    try:
        parts = {name: jnp.asarray(camera[name], jnp.float32) for name in shapes}
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"robot: expected a camera's {', '.join(shapes)}, got {camera!r}") from error
    if {name: part.shape for name, part in parts.items()} != shapes:
        raise ValueError(f"robot: expected a camera's {', '.join(shapes)} of shapes [3], [4], [], got {camera!r}")
    return {**fields, "camera": Camera(**parts)}


def _is_json(value: Any) -> bool:
    try:
        json.dumps(json_safe(value), allow_nan=False)
    except (TypeError, ValueError):
        return False
    return True
