"""Pontryagin's extremals: their flow, their ends, and how one is found."""
