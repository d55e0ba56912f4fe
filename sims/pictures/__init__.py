"""Figures and replays of plans and of RRT^X."""
