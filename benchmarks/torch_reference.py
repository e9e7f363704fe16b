"""MABL's learning in plain eager PyTorch, written the obvious way: what `benchmarks.against_torch`
measures ours against.

Latents are one-hot floats, drawn with `torch.multinomial`, time is a Python loop, everything is
float32. Agents share parameters, so that they are rows of the batch. The world model's loss is ours
to the letter, and `against_torch` checks that before it measures: with the weights and the samples
of ours the loss and its gradients agree. PPO is the same work, less the masks of the dead.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F


def mlp(n_in: int, n_out: int, hidden: int, n_hidden: int) -> nn.Sequential:
    """ReLU layers, then a linear one."""
    widths = [n_in] + [hidden] * n_hidden
    layers: list[nn.Module] = []
    for i, o in pairwise(widths):
        layers += [nn.Linear(i, o), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(widths[-1], n_out))


@dataclass
class Sizes:
    """Of an environment, a model and what learns in it."""

    n_agents: int
    obs: int
    state: int
    actions: int
    hidden: int
    n_categoricals: int
    n_classes: int
    n_hidden: int
    n_heads: int

    @property
    def latent(self) -> int:
        return self.n_categoricals * self.n_classes


class Recurrent(nn.Module):
    """h_t = f(h_{t-1}, z_{t-1}, a_{t-1})."""

    def __init__(self, n_in: int, hidden: int):
        super().__init__()
        self.inputs, self.cell = nn.Linear(n_in, hidden), nn.GRUCell(hidden, hidden)

    def forward(self, h: Tensor, z: Tensor, action: Tensor) -> Tensor:
        return self.cell(F.relu(self.inputs(torch.cat([z, action], -1))), h)


class WorldModel(nn.Module):
    """The bi-level model (section 3.1)."""

    def __init__(self, sizes: Sizes):
        super().__init__()
        self.sizes = sizes
        d, k, a = sizes.hidden, sizes.latent, sizes.actions
        agent, full = d + k, 2 * (d + k)
        self.encoder, self.state_encoder = mlp(sizes.obs, d, d, 2), mlp(sizes.state, d, d, 2)
        self.recurrent = Recurrent(k + a, d)
        self.global_recurrent = Recurrent(k + sizes.n_agents * a, d)
        self.posterior, self.global_posterior = mlp(2 * d, k, d, 1), mlp(2 * d + k, k, d, 1)
        self.global_prior, self.agent_prior = mlp(d, k, d, 1), mlp(d + k, k, d, 1)
        n = sizes.n_hidden
        self.obs, self.reward = mlp(agent, sizes.obs, d, n), mlp(agent, 1, d, n)
        self.terminated = mlp(full, 1, d, n)
        self.available = mlp(full, a + 1, d, n)
        self.action = mlp(full, a, d, n)

    def categoricals(self, logits: Tensor) -> Tensor:
        return logits.unflatten(-1, (self.sizes.n_categoricals, self.sizes.n_classes))

    def draw(self, logits: Tensor, index: Tensor | None = None) -> Tensor:
        """A straight-through sample `[*b, KC]` of logits; `index` `[*b, K]` forces it."""
        probs = self.categoricals(logits).softmax(-1)
        if index is None:
            flat = probs.detach().flatten(0, -2)
            index = torch.multinomial(flat, 1).reshape(probs.shape[:-1])
        onehot = F.one_hot(index, self.sizes.n_classes).to(probs.dtype)
        return (onehot + probs - probs.detach()).flatten(-2)

    def observe(
        self,
        rows: dict[str, Tensor],
        forced: dict[str, Tensor] | None = None,
        priors: bool = True,
    ) -> Any:
        """Posterior latents `[B, T, N, ...]` of all rows, and the logits of posteriors and priors.

        `forced` holds indices `[B, T, N, K]` of samples: `agent`, `global`, `global_prior`.
        """
        batch, length, n = rows["obs"].shape[:3]
        s = self.sizes
        obs = F.relu(self.encoder(rows["obs"]))
        state = F.relu(self.state_encoder(rows["state"]))
        h_a = h_g = obs.new_zeros(batch, n, s.hidden)
        z_a = z_g = obs.new_zeros(batch, n, s.latent)
        out: dict[str, list[Tensor]] = {}
        for t in range(length):
            going = (~rows["is_first"][:, t]).to(obs.dtype)[:, None, None]
            h_a, h_g, z_a, z_g = (x * going for x in (h_a, h_g, z_a, z_g))
            action = rows["prev_action"][:, t] * going
            joint = action.flatten(1)[:, None].expand(-1, n, -1)
            h_a, h_g = (
                f(h.flatten(0, 1), z.flatten(0, 1), a.flatten(0, 1)).unflatten(0, (batch, n))
                for f, h, z, a in (
                    (self.recurrent, h_a, z_a, action),
                    (self.global_recurrent, h_g, z_g, joint),
                )
            )

            def sample(name: str, logits: Tensor, t: int = t) -> Tensor:
                return self.draw(logits, None if forced is None else forced[name][:, t])

            q_a = self.posterior(torch.cat([h_a, obs[:, t]], -1))
            z_a = sample("agent", q_a)
            seen = state[:, t, None].expand(-1, n, -1)
            q_g = self.global_posterior(torch.cat([seen, z_a, h_g], -1))
            z_g = sample("global", q_g)
            found = dict(h_a=h_a, h_g=h_g, z_a=z_a, z_g=z_g, q_a=q_a, q_g=q_g)
            if priors:
                p_g = self.global_prior(h_g)
                p_a = self.agent_prior(torch.cat([h_a, sample("global_prior", p_g)], -1))
                found |= dict(p_a=p_a, p_g=p_g)
            for name, value in found.items():
                out.setdefault(name, []).append(value)
        return {name: torch.stack(values, 1) for name, values in out.items()}

    def loss(self, rows: dict[str, Tensor], forced: dict[str, Tensor] | None = None) -> Tensor:
        """L(psi) of sequences (section 3.2), with the paper's weights."""
        seen = self.observe(rows, forced)
        agent = torch.cat([seen["z_a"], seen["h_a"]], -1)
        full = torch.cat([seen["z_a"], seen["z_g"], seen["h_a"], seen["h_g"]], -1)
        alive = rows["alive"]
        available = self.available(full)
        bce = F.binary_cross_entropy_with_logits
        losses = [
            (alive * F.smooth_l1_loss(self.obs(agent), rows["obs"], reduction="none").sum(-1)),
            F.smooth_l1_loss(self.reward(agent)[..., 0], rows["reward"], reduction="none"),
            bce(self.terminated(full)[..., 0], rows["terminated"], reduction="none"),
            bce(available[..., :-1], rows["available"], reduction="none").sum(-1),
            bce(available[..., -1], alive, reduction="none"),
            alive
            * ~rows["is_first"][..., None]
            * -(rows["prev_action"] * self.action(full).log_softmax(-1)).sum(-1),
            self.kl(seen["q_a"], seen["p_a"]),
            self.kl(seen["q_g"], seen["p_g"]),
        ]
        return torch.stack([each.mean() for each in losses]).sum()

    def kl(self, posterior: Tensor, prior: Tensor) -> Tensor:
        """Balanced KL, mean over categoricals (section 3.2)."""
        q, p = (self.categoricals(x).log_softmax(-1) for x in (posterior, prior))

        def divergence(q: Tensor, p: Tensor) -> Tensor:
            return (q.exp() * (q - p)).sum(-1).mean(-1)

        return 0.8 * divergence(q.detach(), p) + 0.2 * divergence(q, p.detach())

    def imagine(self, latent: dict[str, Tensor], action: Tensor) -> dict[str, Tensor]:
        """Prior latents `[B, N, ...]` after a joint action `[B, N, A]`."""
        batch, n = action.shape[:2]
        joint = action.flatten(1)[:, None].expand(-1, n, -1)
        h_a, h_g = (
            f(*(x.flatten(0, 1) for x in (latent[h], latent[z], a))).unflatten(0, (batch, n))
            for f, h, z, a in (
                (self.recurrent, "h_a", "z_a", action),
                (self.global_recurrent, "h_g", "z_g", joint),
            )
        )
        z_g = self.draw(self.global_prior(h_g))
        z_a = self.draw(self.agent_prior(torch.cat([h_a, z_g], -1)))
        return {"h_a": h_a, "h_g": h_g, "z_a": z_a, "z_g": z_g}


