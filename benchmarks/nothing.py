"""A rollout that does nothing, in a module of its own: workers import it."""

from robomme_interference_data.evaluate.run.config import RunConfig
from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.evaluate.run.row import Rollout
from robomme_interference_data.evaluate.run.worker import RunContext
from robomme_interference_data.runtime.executor import Worker
from robomme_interference_data.schema.rollouts import Status


class Nothing:
    """Ends a rollout at once."""

    def __init__(self, run: RunContext[RunConfig]):
        self._run = run

    def __call__(self, task: WorkItem, worker: Worker) -> Rollout:
        """Return its row."""
        return self._run.row(
            task,
            Status.FAIL,
            seed=0,
            difficulty="easy",
            goal="",
            steps=0,
            history_frames=0,
            lesson_frames=0,
            lesson_share=None,
        )
