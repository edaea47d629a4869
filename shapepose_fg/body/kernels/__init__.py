"""Compiled kernels: bodies row by row, and their normal equations."""
