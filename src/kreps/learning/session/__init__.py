"""Learning on a robot: the user's program has the loop, and the session answers it."""

from kreps.learning.session.robot import RobotSession

__all__ = ["RobotSession"]
