"""The tasks with the constants of the authors' own experiment scripts.

The paper prints few constants.  `kreps/SwingUp-v0`, `kreps/Reaching-v0` and `kreps/ImageSwingUp-v0`
fill the gaps by choices of this project; the tasks here by what the authors' published scripts say.
docs/deviations.md has what these leave open.
"""
