"""The environment: task, robot, sensors, transforms and the simulator beneath them."""
