"""PPO of a team on joint rows, imagined or real: returns, and the policy's loss."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from mabl.behaviour.actor import Choice
from mabl.losses.ppo import clipped_surrogate
from mabl.losses.returns import returns_across_resets
from mabl.rows import TimeStep
from mabl.types import Metrics, TeamView


class PPORows(NamedTuple):
    """Joint rows of experience, `[M, N, ...]`, as PPO's epochs see them."""

    view: TeamView
    action: Array
    log_prob: Array
    advantage: Array
    target: Array
    weight: Array
    """Weight of a row in the policy's loss."""
    value_weight: Array
    """Weight of a row in the critic's loss."""


def shared_reward(reward: Float[Array, "*b N"], team_reward: bool) -> Float[Array, "*b N"]:
    """The team's mean reward for every agent, or to each its own."""
    if not team_reward:
        return reward
    return jnp.broadcast_to(reward.mean(-1, keepdims=True), reward.shape)


def real_returns(
    value: Float[Array, "T N"],
    rows: TimeStep,
    gamma: float,
    gae_lambda: float,
    team_reward: bool,
) -> tuple[Float[Array, "T-1 N"], Float[Array, "T-1 N"]]:
    """Lambda-returns of one real sequence's rows but the last, and how much they count.

    From an episode's last row to the next reset nothing passes: that step weighs nothing and hands
    back the last row's value, so that truncated episodes bootstrap.
    """
    ends = jnp.broadcast_to(rows.is_first[1:, None], value[1:].shape)
    target = returns_across_resets(
        value,
        shared_reward(rows.reward[1:], team_reward),
        rows.terminated[1:],
        ends,
        gamma,
        gae_lambda,
    )
    return target, 1.0 - ends


def weighted_mean(values: Float[Array, "*b"], weight: Float[Array, "*b"]) -> Float[Array, ""]:
    """Mean of what counts; 0 where nothing does."""
    return (weight * values).sum() / (weight.sum() + 1e-8)


def policy_loss(
    policy: Choice, rows: PPORows, ent_coef: Float[Array, ""], clip: float
) -> tuple[Float[Array, ""], Metrics]:
    """PPO's clipped surrogate minus the entropy bonus.

    Rows of the dead, and rows without a choice, do not count.
    """
    weight = rows.weight * rows.view.alive * policy.free(rows.view.available)
    # Rows of weight 0 may have no valid action: keep their old log-probability, lest the ratio
    # overflow.
    log_prob = jnp.where(weight > 0, policy.log_prob(rows.action), rows.log_prob)
    surrogate = clipped_surrogate(log_prob, rows.log_prob, rows.advantage, clip)
    entropy = weighted_mean(policy.entropy(), weight)
    loss = weighted_mean(surrogate, weight) - ent_coef * entropy
    ratio = jnp.exp(log_prob - rows.log_prob)
    share = policy.entropy() / jnp.maximum(policy.most_entropy(rows.view.available), 1e-6)
    return loss, {
        "behaviour/actor_loss": loss,
        "behaviour/entropy": entropy,
        "behaviour/entropy_share": weighted_mean(share, weight),
        "behaviour/clip_fraction": weighted_mean(1.0 * (jnp.abs(ratio - 1) > clip), weight),
        "behaviour/approx_kl": weighted_mean(rows.log_prob - log_prob, weight),
    }


def kl_of_choices(policy: Choice, rows: PPORows) -> Float[Array, ""]:
    """Estimate of KL(old || new) from actions of the old policy: E_old[r - 1 - log r].

    Rows of the dead, and rows without a choice, do not count [J. Schulman, "Approximating KL
    divergence", 2020].
    """
    weight = rows.weight * rows.view.alive * policy.free(rows.view.available)
    log_ratio = jnp.where(weight > 0, policy.log_prob(rows.action) - rows.log_prob, 0.0)
    return weighted_mean(jnp.expm1(log_ratio) - log_ratio, weight)
