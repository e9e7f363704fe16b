"""The yardstick: MAPPO on real data, without a world model and without memory.

    uv run python -m benchmarks.ppo --env smax/3m --total-steps 100000 --seeds 0 1 2 --out ppo.json

Actors see their own observation, the critic the state and all observations through self-attention;
losses and optimisers are mabl's own. Prints one JSON object with, for each seed, the training win
rate and return of every batch of steps.
"""

import argparse
import json
from typing import NamedTuple

import jax
import jax.numpy as jnp

from mabl.behaviour import mappo
from mabl.behaviour.actor import Actor
from mabl.behaviour.mappo import MAPPO, MAPPOConfig
from mabl.cli import use_compilation_cache
from mabl.envs import registry
from mabl.rollout import rollout, start
from mabl.types import TimeStep, Trajectory, is_last


class ObsExecutor(NamedTuple):
    """Acts on the present observation alone."""

    actor: Actor

    def initial(self, row):
        return None

    def act(self, memory, row, key):
        policy = jax.vmap(self.actor)(row.obs, row.available)
        return None, policy.sample(key).astype(jnp.int32)


def critic_features(row: TimeStep):
    state = jnp.broadcast_to(row.state, (row.obs.shape[0], row.state.shape[0]))
    return jnp.concatenate([row.obs, state], axis=-1)


def to_trajectory(learner: MAPPO, rows: TimeStep) -> Trajectory:
    """Real rows `[T, E, ...]` as one long trajectory that episodes' ends cut.

    The transition from an episode's last row to the next reset is no transition: it weighs nothing,
    and hands back the value of the last row, so that truncated episodes bootstrap.
    """
    features = jax.vmap(jax.vmap(critic_features))(rows)
    value = jax.vmap(jax.vmap(learner.critic))(features)
    policy = jax.vmap(jax.vmap(jax.vmap(learner.actor)))(rows.obs, rows.available)
    action = rows.prev_action[1:]
    ends = is_last(rows)[:-1, :, None]
    return Trajectory(
        actor_features=rows.obs,
        critic_features=features,
        available=rows.available,
        action=action,
        log_prob=policy.log_prob(jnp.concatenate([action, action[-1:]]))[:-1],
        reward=jnp.where(ends, value[:-1], rows.reward[1:]),
        continues=1.0 - (rows.terminated[1:] | ends),
        weight=jnp.broadcast_to(1.0 - ends, action.shape),
    )


def train(env, config: MAPPOConfig, num_envs: int, n_rows: int, total_steps: int, key):
    """Learning curves of one seed: steps, episodes, wins and summed returns of each batch."""
    spec = env.spec
    key_init, key_envs, key_run = jax.random.split(key, 3)
    n_critic = spec.obs_dim + spec.state_dim
    learner = mappo.init(config, spec.obs_dim, n_critic, spec.action_space.size, key_init)
    collectors = jax.vmap(lambda k: start(env, ObsExecutor(learner.actor), k))(
        jax.random.split(key_envs, num_envs)
    )

    def update(carry, key):
        learner, collectors, newest = carry
        key_collect, key_update = jax.random.split(key)
        collectors, played = jax.vmap(
            lambda c, k: rollout(env, ObsExecutor(learner.actor), c, k, n_rows)
        )(collectors, jax.random.split(key_collect, num_envs))
        rows = jax.tree.map(lambda x: jnp.moveaxis(x, 0, 1), played.rows)
        rows = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), newest, rows)
        scaled = rows._replace(reward=10 * rows.reward)
        learner, _ = mappo.update(learner, to_trajectory(learner, scaled), key_update, config)
        newest = jax.tree.map(lambda x: x[-1], rows)
        episodes = played.episodes
        sums = (
            (~played.rows.is_first).sum(),
            episodes.ended.sum(),
            episodes.score.sum(),
            episodes.episode_return.sum(),
        )
        return (learner, collectors, newest), sums

    n_updates = -(-total_steps // (num_envs * n_rows))
    carry = (learner, collectors, collectors.row)
    return jax.lax.scan(update, carry, jax.random.split(key_run, n_updates))[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="smax/3m")
    parser.add_argument("--total-steps", type=int, default=100_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--num-envs", type=int, default=16)
    parser.add_argument("--n-rows", type=int, default=64)
    parser.add_argument("--learning-rate", type=float, default=1e-3)
    parser.add_argument("--n-epochs", type=int, default=10)
    parser.add_argument("--ent-coef", type=float, default=0.01)
    parser.add_argument("--out")
    args = parser.parse_args()
    use_compilation_cache()
    env = registry.make(args.env)
    config = MAPPOConfig(
        hidden=128,
        actor_out_scale=0.01,
        actor_learning_rate=args.learning_rate,
        critic_learning_rate=args.learning_rate,
        n_epochs=args.n_epochs,
        batch_size=args.num_envs * args.n_rows // 2,
        ent_coef=args.ent_coef,
    )
    keys = jnp.stack([jax.random.key(seed) for seed in args.seeds])
    run = jax.jit(lambda key: train(env, config, args.num_envs, args.n_rows, args.total_steps, key))
    curves = {}
    for seed, key in zip(args.seeds, keys, strict=True):
        steps, episodes, wins, returns = map(lambda x: x.tolist(), jax.device_get(run(key)))
        curves[f"seed_{seed}"] = {
            "steps": steps,
            "episodes": episodes,
            "wins": wins,
            "returns": returns,
        }
        early = sum(steps)
        print(
            f"seed {seed}: {early} steps, last tenth won "
            f"{sum(wins[-len(wins) // 10 :]) / max(sum(episodes[-len(wins) // 10 :]), 1):.2f}"
        )
    if args.out:
        with open(args.out, "w") as file:
            json.dump({"settings": vars(args), "curves": curves}, file)


if __name__ == "__main__":
    main()
