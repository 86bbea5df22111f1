"""What is imposed on a slider, and its motion in time."""
