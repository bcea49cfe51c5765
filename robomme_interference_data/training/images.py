"""Resize frames for training and, in the same way, for a policy in a rollout."""

from robomme_interference_data.storage.resize import resize

__all__ = ["resize"]
