"""ManiSkill as far as RoboMME differs with it: the fork that RoboMME asks for, or another one.

`STAND_IN_MANI_SKILL` says which: `fork` (by default), `index` as the package index has it, or
`strange`, which nothing can mend.
"""

import os

KIND = os.environ.get("STAND_IN_MANI_SKILL", "fork")