class Critic(nn.Module):
    """V with self-attention over agents."""

    def __init__(self, sizes: Sizes):
        super().__init__()
        d = sizes.hidden
        self.embed = nn.Linear(2 * (d + sizes.latent), d)
        self.attention = nn.MultiheadAttention(d, sizes.n_heads, batch_first=True)
        self.mlp = mlp(d, 1, d, sizes.n_hidden)

    def forward(self, features: Tensor) -> Tensor:
        """`[B, N, G]` to `[B, N]`."""
        x = F.relu(self.embed(features))
        x = x + self.attention(x, x, x, need_weights=False)[0]
        return self.mlp(x)[..., 0]


class Learner:
    """A model, an actor, a critic and their optimisers, with the paper's settings for SMAC."""

    def __init__(self, sizes: Sizes, horizon: int = 15):
        self.sizes, self.horizon = sizes, horizon
        d = sizes.hidden
        self.model, self.critic = WorldModel(sizes), Critic(sizes)
        self.actor = mlp(d + sizes.latent, sizes.actions, d, sizes.n_hidden)
        self.model_opt = torch.optim.Adam(self.model.parameters(), lr=3e-4)
        self.actor_opt = torch.optim.Adam(self.actor.parameters(), lr=1e-4, weight_decay=1e-5)
        self.critic_opt = torch.optim.Adam(self.critic.parameters(), lr=1e-3)

    def update_model(self, rows: dict[str, Tensor]) -> None:
        """One step on the world model."""
        self._step(self.model_opt, self.model, self.model.loss(rows))

    def update_policy(self, rows: dict[str, Tensor], epochs: int = 5, size: int = 2000) -> None:
        """Imagine from every row, then PPO."""
        with torch.no_grad():
            batch = self._imagined(rows)
        n_rows = len(batch["reward"])
        for _ in range(epochs):
            order = torch.randperm(n_rows)
            for i in range(0, n_rows // size * size, size):
                self._ppo({name: x[order[i : i + size]] for name, x in batch.items()})

    def act(self, latent: dict[str, Tensor], available: Tensor) -> torch.distributions.Categorical:
        """The policy at latents."""
        logits = self.actor(torch.cat([latent["z_a"], latent["h_a"]], -1))
        masked = logits.masked_fill(~available, -1e9)
        return torch.distributions.Categorical(logits=masked, validate_args=False)

    def _imagined(self, rows: dict[str, Tensor]) -> dict[str, Tensor]:
        """PPO's rows `[M, N, ...]` with advantages and lambda-returns."""
        seen = self.model.observe(rows, priors=False)
        latent = {name: seen[name].flatten(0, 1) for name in ("h_a", "h_g", "z_a", "z_g")}
        available = rows["available"].flatten(0, 1) > 0.5
        steps: list[dict[str, Tensor]] = []
        for _ in range(self.horizon - 1):
            policy = self.act(latent, available)
            action = policy.sample()
            now = {
                "actor": torch.cat([latent["z_a"], latent["h_a"]], -1),
                "critic": self._full(latent),
                "available": available,
                "action": action,
                "log_prob": policy.log_prob(action),
            }
            latent = self.model.imagine(latent, F.one_hot(action, self.sizes.actions).float())
            full, agent = self._full(latent), torch.cat([latent["z_a"], latent["h_a"]], -1)
            reward = self.model.reward(agent)[..., 0]
            now["reward"] = reward.mean(-1, keepdim=True).expand_as(reward)
            now["continues"] = 1 - self.model.terminated(full)[..., 0].sigmoid()
            offered = self.model.available(full)[..., :-1].sigmoid()
            available = torch.rand_like(offered) < offered
            available |= ~available.any(-1, keepdim=True)
            steps.append(now)
        value = [self.critic(step["critic"]) for step in steps] + [self.critic(self._full(latent))]
        target, weight = value[-1], torch.ones_like(value[0])
        for t in reversed(range(len(steps))):
            step = steps[t]
            ahead = 0.05 * value[t + 1] + 0.95 * target
            target = step["target"] = step["reward"] + 0.99 * step["continues"] * ahead
            step["advantage"] = target - value[t]
        for step in steps:
            step["weight"] = weight
            weight = weight * step["continues"]
        batch = {name: torch.cat([step[name] for step in steps]) for name in steps[0]}
        advantage, weight = batch["advantage"], batch["weight"]
        mean = (weight * advantage).sum() / weight.sum()
        std = ((weight * (advantage - mean) ** 2).sum() / weight.sum()).sqrt()
        batch["advantage"] = (advantage - mean) / (std + 1e-5)
        return batch

    def _ppo(self, batch: dict[str, Tensor]) -> None:
        logits = self.actor(batch["actor"]).masked_fill(~batch["available"], -1e9)
        policy = torch.distributions.Categorical(logits=logits, validate_args=False)
        ratio = (policy.log_prob(batch["action"]) - batch["log_prob"]).exp()
        gain = torch.minimum(ratio * batch["advantage"], ratio.clamp(0.8, 1.2) * batch["advantage"])
        weight = batch["weight"] / batch["weight"].sum()
        self._step(self.actor_opt, self.actor, -(weight * (gain + 0.001 * policy.entropy())).sum())
        error = self.critic(batch["critic"]) - batch["target"]
        self._step(self.critic_opt, self.critic, 0.5 * (weight * error**2).sum())

    @staticmethod
    def _full(latent: dict[str, Tensor]) -> Tensor:
        return torch.cat([latent["z_a"], latent["z_g"], latent["h_a"], latent["h_g"]], -1)

    @staticmethod
    def _step(optimiser: torch.optim.Optimizer, module: nn.Module, loss: Tensor) -> None:
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(module.parameters(), 100.0)
        optimiser.step()
