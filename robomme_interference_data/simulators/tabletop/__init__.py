"""The embedded suite: nine task families on ManiSkill and sapien.

Importing this package registers a Gymnasium environment per family, such as
`tabletop/MoveCube-v1`. Gymnasium itself imports the package for

    gymnasium.make("robomme_interference_data.simulators.tabletop:tabletop/MoveCube-v1")
"""

from robomme_interference_data.constants import FAMILIES, MAX_STEPS

SUITE_VERSION = 3
"""Version of the episodes: every change to scenes, shifts, motions, goals or judgments raises it.

Datasets and runs of different versions are incompatible; see `docs/reference/tabletop.md`.
"""


def register_environments() -> None:
    """Register the nine families with Gymnasium, if it is installed."""
    try:
        import gymnasium
    except ImportError:
        return
    for family in FAMILIES:
        name = f"tabletop/{family}-v1"
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="robomme_interference_data.simulators.tabletop.env:TabletopEnv",
                kwargs={"family": family},
                max_episode_steps=MAX_STEPS,
                disable_env_checker=True,  # ManiSkill's spaces are batched, which it rejects
            )


register_environments()
