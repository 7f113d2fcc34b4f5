"""The tasks of the paper as Gymnasium environments, and the wrapper that restarts any of them."""

from kreps.envs.restart import RandomRestart

__all__ = ["RandomRestart"]
