"""The simulated world: MuJoCo plant, sensors, disturbances."""
