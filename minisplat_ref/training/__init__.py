"""Training: the state, the loop, the schedule of what happens when, Adam and its learning rates."""
