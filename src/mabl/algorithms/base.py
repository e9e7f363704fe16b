"""What an algorithm is to the training loop."""

from typing import Any, NamedTuple, Protocol

from mabl.algorithms.config import Config
from mabl.envs.base import EnvSpec
from mabl.execution import Policy
from mabl.replay import Replay
from mabl.rollout import Collector, Rollout
from mabl.types import Metrics, PRNGKey, Progress


class Experience(NamedTuple):
    """All that there is to learn from; every array has a leading axis of environments."""

    replay: Replay
    """Rows kept, the newest included."""
    before: Collector
    """Where each environment stood when the newest rows began."""
    newest: Rollout
    """The rows of this cycle, their rewards scaled like the replay's."""
    progress: Progress = 0.0
    """Share of the run's environment steps that are done: schedules depend on it."""


class Algorithm(Protocol):
    """Learns from experience, and says how to act. `learner` is all that learning changes."""

    @property
    def spec(self) -> EnvSpec:
        """The environment's."""
        ...

    @property
    def config(self) -> Config:
        """The run's, but for seed, length and folder, on which nothing compiled may depend."""
        ...

    @property
    def rows_needed(self) -> int:
        """Rows of a lane of the replay from which an update can learn."""
        ...

    @property
    def imagined_steps(self) -> int:
        """Joint steps that are imagined in a policy update, and learned from."""
        ...

    @property
    def policy_gradient_steps(self) -> int:
        """Gradient steps of a policy update."""
        ...

    @property
    def model_rows(self) -> int:
        """Replayed joint rows that a model update trains on; 0 without a model."""
        ...

    @property
    def memory_rows(self) -> int:
        """Rows from which memories of agents in mid-episode are computed anew after a cycle's
        updates; 0 where they are carried over."""
        ...

    def init(self, key: PRNGKey) -> Any:
        """A fresh learner."""
        ...

    def policy(self, learner: Any) -> Policy:
        """What of the learner is needed to act: all that is exported or deployed."""
        ...

    def update_model(
        self, learner: Any, experience: Experience, key: PRNGKey
    ) -> tuple[Any, Metrics]:
        """One model training step (Algorithm 1, lines 6-7)."""
        ...

    def update_policy(
        self, learner: Any, experience: Experience, key: PRNGKey
    ) -> tuple[Any, Metrics]:
        """One policy learning step (lines 10-13)."""
        ...

    def diagnose(self, learner: Any, replay: Replay, key: PRNGKey) -> Metrics:
        """How well the learner understands rows of the replay; may be nothing."""
        ...
