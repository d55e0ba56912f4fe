"""Optimal control as a nonlinear programme: Radau collocation and its check between nodes."""
