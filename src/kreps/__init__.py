"""Kernel-based, non-parametric policy search."""
