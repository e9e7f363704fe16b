"""Interface and configuration of world models."""

from dataclasses import dataclass
from math import inf
from typing import Any, ClassVar, Literal, Protocol, TypeVar

from jaxtyping import Array, Bool, Float

from mabl.errors import UserError, require_between, require_positive
from mabl.losses.two_hot import N_BINS
from mabl.nets.categorical import CodeShape
from mabl.nets.mlp import Activation, Features
from mabl.rows import TimeStep
from mabl.types import PRNGKey
from mabl.world_models.heads import Predictions

L = TypeVar("L")


@dataclass(frozen=True)
class WorldModelConfig:
    """Sizes and losses of the world model. Defaults are the paper's for SMAC (Table 2)."""

    FLAG_PREFIX: ClassVar[str] = "world-model."

    hidden: int = 256
    """Width of hidden layers and of the deterministic embeddings h."""
    n_hidden: int = 2
    """Hidden layers of each decoder and head."""
    n_categoricals: int = 32
    """Categorical variables of a latent state, at each level."""
    n_classes: int = 32
    """Classes of each categorical."""
    agent_prior_input: Literal["prior", "posterior"] = "prior"
    """Global sample behind the agent prior in training (sec. 3.2: prior, app. A: posterior);
    models of one level have none."""
    agent_prior_sees: Literal["sample", "level"] = "sample"
    """Input of the agent prior beside h_agent, where there are two levels: z_global as in the
    paper, or the whole level (z_global, h_global), which knows the joint action (ADR 23)."""
    agent_identity: bool = False
    """Tell priors whose latent they predict, where there are two levels (ADR 25): MABL's global
    levels see the agent's own action first in the joint action, and its one-hot index; MABL-SG's
    agent priors see the index. Off in the paper. Execution never sees it."""
    activation: Activation = "relu"
    """Hidden layers of all networks: `relu` as in the paper (appendix B.1), or `rms_silu`: RMS
    normalisation and SiLU, as in DreamerV3."""
    standardise: bool = False
    """Standardise observations and states by their running mean and variance: for encoders, for
    policies and recurrent models that see them, and for the losses of what decodes them."""
    policy_input: Literal["latent", "decoded", "observation"] = "latent"
    """Input of policies: the latent (z, h) as in the paper; the latent and the observation decoded
    from it; or the observation alone, which is the real one at real rows and decoded at imagined
    ones, so that policies have no memory. MAPPO's critics see the latents, the observation if
    policies do, and the state where global levels hold it."""
    recurrent_sees: Literal["latent", "row"] = "latent"
    """Input of recurrent models beside the action: z of the row before as in the paper, or also
    what the level encodes of that row: the observation, or the state. Imagined rows have decoded
    ones (ADR 26)."""
    decoded_share: float = 0.0
    """Probability, at each real row in training, that recurrent models see the decoded row in place
    of the real one, as in imagination; needs `recurrent_sees=row`. All losses of later rows then
    also train the decoders."""
    obs_weight: float = 1.0
    """Weight of the observations' loss."""
    state_weight: float = 1.0
    """Weight of the loss of the state that global levels decode, where recurrent models see it."""
    outcomes: Literal["row", "transition"] = "row"
    """Input of the predictors of reward and termination: the row's own latent (z_t, h_t) as in the
    paper, or (z_{t-1}, h_t), which does not know the row's observation and is what imagination has,
    as in MAMBA's code."""
    reward_input: Literal["agent", "both"] = "agent"
    """Input of imagination's reward predictor: (z_agent, h_agent) as in the paper, or both levels,
    where there are two; then the agent's own predictor is trained beside it."""
    reward_loss: Literal["huber", "mse", "two_hot"] = "huber"
    """Likelihood of the reward: smooth L1 with delta 1, half the squared error, or a categorical
    over bins as in DreamerV3 (ADR 27). The bins cover -147 to 147, in rewards multiplied by
    `training.reward_scale`."""
    reward_weight: float = 1.0
    """Weight of the reward's loss: what pays is a small part of what is seen."""
    end_weight: float = 1.0
    """Weight of the losses of termination and of life."""
    absorbing: int = 0
    """Steps imagined past true ends, where reward 0 and termination are taught; 0 in the paper."""
    agent_reward_weight: float = 1.0
    """Weight of the agent's own reward predictor, relative, where `reward_input` is both levels."""
    kl_reduction: Literal["mean", "sum"] = "mean"
    """How the KL of a level is reduced over its categoricals."""
    kl_weight: float = 1.0
    """Weight of both KL terms in the loss."""
    kl_prior_weight: float = 0.8
    """KL balancing, cross-entropy weight: trains the prior towards the posterior."""
    kl_posterior_weight: float = 0.2
    """KL balancing, entropy weight: keeps the posterior near the prior."""
    free_nats: float = 0.0
    """Reduced KL of a level below which it is not trained."""
    overshooting: float = 0.0
    """Weight of the decoders' losses on prior latents, one step ahead (ADR 7); 0 in the paper."""
    learning_rate: float = 3e-4
    """Adam's learning rate (Table 4)."""
    grad_clip: float = 100.0
    """Largest global norm of the gradient."""
    averaging: float = 0.0
    """Decay, by model update, of a moving average of the parameters with which agents act and
    imagine; 0 takes the newest parameters, as in the paper."""
    batch_size: int = 40
    """Sequences in a model update."""
    recency: float = 1.0
    """Weight of the newest replayed sequence relative to the average one, in model updates; 1 draws
    all alike, as in the paper."""
    batch_length: int = 20
    """Rows of a sequence, 2 at least."""

    @property
    def latent(self) -> CodeShape:
        """Of a latent state."""
        return CodeShape(self.n_categoricals, self.n_classes)

    @property
    def reward_bins(self) -> int:
        """Outputs of a predictor of rewards: one number, or the logits of bins."""
        return N_BINS if self.reward_loss == "two_hot" else 1

    @property
    def filter_decodes(self) -> bool:
        """Whether the decoder of observations is the filter's; otherwise it is one of the heads."""
        return self.policy_input != "latent" or self.recurrent_sees == "row"

    @property
    def levels_hold_rows(self) -> bool:
        """Whether latents hold what their level encodes of the row."""
        return self.policy_input == "observation" or self.recurrent_sees == "row"

    def __post_init__(self) -> None:
        require_positive(self, "hidden", "n_hidden", "n_categoricals", "n_classes", "batch_size")
        require_positive(self, "learning_rate", "grad_clip")
        require_between(self, 2, inf, "batch_length")
        require_between(self, 1, inf, "recency")
        require_between(self, 0, 0.9999, "averaging")
        require_between(self, 0, 1, "decoded_share")
        require_between(self, 0, inf, "kl_weight", "kl_prior_weight", "kl_posterior_weight")
        require_between(self, 0, inf, "free_nats", "obs_weight", "state_weight", "overshooting")
        require_between(self, 0, inf, "reward_weight", "agent_reward_weight", "end_weight")
        require_between(self, 0, inf, "absorbing")
        if self.decoded_share and self.recurrent_sees != "row":
            raise UserError(
                f"--world-model.decoded-share is {self.decoded_share}, and recurrent models see no "
                "rows: give 0, or --world-model.recurrent-sees row"
            )


