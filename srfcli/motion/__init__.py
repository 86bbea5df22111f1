"""What is imposed on a slider, and its motion in time."""

STEP_RISE = 0.02  # s over which steps of the load are rounded: five times the slider's bounce on its interface
