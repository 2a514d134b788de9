"""What goes with exported networks to a robot."""
