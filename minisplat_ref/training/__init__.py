"""Training: the state, the loop, the schedule of events, Adam and its learning rates."""
