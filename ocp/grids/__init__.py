"""Schemes that solve the Hamilton-Jacobi equation on a grid."""
