"""Comparisons over many seeds: what is compared, how it is run, what is written."""
