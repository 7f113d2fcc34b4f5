"""The tasks of the paper as Gymnasium environments, and a wrapper for random restarts."""

from kreps.envs.restart import RandomRestart

__all__ = ["RandomRestart"]
