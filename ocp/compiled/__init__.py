"""From a CasADi graph to compiled, cached numba functions."""
