"""Upper bounds of what datasets hold.

Readers of untrusted files check them before they allocate memory; a build checks them before it
stores anything, so that every reader accepts what was built.
"""

MAX_VECTOR = 1 << 14
"""Values of a state or an action. Beyond it, LeRobot's statistics exceed the size of a header."""

MAX_FRAME_VALUES = 1 << 26
"""Values in a frame of a camera: twice an image of 3840 × 2160 pixels."""

MAX_READ_VALUES = 1 << 26
"""Values of a column that are read at once, such as all states of an episode."""

MAX_NAME = 200
"""Characters of a feature's name, which the template of a path may repeat, or of a value's name."""

MIN_RATE, MAX_RATE = 1e-3, 1e6
"""Frames per second."""
