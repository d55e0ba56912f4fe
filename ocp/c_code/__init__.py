"""Compiled kernels translated to C."""
