"""The parts of ManiSkill that matter to RoboMME: of its fork, or of another version.

`STAND_IN_MANI_SKILL` says which: `fork` (by default), `index` as the package index has it, or
`strange`, which cannot be patched.
"""

import os

KIND = os.environ.get("STAND_IN_MANI_SKILL", "fork")
