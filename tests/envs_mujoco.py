"""Shared by tests of MuJoCo tasks: an arm with a driven shoulder, and its recording by a plain loop."""

import mujoco
import numpy as np

from jaxlfi.envs.mujoco.logs import Log

ARM = """
<mujoco model="arm">
  <option timestep="0.004" integrator="implicitfast"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.08"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" density="900"/>
      <body name="fore" pos="0 0 -0.4">
        <joint name="elbow" axis="0 1 0" damping="0.03"/>
        <geom type="capsule" fromto="0 0 0 0.1 0 -0.3" size="0.015" density="700"/>
        <site name="tip" pos="0.1 0 -0.3"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="shoulder" gear="1.5"/></actuator>
  <sensor>
    <jointpos name="angle" joint="shoulder"/>
    <framelinvel name="velocity" objtype="site" objname="tip"/>
  </sensor>
</mujoco>
"""


def driven(times):
    """A torque that every shift or reflection changes."""
    return 0.9 * np.sin(3 * times) + 0.4 * times


def recorded(xml=ARM, interval=0.02, count=101, start=(0.0, 0.0), delay=0.0, edit=lambda model: None):
    """The sensor readings of a model under `driven`, sampled and held at the interval, by a loop of single steps.

    Args:
        xml: XML of the model.
        interval: sampling interval, a multiple of the model's step.
        count: number of samples.
        start: initial positions of both joints.
        delay: delay of the controls, a multiple of the step.
        edit: function that changes the compiled model.
    """
    model = mujoco.MjModel.from_xml_string(xml)
    edit(model)
    data, substeps = mujoco.MjData(model), round(interval / model.opt.timestep)
    data.qpos[:] = start
    times, sensed = interval * np.arange(count), []
    for step in range(substeps * (count - 1) + 1):
        held = max(step - round(delay / model.opt.timestep), 0) // substeps
        data.ctrl[0] = driven(times[held])
        mujoco.mj_step(model, data)  # sensors are those of the state before the step
        if step % substeps == 0:
            sensed.append(data.sensordata.copy())
    sensed = np.array(sensed)
    signals = {"motor": driven(times), "angle": sensed[:, 0]}
    return Log(times, signals | {f"velocity[{i}]": sensed[:, 1 + i] for i in range(3)}, "recorded")
