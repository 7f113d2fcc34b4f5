"""Pictures of one run."""

from kreps import plotting  # noqa: F401  (first, as it makes Matplotlib importable in any case)
