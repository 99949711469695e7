"""How the parameters move: Adam over any population, and the schedules of its learning rates."""
