"""Comparisons of methods over many seeds: definitions, execution and result files."""
