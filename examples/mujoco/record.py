"""Make the recordings of these examples: what stands for reality is simulated otherwise than inference does.

    python examples/mujoco/record.py

The integrator is another (Runge-Kutta, a tenth of the step), and there are forces that the models do not have: stiction
that falls with speed, and the drag of a cable. The truths are those of the .toml files.
"""

import csv
from pathlib import Path

import mujoco
import numpy as np

FOLDER = Path(__file__).parent
NOISE = 0.002
"""Standard deviation of the encoders' noise, in rad."""


def furuta():
    """Write furuta.csv: four seconds of a torque that falls while its frequency rises, at 100 Hz."""
    spec = mujoco.MjSpec.from_file(str(FOLDER / "furuta.xml"))
    spec.option.timestep, spec.option.integrator = 0.0002, mujoco.mjtIntegrator.mjINT_RK4
    spec.joint("pendulum").damping[0] = 0.0003
    spec.joint("arm").frictionloss = 0.006
    spec.geom("arm").mass = 0.09
    model = spec.compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    times = 0.01 * np.arange(400)
    torque = 0.08 * np.sin(2 * np.pi * times * (1.0 + 0.3 * times)) * np.exp(-0.15 * times)
    angles = []
    for force in torque:
        angles.append(data.qpos.copy())
        data.ctrl[0] = force
        for _ in range(50):
            speed, angle = data.qvel[0], data.qpos[0]
            stiction = -0.0002 * np.tanh(speed / 0.01) * np.exp(-((speed / 0.3) ** 2))
            cable = -0.00005 * angle
            data.qfrc_applied[0] = stiction + cable
            mujoco.mj_step(model, data)
    measured = np.array(angles) + NOISE * rng.standard_normal((len(times), 2))
    with (FOLDER / "furuta.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["time [s]", "motor [N m]", "arm angle [rad]", "pendulum angle [rad]"])
        rows = zip(12.5 + times, torque, *measured.T, strict=True)  # a clock that does not begin at zero
        writer.writerows([f"{number:.6g}" for number in row] for row in rows)


if __name__ == "__main__":
    furuta()
