"""Model of the robot: parameters, dynamics, effects, allocation, rotations."""
