"""What a world model is, its configuration, and the one loss that trains all of them."""

from dataclasses import dataclass
from math import inf
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float

from mabl.envs.base import ActionSpace, Discrete
from mabl.errors import require_between, require_positive
from mabl.losses.kl import balanced_kl, categorical_kl
from mabl.nets.categorical import CodeShape, still
from mabl.nets.mlp import Activation, Features
from mabl.rows import TimeStep
from mabl.types import Metrics, PRNGKey
from mabl.world_models.heads import Predictions
from mabl.world_models.levels import arriving

L = TypeVar("L")
M = TypeVar("M", bound=Any)


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
    activation: Activation = "relu"
    """Hidden layers of all networks: `relu` as in the paper (appendix B.1), or `rms_silu`: RMS
    normalisation and SiLU, as in DreamerV3."""
    standardise: bool = False
    """Standardise observations and states by their running mean and variance, for encoders and for
    the observations' loss."""
    obs_weight: float = 1.0
    """Weight of the observations' loss."""
    outcomes: Literal["row", "transition"] = "row"
    """What rewards and terminations are predicted from: the row's own latent (z_t, h_t) as in the
    paper, or (z_{t-1}, h_t), which the row's observation has not reached yet: all that imagination
    has (as in MAMBA's code)."""
    reward_input: Literal["agent", "both"] = "agent"
    """What imagination's reward predictor sees: (z_agent, h_agent) as in the paper, or both levels,
    where there are two; then the agent's own predictor is trained beside it."""
    reward_loss: Literal["huber", "mse"] = "huber"
    """Likelihood of the reward: smooth L1 with delta 1, or half the squared error."""
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
    batch_size: int = 40
    """Sequences in a model update."""
    batch_length: int = 20
    """Rows of a sequence, 2 at least."""

    @property
    def latent(self) -> CodeShape:
        """Of a latent state."""
        return CodeShape(self.n_categoricals, self.n_classes)

    def __post_init__(self) -> None:
        require_positive(self, "hidden", "n_hidden", "n_categoricals", "n_classes", "batch_size")
        require_positive(self, "learning_rate", "grad_clip")
        require_between(self, 2, inf, "batch_length")
        require_between(self, 0, inf, "kl_weight", "kl_prior_weight", "kl_posterior_weight")
        require_between(self, 0, inf, "free_nats", "obs_weight", "overshooting")
        require_between(self, 0, inf, "reward_weight", "agent_reward_weight", "end_weight")
        require_between(self, 0, inf, "absorbing")


