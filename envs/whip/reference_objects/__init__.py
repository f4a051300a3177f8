"""An object that stands in for a real one: a soft body of finite elements, simulated apart from inference's chain."""
