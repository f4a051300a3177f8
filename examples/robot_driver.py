"""A driver for your own robot: everything that a control loop needs, with a simulated arm and camera to try it on.

    python examples/robot_driver.py
    cd examples && jaxlfi whip control constant:0.03,-0.03 --robot robot_driver:driver --out ../rollout.npz

Replace `PretendedArm` and `PretendedCamera` with your own; `Driver` can stay as it is. It needs NumPy only.
"""

import numpy as np

from jaxlfi.envs.whip.observer import Observer
from jaxlfi.rl.deployment import Limits
from jaxlfi.robots.clock import Monotonic, Simulated
from jaxlfi.robots.loop import Loop
from jaxlfi.robots.robot import Observation

PERIOD = 0.16
CAMERA = {"position": [0.45, -0.9, 0.25], "orientation": [0.5**0.5, 0.5**0.5, 0.0, 0.0], "field_of_view": 36.87}


class PretendedArm:
    """A Cartesian controller whose set-point moves straight to each target, and an arm that follows."""

    def __init__(self, clock):
        self.clock, self.since = clock, clock.now()
        self.before = self.target = np.array([0.40, 0.36])  # x and z in m

    def position(self):
        """Measured x and z, in m."""
        part = min((self.clock.now() - self.since) / PERIOD, 1.0)
        return self.before + part * (self.target - self.before)

    def move_to(self, target):
        """Begin to move the set-point."""
        self.before, self.target, self.since = self.position(), np.array(target), self.clock.now()

    def hold(self):
        """Stay here."""
        self.move_to(self.position())


class PretendedCamera:
    """A camera, 60 frames per second; the DLO hangs straight beside six stacked cubes and can push over the top one."""

    def __init__(self, clock, arm):
        self.clock, self.arm, self.fallen = clock, arm, 0.0

    def latest(self):
        """Number and time of the latest frame, keypoints in normalised pixels, and which of them were found."""
        number = int(self.clock.now() * 60)
        x, z = self.arm.position()
        dlo = [(x, z - 0.25 * part) for part in (0.25, 0.5, 0.75, 1.0)]
        self.fallen = max(self.fallen, 0.08 * (x > 0.585 and z - 0.25 < 0.15))
        cubes = [(0.60 + self.fallen * (cube == 5), 0.0125 + 0.025 * cube) for cube in range(6)]
        # Seen from a camera 0.9 m away, the image is 0.6 m wide.
        keypoints = [(0.5 + (x - 0.45) / 0.6, 0.5 - (z - 0.25) / 0.6) for x, z in dlo + cubes]
        return number, number / 60, np.array(keypoints), np.ones(10, bool)


class Driver:
    """The methods that the loop calls: observe, act and stop."""

    def __init__(self, arm, camera, clock):
        self.arm, self.camera, self.clock, self.observer = arm, camera, clock, Observer()
        self.about = {"camera": CAMERA, "source": "simulated", "description": "a pretended arm"}

    def observe(self):
        """The latest observation."""
        number, taken, keypoints, seen = self.camera.latest()
        values = self.observer.observe(self.arm.position(), keypoints, seen)
        return Observation(values, number, self.clock.now() - taken, target=self.arm.target, extras={"seen": seen})

    def act(self, command):
        """Follow a command, and return at once."""
        self.arm.move_to(command.target)

    def stop(self):
        """Come to rest."""
        self.arm.hold()


def driver(clock=None):
    """The driver for `--robot robot_driver:driver`, by default on the system's clock."""
    clock = Monotonic() if clock is None else clock
    arm = PretendedArm(clock)
    return Driver(arm, PretendedCamera(clock, arm), clock)


def main():
    """Knock the top cube over with a constant action, on a clock that runs as fast as it can."""
    clock = Simulated()
    clock.pass_by(1.0)
    loop = Loop(
        Limits(step=(0.06, 0.06), speed=0.25, low=(0.275, 0.1), high=(0.6, 0.5)),
        moved=(0, 1),  # the first two numbers of an observation are the gripper's x and z
        size=28,
        rate=1 / PERIOD,
        steps=16,
        over=lambda observation: observation[27] > 0.5,  # the top cube was hit
        clock=clock,
    )
    log = loop.run(driver(clock), lambda observation: np.array([0.03, 0.0]))
    for step, (target, asked) in enumerate(zip(log.targets, log.asked, strict=True)):
        print(f"{step * PERIOD:.2f} s  asked for {asked}, set-point {target.round(3)}")
    print(f"over after {log.over} steps, {log.missed} deadlines missed")
    return log


if __name__ == "__main__":
    main()
