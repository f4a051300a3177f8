"""A simple simulated robot in its own process, to test a control loop: its camera loses, delays and spoils frames.

    python -m jaxlfi.robots.simulated POLICY --port 5005 --dropped 0.05 --delayed 0.05 --jitter 0.02

The policy's schema tells it what to measure. It lives in the loop's time, so that the same seed and the same commands
give the same observations, however fast the commands come.
"""

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxlfi.rl import deployment
from jaxlfi.rl.policy import Policy, load
from jaxlfi.robots import server
from jaxlfi.robots.clock import Clock, Simulated
from jaxlfi.robots.robot import Command, Observation

LAG = 0.08
"""Time constant of the approach to a set-point, in which the distance falls to 37 %, in s."""
PHASE = 0.25
"""Time from a frame to the next command, as a fraction of the control period."""
LATEST = 2.5
"""Largest delay of a frame, in control periods."""


class PointRobot:
    """A robot whose measured positions follow their set-points, and whose other signals swing about their centres.

    Its camera takes one frame per control period, in which everything is measured.
    """

    def __init__(
        self,
        policy: Policy,
        clock: Clock,
        seed: int = 0,
        dropped: float = 0.0,
        delayed: float = 0.0,
        spoiled: float = 0.0,
        jitter: float = 0.0,
    ):
        """It rests in the middle of its limits.

        Args:
            policy: policy whose schema states what is measured.
            clock: clock of the robot.
            seed: seed of all random events.
            dropped: fraction of frames that never come.
            delayed: fraction of frames that come up to 2.5 control periods late.
            spoiled: fraction of frames in which a number is missing.
            jitter: largest time by which frames are taken early or late, in s.

        Raises:
            ValueError: for fractions outside [0, 1], and a jitter of more than a quarter of a period.
        """
        facts = deployment.of_schema(policy.schema)
        for name, value in (("dropped", dropped), ("delayed", delayed), ("spoiled", spoiled)):
            if not 0 <= value <= 1:
                raise ValueError(f"{name}: expected a number in [0, 1], got {value}")
        if not 0 <= jitter <= PHASE * facts.control_interval:
            raise ValueError(f"jitter: expected at most {PHASE * facts.control_interval} s, got {jitter}")
        self.about = {"source": "simulated", "description": "a point that follows its set-point"}
        self._clock, self._seed, self._period, self._jitter = clock, seed, facts.control_interval, jitter
        self._chances = np.array([dropped, delayed, spoiled])
        names, units = list(policy.observed["names"]), policy.observed["units"]
        self._moved = [names.index(name) for name in facts.moved]
        self._centre = np.array(policy.observed["centre"], float)
        # Numbers without a unit are flags.
        self._swing = 0.1 * np.array(policy.observed["scale"]) * [unit != "" for unit in units]
        self._position = np.add(facts.limits.low, facts.limits.high) / 2
        self._target, self._since = self._position, -math.inf
        self._start: float | None = None
        self._frames = 0
        self._coming: list[tuple[float, float, Observation]] = []

    def observe(self) -> Observation | None:
        """The latest frame that has arrived."""
        now = self._advance()
        here = [frame for frame in self._coming if frame[0] <= now]
        if not here:
            return None
        _, taken, latest = max(here, key=lambda frame: frame[2].number)
        self._coming = [frame for frame in self._coming if frame[2].number >= latest.number]
        return Observation(latest.values, latest.number, now - taken, latest.target)

    def act(self, command: Command) -> None:
        """Approach a new set-point from now on."""
        now = self._advance()
        self._position, self._target, self._since = self._at(now), np.array(command.target), now

    def stop(self) -> None:
        """Stay in place."""
        self._target = self._position = self._at(self._clock.now())

    def _at(self, moment: float) -> np.ndarray:
        return self._target + (self._position - self._target) * math.exp(-max(moment - self._since, 0.0) / LAG)

    def _advance(self) -> float:
        """Take the frames up to now."""
        now = self._clock.now()
        self._start = now if self._start is None else self._start
        while True:
            rng = np.random.default_rng([self._seed, self._frames])
            early, wait, *chances = rng.uniform(size=5)
            taken = self._start + (self._frames - PHASE) * self._period + self._jitter * (2 * early - 1)
            if taken > now:
                return now
            dropped, delayed, spoiled = chances < self._chances
            if not dropped:
                values = self._centre + self._swing * np.sin(2 * (taken - self._start) + np.arange(len(self._swing)))
                values[self._moved] = self._at(taken)
                if spoiled:
                    values[rng.integers(len(values))] = np.nan
                comes = taken + delayed * wait * LATEST * self._period
                self._coming.append((comes, taken, Observation(values, self._frames, 0.0, self._target)))
            self._frames += 1


def main(argv: Sequence[str] | None = None) -> None:
    """Serve the robot until the process is ended."""
    parser = argparse.ArgumentParser(prog="python -m jaxlfi.robots.simulated", description=__doc__.splitlines()[0])
    parser.add_argument("policy", type=Path, metavar="POLICY", help="a policy.npz, whose schema names the signals")
    parser.add_argument("--port", type=int, default=0, metavar="N", help="port (default: any free one)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of all random events (default: 0)")
    parser.add_argument("--dropped", type=float, default=0.0, metavar="P", help="fraction of frames that are lost")
    parser.add_argument("--delayed", type=float, default=0.0, metavar="P", help="fraction of frames that are late")
    parser.add_argument("--spoiled", type=float, default=0.0, metavar="P", help="fraction of frames without one value")
    parser.add_argument("--jitter", type=float, default=0.0, metavar="S", help="largest error of a frame's time, in s")
    parser.add_argument(
        "--watchdog",
        type=float,
        default=server.WATCHDOG,
        metavar="S",
        help="stop after this time without a request, in s",
    )
    parser.add_argument("--journal", type=Path, metavar="FILE", help="a file that logs all requests, as lines of JSON")
    arguments = parser.parse_args(argv)
    chances = {name: getattr(arguments, name) for name in ("seed", "dropped", "delayed", "spoiled", "jitter")}
    try:
        policy = load(arguments.policy)
        make = lambda clock: PointRobot(policy, clock, **chances)
        make(Simulated())
        if not 0 <= arguments.port < 65536:
            raise ValueError(f"port: expected a number from 0 to 65535, got {arguments.port}")
        if not 0 < arguments.watchdog < math.inf:
            raise ValueError(f"watchdog: expected a positive number of seconds, got {arguments.watchdog}")
        journal = server.write_to(arguments.journal) if arguments.journal else lambda event: None
        listener = server.listen(arguments.port)
    except (ValueError, OSError) as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
    print(f"listening on socket://127.0.0.1:{listener.getsockname()[1]}", flush=True)
    facts, names = deployment.of_schema(policy.schema), list(policy.observed["names"])
    moved = [names.index(name) for name in facts.moved]
    try:
        server.serve(
            listener, make, names, policy.acted["names"], moved, facts.limits, arguments.watchdog, journal, Simulated
        )
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
