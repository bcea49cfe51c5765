"""Upper bounds of what datasets hold.

Readers of untrusted files check them before they allocate memory; a build checks them before it
stores anything, so that every reader accepts what was built.
"""

MAX_VECTOR = 1 << 14
"""Values of a state or an action. Beyond it, LeRobot's statistics exceed the size of a header."""

MAX_PIXELS = 1 << 24
"""Pixels of an image: twice 3840 × 2160."""

MAX_FRAME_VALUES = 4 * MAX_PIXELS
"""Values of a feature in a frame, such as those of an image with transparency."""

MAX_READ_VALUES = 1 << 26
"""Values of a column that are read at once, such as all states of an episode."""

MAX_NAME = 200
"""Characters of a feature's name, which the template of a path may repeat, or of a value's name."""

MIN_RATE, MAX_RATE = 1e-3, 1e4
"""Frames per second that are read and written."""
