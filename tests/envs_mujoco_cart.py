"""The task of a cart on a rail, shared by tests of loops."""

from jaxlfi.rl.preparation import Control, Preparation, Signal

MODEL = """
<mujoco model="cart">
  <option timestep="0.01" gravity="0 0 0"/>
  <worldbody>
    <body name="cart">
      <joint name="rail" type="slide" axis="1 0 0" damping="5"/>
      <geom size="0.1" mass="2"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="rail" ctrlrange="-4 6"/></actuator>
  <sensor><jointpos name="place" joint="rail"/></sensor>
</mujoco>
"""
TASK = """
model = "cart.xml"
[parameters."body/cart/mass"]
support = [1.0, 3.0]
truth = 2.5
[noise]
place = 0.0
[initial]
"rail/qpos" = -0.5
[policy]
interval = 0.1
duration = 1.0
observed = ["joint/rail/qvel"]
costs = { push = 0.5 }
[policy.targets.place]
value = 0.25
weight = 2.0
[policy.initial]
"rail/qpos" = [1.0, 2.0]
"""
PREPARATION = Preparation((Signal("joint/rail/qvel", "m/s"),), (Control("push", -4.0, 6.0),), 0.1, 10)