class WorldModel(Protocol[L]):
    """A latent-variable model of a team; one example, the caller vmaps over the batch.

    `L` is the latent: a pytree of the whole team's.
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


def observe_sequence(
    model: WorldModel[L], rows: TimeStep, key: PRNGKey, train: bool = False
) -> tuple[L, dict[str, Float[Array, "T ..."]]]:
    """Posterior latents `[T, N, ...]` and logits of one sequence, from a zero latent."""
    inputs = jax.vmap(model.encode)(rows)
    keys = jax.random.split(key, rows.is_first.shape[0])

    def step(latent: L, at: tuple[Any, PRNGKey]) -> tuple[L, tuple[L, dict[str, Array]]]:
        latent, logits = model.observe(latent, *at, train=train)
        return latent, (latent, logits)

    _, (latents, logits) = jax.lax.scan(step, model.initial(), (inputs, keys))
    return latents, logits


def model_loss(
    model: WorldModel,
    rows: TimeStep,
    key: PRNGKey,
    config: WorldModelConfig,
    action_space: ActionSpace,
) -> tuple[Float[Array, ""], Metrics]:
    """L(psi) = L_ELBO + L_reward + L_termination + L_available + L_action (section 3.2).

    L_ELBO = -log p(o^i | h^a, z^a) + KL(q(z^a | .) || p(z^a | .)) + KL(q(z^g | .) || p(z^g | .)),
    the KLs balanced (`losses/kl.py`); the other terms are those of `decoder_losses`. `rows` are
    `[B, T, ...]`. Losses are sums over features and means over B, T and N.

    A sequence may begin in the middle of an episode, whose past the model cannot know: its first
    row's KL does not count. With `config.overshooting` the decoders also see the latent that the
    prior predicts for each row from the row before, which imagination decodes and the KL alone
    trains; rows whose row before is unknown or of another episode do not count there. With
    `config.absorbing` the model also learns that nothing follows an end (`absorbing_loss`).
    """
    rows = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), rows)  # as the scan over time leaves them
    observed = observe_batch(model, rows, key, train=True)
    follows = followers(rows.is_first)[..., None]
    predicted, std = predict_sequence(model, observed.latents, config), obs_std(model)
    losses = decoder_losses(predicted, rows, config, action_space, std)
    if config.outcomes == "transition":
        losses |= {name: follows * losses[name] for name in OUTCOMES if name in losses}
    if config.overshooting:
        ahead = jax.vmap(jax.vmap(model.predict))(observed.prior_latents)
        for name, loss in decoder_losses(ahead, rows, config, action_space, std).items():
            if config.outcomes == "row" or name not in OUTCOMES:
                losses[f"ahead_{name}"] = config.overshooting * follows * loss
    known = follows | rows.is_first[..., None]
    for name, loss in kl_losses(observed, config).items():
        losses[name] = loss * (known if loss.ndim > 2 else known[..., 0])
    if config.absorbing:
        key_absorbing = jax.random.fold_in(key, 1)
        losses["absorbing"] = absorbing_loss(
            model, observed.latents, rows, key_absorbing, config, action_space
        )
    means = {name: loss.mean() for name, loss in losses.items()}
    total = jnp.stack(list(means.values())).sum()
    metrics = {f"world_model/loss_{name}": value for name, value in means.items()}
    metrics["world_model/loss"] = total
    for level, posterior in observed.posterior.items():
        nats = categorical_kl(posterior, observed.prior[level]).sum(-1).mean()
        metrics[f"world_model/kl_{level}"] = nats
    return total, metrics


OUTCOMES = ("reward", "agent_reward", "terminated")
"""Losses of what a transition brings: `WorldModelConfig.outcomes`."""


def followers(is_first: Bool[Array, "T B"]) -> Bool[Array, "T B"]:
    """Mask of the rows of time-first sequences whose row before is known and of their episode."""
    inside = jnp.arange(is_first.shape[0])[:, None] > 0
    return inside & ~is_first


def predict_step(
    model: WorldModel[L], before: L, after: L, config: WorldModelConfig
) -> Predictions:
    """Predictions of a row from its latent and the latent of the row before; no batch axis."""
    predicted = model.predict(after)
    if config.outcomes == "row":
        return predicted
    came = model.predict(arriving(before, after))
    return predicted._replace(**{name: getattr(came, name) for name in OUTCOMES})


def predict_sequence(model: WorldModel[L], latents: L, config: WorldModelConfig) -> Predictions:
    """Predictions of the rows of time-first latents `[T, B, ...]`.

    With outcomes of the transition, those of rows that have no row before mean nothing.
    """
    before = jax.tree.map(lambda x: jnp.concatenate([x[:1], x[:-1]]), latents)
    return jax.vmap(jax.vmap(lambda a, b: predict_step(model, a, b, config)))(before, latents)


def absorbing_loss(
    model: WorldModel,
    latents: Any,
    rows: TimeStep,
    key: PRNGKey,
    config: WorldModelConfig,
    action_space: ActionSpace,
) -> Float[Array, "B N"]:
    """Losses of reward 0 and of termination on steps imagined past the end of an episode.

    The replay holds no row that follows an end: the next one is a reset. MAMBA stores absorbing
    rows instead. The first true end of each sequence `[T, B, ...]` is continued by
    `config.absorbing` random joint actions; losses are divided by T, so that a step past an end
    counts as much as a replayed row.
    """
    ended = rows.terminated.all(-1)
    length, batch = ended.shape
    first, there = ended.argmax(0), ended.any(0)
    start = jax.tree.map(lambda x: x[first, jnp.arange(batch)], latents)

    def past(latent: Any, key: PRNGKey) -> Float[Array, " N"]:
        def step(latent: Any, key: PRNGKey) -> tuple[Any, Float[Array, " N"]]:
            key_action, key_latent = jax.random.split(key)
            action = action_space.encode(random_action(action_space, rows, key_action))
            after = model.imagine(latent, action, key_latent)
            said = predict_step(model, latent, after, config)
            loss = config.reward_weight * reward_loss(
                said.reward, jnp.zeros_like(said.reward), config.reward_loss
            ) + config.end_weight * optax.sigmoid_binary_cross_entropy(
                said.terminated, jnp.ones_like(said.terminated)
            )
            return still(after), loss

        return jax.lax.scan(step, still(latent), jax.random.split(key, config.absorbing))[1].sum(0)

    losses = jax.vmap(past)(start, jax.random.split(key, batch))
    return there[:, None] * losses / length


def random_action(space: ActionSpace, rows: TimeStep, key: PRNGKey) -> Array:
    """A joint action at random, whether available or not."""
    shape = rows.prev_action.shape[2:]
    if isinstance(space, Discrete):
        return jax.random.randint(key, shape, 0, space.n)
    return jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)


SCALE_DECAY = 0.99
"""Share of the running mean and variance of inputs that remains after a model update."""


def with_scales(model: M, rows: TimeStep) -> M:
    """Copy of a model that standardises its inputs, after it has seen `rows` `[*b, ...]`.

    Observations of the dead do not count. A model without scales is returned as it is.
    """
    if getattr(model.filter, "scale", None) is None:
        return model
    scale = model.filter.scale.update(rows.obs, 1.0 * rows.alive, SCALE_DECAY)
    model = eqx.tree_at(lambda m: m.filter.scale, model, scale)
    if hasattr(model, "state_scale"):
        everywhere = jnp.ones(rows.is_first.shape)
        scale = model.state_scale.update(rows.state, everywhere, SCALE_DECAY)
        model = eqx.tree_at(lambda m: m.state_scale, model, scale)
    return model


def obs_std(model: WorldModel) -> Float[Array, " O"] | float:
    """Standard deviations by which errors of observations are divided; 1 without scales."""
    scale = getattr(model.filter, "scale", None)
    return 1.0 if scale is None else jax.lax.stop_gradient(scale.moments()[1])


class Observed(NamedTuple):
    """What a model makes of real sequences: `[T, B, ...]`."""

    latents: Any
    """Posterior latents."""
    prior_latents: Any
    """Prior latents of the same rows, from the rows before."""
    posterior: dict[str, Float[Array, "T B *n K C"]]
    prior: dict[str, Float[Array, "T B *n K C"]]


def observe_batch(model: WorldModel, rows: TimeStep, key: PRNGKey, train: bool = False) -> Observed:
    """Posteriors and priors of sequences, time first: `[T, B, ...]`."""
    length, batch = rows.is_first.shape
    key_observe, key_prior = jax.random.split(key)
    observe = jax.vmap(
        lambda rows, key: observe_sequence(model, rows, key, train), in_axes=(1, 0), out_axes=1
    )
    latents, posterior = observe(rows, jax.random.split(key_observe, batch))
    keys_prior = jax.random.split(key_prior, (length, batch))
    prior_latents, prior = jax.vmap(jax.vmap(model.prior))(latents, keys_prior)
    return Observed(latents, prior_latents, posterior, prior)


def kl_losses(observed: Observed, config: WorldModelConfig) -> dict[str, Float[Array, "T B *n"]]:
    """Balanced and weighted KL of each level."""
    return {
        f"kl_{level}": config.kl_weight
        * balanced_kl(
            posterior,
            observed.prior[level],
            config.kl_prior_weight,
            config.kl_posterior_weight,
            config.kl_reduction,
            config.free_nats,
        )
        for level, posterior in observed.posterior.items()
    }


def decoder_losses(
    predicted: Predictions,
    rows: TimeStep,
    config: WorldModelConfig,
    action_space: ActionSpace,
    obs_std: Float[Array, " O"] | float = 1.0,
) -> dict[str, Float[Array, "*b N"]]:
    """-log likelihoods of rows `[*b, ...]` under what is decoded from their latents, weighted.

    -log p(o^i | z^a, h^a), -log p(r^i | z^a, h^a), and -log p(. | z^a, z^g, h^a, h^g) of
    termination, availability and the action a^i_{t-1} (sections 3.1.2 and 3.2), and of life
    (ADR 9). Observations and actions of the dead do not count, nor the action before a first row.
    Errors of observations are in units of `obs_std`, by feature.
    """
    alive = rows.alive.astype(jnp.float32)
    acted = alive * ~rows.is_first[..., None]
    std = jnp.broadcast_to(obs_std, rows.obs.shape)
    losses = {
        "obs": config.obs_weight
        * (alive * optax.huber_loss(predicted.obs / std, rows.obs / std).sum(-1)),
        "reward": config.reward_weight
        * reward_loss(predicted.reward, rows.reward, config.reward_loss),
        "terminated": config.end_weight
        * optax.sigmoid_binary_cross_entropy(
            predicted.terminated, rows.terminated.astype(jnp.float32)
        ),
        "available": optax.sigmoid_binary_cross_entropy(
            predicted.available, rows.available.astype(jnp.float32)
        ).sum(-1),
        "alive": config.end_weight * optax.sigmoid_binary_cross_entropy(predicted.alive, alive),
        "action": acted * action_loss(predicted.action, rows.prev_action, action_space),
    }
    if predicted.agent_reward is not None:
        weight = config.agent_reward_weight * config.reward_weight
        losses["agent_reward"] = weight * reward_loss(
            predicted.agent_reward, rows.reward, config.reward_loss
        )
    return losses


def reward_loss(
    predicted: Float[Array, "*b"], reward: Float[Array, "*b"], kind: str
) -> Float[Array, "*b"]:
    """-log p(r | ...) up to a constant: Huber (smooth L1) or Gaussian with unit variance."""
    return {"huber": optax.huber_loss, "mse": optax.l2_loss}[kind](predicted, reward)


def action_loss(
    predicted: Float[Array, "*b A"], action: Array, space: ActionSpace
) -> Float[Array, "*b"]:
    """-log p(a_{t-1} | ...): cross-entropy, or Gaussian with unit variance up to a constant."""
    if isinstance(space, Discrete):
        return optax.softmax_cross_entropy_with_integer_labels(predicted, action)
    return optax.l2_loss(predicted, action).sum(-1)
