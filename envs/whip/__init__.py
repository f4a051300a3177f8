"""The DLO whipping task: physics, camera, reward and Real2Sim."""
