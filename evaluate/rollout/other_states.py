"""Check that a policy takes the states of units of another robot, before the first rollout."""

from collections.abc import Sequence

from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.state_reader import other_state_sizes, query_state_size
from robomme_interference_data.errors import named
from robomme_interference_data.evaluate.policies.policy import Policy
from robomme_interference_data.evaluate.policies.registry import policy_options
from robomme_interference_data.evaluate.run.config import RunConfig
from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.schema.other_states import OtherStates, check_sizes


def check_other_states(
    config: RunConfig, buffer_set: BufferSet, policy: Policy, items: Sequence[WorkItem]
) -> None:
    """Check the states of the units in all planned buffers.

    Raises:
        InvalidOptionError: Some have another number of values than the query's, and the policy does
            not take them.
    """
    others = other_state_sizes(buffer_set.datasets)
    if not others:
        return
    planned = set(items)
    used = {
        session.dataset
        for manifest in buffer_set.manifests()
        if WorkItem(manifest.condition, manifest.episode_id) in planned
        for session in manifest.sessions
    }
    sizes = {f"the dataset {name}": size for name, size in others.items() if name in used}
    is_option = "other_states" in policy_options(config.policy, config.policy_options)

    def written(rule: OtherStates) -> str:
        if is_option:
            return named("policy_options", f"other_states={rule}")
        return f'other_states = "{rule}" as an attribute of the policy'

    check_sizes(
        f"the policy {config.policy}",
        query_state_size(buffer_set.datasets),
        sizes,
        policy.other_states,
        written,
    )