class WorldModel(Protocol[L]):
    """A latent-variable model of a team; one example, the caller vmaps over the batch.

    `L` is the latent: a pytree of the whole team's. A model whose latent holds who lives, like
    MAMBA's, also has `with_life(latent, alive)`, by which imagination tells it who was drawn alive.
    """

    filter: Any
    """What execution needs of the model: a `LocalFilter` or a `JointFilter` (`execution.py`)."""

    def initial(self) -> L:
        """Latent before an episode's first row."""
        ...

    def encode(self, row: TimeStep) -> Any:
        """What of a row does not depend on the past."""
        ...

    def observe(
        self, latent: L, inputs: Any, key: PRNGKey, train: bool = False
    ) -> tuple[L, dict[str, Array]]:
        """Posterior latent of the next row and its logits by level; dropout only to `train`."""
        ...

    def prior(self, latent: L, key: PRNGKey) -> tuple[L, dict[str, Array]]:
        """Prior latent of a row and its logits by level, from the row's deterministic part."""
        ...

    def imagine(self, latent: L, action: Float[Array, "N A"], key: PRNGKey) -> L:
        """Prior latent of the next row after an encoded joint action."""
        ...

    def predict(self, latent: L) -> Predictions:
        """What the model says of a row."""
        ...

    def actor_features(self, latent: L) -> Features:
        """What policies see; `[N, ...]`."""
        ...

    def critic_features(self, latent: L) -> Features:
        """What critics see; `[N, ...]`."""
        ...


def with_life(model: WorldModel[L], latent: L, alive: Bool[Array, " N"]) -> L:
    """Set who lives in a latent that holds it, such as MAMBA's; return any other unchanged."""
    tell = getattr(model, "with_life", None)
    return latent if tell is None else tell(latent, alive)
