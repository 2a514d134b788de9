"""The robot: its model and limits, kinematics, control, and pushers without learning."""
