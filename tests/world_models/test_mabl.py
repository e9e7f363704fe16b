"""Which parameters and inputs of MABL reach what, as section 3.1's equations demand."""

from dataclasses import replace
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mabl.envs.base import Continuous, Discrete, EnvSpec
from mabl.losses.kl import balanced_kl
from mabl.nets.categorical import Code, CodeShape, still
from mabl.nets.mlp import MLP, dense
from mabl.rows import TimeStep
from mabl.world_models.base import WorldModelConfig
from mabl.world_models.bilevel import own_first
from mabl.world_models.heads import Heads, Predictions
from mabl.world_models.levels import Level
from mabl.world_models.loss import decoder_losses, model_loss, reward_loss
from mabl.world_models.mabl import MABL
from mabl.world_models.sequences import observe_batch, observe_sequence

SPEC = EnvSpec("stub", 3, 4, 5, Discrete(3), 10, "score")
CONFIG = WorldModelConfig(hidden=16, n_hidden=1, n_categoricals=3, n_classes=4)
GLOBAL = (
    "state_encoder",
    "global_recurrent",
    "global_posterior",
    "global_prior",
    "agent_prior",
)


def build(**options) -> MABL:
    return MABL(SPEC, replace(CONFIG, **options), jax.random.key(0))


def some_rows(length: int, first: tuple[int, ...] = (0,), seed: int = 0) -> TimeStep:
    """Random rows `[T, ...]` of three agents, resets at `first`."""
    rng = np.random.default_rng(seed)
    is_first = np.isin(np.arange(length), first)
    action = np.where(is_first[:, None], 0, rng.integers(0, 3, (length, 3)))
    return TimeStep(
        prev_action=jnp.asarray(action, jnp.int32),
        reward=jnp.asarray(rng.normal(size=(length, 3)), jnp.float32),
        terminated=jnp.zeros((length, 3), bool),
        truncated=jnp.zeros(length, bool),
        obs=jnp.asarray(rng.normal(size=(length, 3, 4)), jnp.float32),
        state=jnp.asarray(rng.normal(size=(length, 5)), jnp.float32),
        available=jnp.ones((length, 3, 3), bool),
        alive=jnp.ones((length, 3), bool),
        is_first=jnp.asarray(is_first),
        score=jnp.full(length, jnp.nan),
    )


def observed(model: MABL, rows: TimeStep, seed: int = 1):
    """Latents, posterior and prior logits, predictions of one sequence."""
    key_observe, key_prior = jax.random.split(jax.random.key(seed))
    latents, posterior = observe_sequence(model, rows, key_observe)
    _, prior = jax.vmap(model.prior)(latents, jax.random.split(key_prior, len(rows.is_first)))
    return latents, posterior, prior, jax.vmap(model.predict)(latents)


PARTS = (
    "kl_agent",
    "kl_global",
    "obs",
    "reward",
    "agent_reward",
    "terminated",
    "available",
    "alive",
    "action",
)


@eqx.filter_jit
def jacobian(model: MABL, rows: TimeStep) -> dict[str, dict[str, jax.Array]]:
    """Largest absolute gradient of each term of the loss in each part of the model."""
    parts = [p for p in PARTS if p != "agent_reward" or model.config.reward_input == "both"]

    def terms(model: MABL) -> jax.Array:
        _, posterior, prior, predicted = observed(model, rows)
        kl = [
            balanced_kl(posterior[level], prior[level], 0.8, 0.2).sum()
            for level in ("agent", "global")
        ]
        return jnp.stack(kl + [(getattr(predicted, part) ** 2).sum() for part in parts[2:]])

    gradient = eqx.filter_jacrev(terms)(model)
    return {
        part: {
            name: jnp.stack(
                [jnp.abs(x[i]).max() for x in jax.tree.leaves(getattr(gradient.nets, name))]
            ).max()
            for name in (*GLOBAL, "filter", "heads")
        }
        for i, part in enumerate(parts)
    }


@cache
def gradients(first: tuple[int, ...] = (0,), **options) -> dict[str, dict[str, float]]:
    """`jacobian` over three rows with resets at `first`."""
    return jax.device_get(jacobian(build(**options), some_rows(3, first)))


def test_agent_kl_alone_trains_the_global_prior_and_the_global_recurrent_model():
    norms = gradients()["kl_agent"]
    for name in ("global_prior", "global_recurrent", "agent_prior", "filter"):
        assert norms[name] > 0, name


@pytest.mark.parametrize(
    ("source", "reached", "spared"),
    [
        ("prior", "global_prior", "global_posterior"),
        ("posterior", "global_posterior", "global_prior"),
    ],
)
def test_agent_kl_reaches_the_global_level_through_the_sample_it_is_conditioned_on(
    source, reached, spared
):
    # Every row is a first one, so that nothing can come from an earlier row's global sample.
    norms = gradients((0, 1, 2), agent_prior_input=source)["kl_agent"]
    assert norms[reached] > 0
    assert norms[spared] == 0


def test_global_kl_reaches_the_filter_bottom_up_but_not_the_agent_prior():
    norms = gradients()["kl_global"]
    assert norms["global_posterior"] > 0
    assert norms["filter"] > 0
    assert norms["agent_prior"] == 0


def test_observation_loss_does_not_touch_the_global_level():
    norms = gradients()["obs"]
    assert norms["filter"] > 0
    for name in GLOBAL:
        assert norms[name] == 0, name


@pytest.mark.parametrize("part", ["terminated", "available", "alive", "action"])
def test_termination_availability_life_and_action_train_both_levels(part):
    norms = gradients()[part]
    for name in ("filter", "global_recurrent", "global_posterior", "state_encoder"):
        assert norms[name] > 0, name
    for name in ("global_prior", "agent_prior"):
        assert norms[name] == 0, name


@pytest.mark.parametrize(("reward_input", "reaches"), [("agent", False), ("both", True)])
def test_reward_trains_the_global_level_only_if_it_sees_it(reward_input, reaches):
    norms = gradients(reward_input=reward_input)["reward"]
    assert norms["filter"] > 0
    for name in ("state_encoder", "global_recurrent", "global_posterior"):
        assert bool(norms[name] > 0) is reaches, name


def test_the_agents_own_reward_predictor_trains_the_agent_level_alone():
    norms = gradients(reward_input="both")["agent_reward"]
    assert norms["filter"] > 0
    for name in GLOBAL:
        assert norms[name] == 0, name


def test_without_a_second_reward_predictor_there_is_no_reward_of_the_agents_own(model):
    assert observed(model, some_rows(1))[-1].agent_reward is None
    predicted = observed(build(reward_input="both"), some_rows(1))[-1]
    assert (predicted.agent_reward != predicted.reward).all()


@pytest.fixture(scope="module")
def model() -> MABL:
    return build()


@pytest.fixture(scope="module")
def posterior_of(model):
    """Latents and posterior logits of a sequence, with the same key each time."""
    return jax.jit(lambda rows: observed(model, rows)[:2])


@pytest.mark.parametrize("changed", ["state", "teammate's obs", "teammate's action"])
def test_agent_level_of_the_posterior_sees_neither_state_nor_teammates(posterior_of, changed):
    rows = some_rows(3)
    other = {
        "state": rows._replace(state=rows.state + 9),
        "teammate's obs": rows._replace(obs=rows.obs.at[:, 1].add(9)),
        "teammate's action": rows._replace(
            prev_action=rows.prev_action.at[1:, 1].set((rows.prev_action[1:, 1] + 1) % 3)
        ),
    }[changed]
    (before, logits), (after, other_logits) = posterior_of(rows), posterior_of(other)
    for agent in (0, 2):
        assert_array_equal(before.agent.h[:, agent], after.agent.h[:, agent])
        assert_array_equal(before.agent.z.index[:, agent], after.agent.z.index[:, agent])
        assert_array_equal(logits["agent"][:, agent], other_logits["agent"][:, agent])
    # Positive controls: agent 0's global level sees what its agent level does not; of a
    # teammate's observation only the teammate's own levels know.
    if changed == "teammate's obs":
        assert (logits["agent"][:, 1] != other_logits["agent"][:, 1]).any((1, 2)).all()
        assert (logits["global"][:, 1] != other_logits["global"][:, 1]).any()
    else:
        since = {"state": 0, "teammate's action": 1}[changed]
        moved = logits["global"][since:, 0] != other_logits["global"][since:, 0]
        assert moved.any((1, 2)).all()


def test_global_posterior_sees_the_state_the_agents_own_sample_and_h(model):
    rows = some_rows(1)
    _, logits, _, _ = observed(model, rows)
    _, changed, _, _ = observed(model, rows._replace(state=rows.state + 1))
    assert_array_equal(logits["agent"], changed["agent"])
    assert not np.allclose(logits["global"], changed["global"])
    # Changing what agent 1 sees moves its z^a, hence its own global posterior, not agent 0's.
    _, changed, _, _ = observed(model, rows._replace(obs=rows.obs.at[:, 1].add(9)))
    assert_array_equal(logits["global"][:, 0], changed["global"][:, 0])
    assert not np.allclose(logits["global"][:, 1], changed["global"][:, 1])


def mirrored(level: Level) -> Level:
    """The same with another state: the vector read backwards."""
    z = level.z
    return level._replace(z=Code(3 - z.index[:, ::-1], z.tilt, z.n_classes))


def test_agent_prior_depends_on_the_sample_of_the_global_prior(model):
    latent = jax.tree.map(lambda x: x[0], observed(model, some_rows(1))[0])
    one, other = (model.prior(latent, jax.random.key(seed))[1] for seed in (0, 1))
    assert_array_equal(one["global"], other["global"])
    assert not np.allclose(one["agent"], other["agent"])
    # The posterior sample is not an input of it ...
    moved = latent._replace(global_=mirrored(latent.global_))
    assert_array_equal(model.prior(moved, jax.random.key(0))[1]["agent"], one["agent"])


def test_agent_prior_input_posterior_takes_the_posterior_sample_instead():
    model = build(agent_prior_input="posterior")
    latent = jax.tree.map(lambda x: x[0], observed(model, some_rows(1))[0])
    one, other = (model.prior(latent, jax.random.key(seed))[1] for seed in (0, 1))
    assert_array_equal(one["agent"], other["agent"])
    moved = latent._replace(global_=mirrored(latent.global_))
    assert not np.allclose(model.prior(moved, jax.random.key(0))[1]["agent"], one["agent"])


@pytest.mark.parametrize("sees", ["sample", "level"])
def test_an_agent_prior_that_sees_the_level_knows_the_joint_action(sees):
    """h^g is a function of it, h^a of the agent's own action alone."""
    model = build(agent_prior_sees=sees)
    start = still(jax.tree.map(lambda x: x[0], observed(model, some_rows(1))[0]))
    one = jnp.eye(3)
    other = one.at[2].set(one[0])  # the third agent plays otherwise
    levels = [model.imagine(start, action, jax.random.key(0)) for action in (one, other)]
    assert_array_equal(levels[0].agent.h[0], levels[1].agent.h[0])
    z = levels[0].global_.z  # the same sample after both
    first, second = (
        jax.vmap(model.nets.agent_logits)(x.agent.h, x.global_._replace(z=z))[0] for x in levels
    )
    assert np.allclose(first, second) == (sees == "sample")


def test_own_first_orders_the_joint_action_and_names_the_agent():
    action = jnp.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    assert_array_equal(
        own_first(action),
        [
            [1, 2, 3, 4, 5, 6, 1, 0, 0],
            [3, 4, 1, 2, 5, 6, 0, 1, 0],
            [5, 6, 1, 2, 3, 4, 0, 0, 1],
        ],
    )


@pytest.mark.parametrize("identity", [False, True])
def test_global_levels_know_whose_they_are_with_agent_identity(identity):
    """Two agents with the same latent have the same global embedding, or each its own."""
    model = build(agent_identity=identity)
    latent = jax.tree.map(lambda x: x[0], observed(model, some_rows(1))[0])
    same = jax.tree.map(lambda x: jnp.broadcast_to(x[:1], x.shape), still(latent))
    for action in (jnp.eye(3), jnp.eye(3)[jnp.array([0, 0, 0])]):  # different, the same
        h = model.imagine(same, action, jax.random.key(0)).global_.h
        assert np.allclose(h[0], h[1]) != identity
    rows = some_rows(4)
    moved = rows._replace(prev_action=rows.prev_action.at[2, 1].add(1) % 3)
    before, after = (observed(model, x)[0] for x in (rows, moved))
    assert_array_equal(before.agent.h[:, 0], after.agent.h[:, 0])  # its filter does not see others
    assert not np.allclose(before.global_.h[2, 0], after.global_.h[2, 0])


@pytest.mark.parametrize("sees", ["sample", "level"])
def test_priors_do_not_see_the_row_they_predict(sees):
    model = build(agent_prior_sees=sees)
    # The row's own z is not an input of either prior: only h, which precedes it.
    latent = jax.tree.map(lambda x: x[0], observed(model, some_rows(1))[0])
    moved = latent._replace(agent=mirrored(latent.agent))
    before, after = (model.prior(x, jax.random.key(0))[1] for x in (latent, moved))
    assert_array_equal(before["agent"], after["agent"])
    assert_array_equal(before["global"], after["global"])


def test_imagination_advances_both_embeddings_as_observation_does(model):
    rows = some_rows(2)
    latents = observed(model, rows)[0]
    start = jax.tree.map(lambda x: x[0], latents)
    action = SPEC.action_space.encode(rows.prev_action[1])
    imagined = model.imagine(start, action, jax.random.key(5))
    assert_allclose(imagined.agent.h, latents.agent.h[1], rtol=1e-5, atol=1e-6)
    assert_allclose(imagined.global_.h, latents.global_.h[1], rtol=1e-5, atol=1e-6)
    for level in imagined:
        assert_array_equal(level.z.onehot().reshape(3, 3, 4).sum(-1), 1.0)
        assert level.z.tilt is None


def test_imagined_agent_state_follows_the_imagined_global_state():
    # Rig both priors to be certain: the global one of its first class, the agent one to copy.
    model = build()
    big = 50.0

    def constant(net, bias):
        last = lambda n: (n.mlp.layers[-1].weight, n.mlp.layers[-1].bias)  # noqa: E731
        return eqx.tree_at(last, net, (jnp.zeros_like(last(net)[0]), bias))

    def copier(net):  # hidden unit k repeats entry k of the sample of the global prior
        first, last = net.mlp.layers
        of_h, of_sample = first.weight
        assert of_sample.shape == (3, 4, 16)
        return eqx.tree_at(
            lambda n: (*n.mlp.layers[0].weight, n.mlp.layers[1].weight),
            net,
            (
                jnp.zeros_like(of_h),
                jnp.eye(12, 16).reshape(3, 4, 16),
                jnp.zeros_like(last.weight).at[jnp.arange(12), jnp.arange(12)].set(big),
            ),
        )

    for chosen in (0, 3):
        bias = big * jax.nn.one_hot(jnp.full(3, chosen), 4).ravel()
        rigged = eqx.tree_at(
            lambda m: (m.nets.global_prior, m.nets.agent_prior),
            model,
            (constant(model.nets.global_prior, bias), copier(model.nets.agent_prior)),
        )
        z = rigged.imagine(rigged.initial(), jnp.zeros((3, 3)), jax.random.key(0)).agent.z
        assert_array_equal(z.onehot().reshape(3, 3, 4).argmax(-1), np.full((3, 3), chosen))
        assert_array_equal(z.index, np.full((3, 3), chosen))


def test_a_first_row_resets_both_levels(model):
    rows = some_rows(5, first=(0, 3))
    rows = rows._replace(prev_action=rows.prev_action.at[3].set(2))  # must not matter
    inputs = jax.vmap(model.encode)(rows)
    keys = jax.random.split(jax.random.key(1), 5)
    observe = jax.jit(lambda latent, inputs, key: model.observe(latent, inputs, key))

    def run(latent, at):
        for t in at:
            latent, _ = observe(latent, jax.tree.map(lambda x, t=t: x[t], inputs), keys[t])
        return latent

    for end in (4, 5):
        going_on, fresh = run(model.initial(), range(end)), run(model.initial(), range(3, end))
        jax.tree.map(assert_array_equal, going_on, fresh)
    # Without the reset the past does matter.
    unreset = inputs._replace(is_first=inputs.is_first.at[3].set(False))
    latent = run(model.initial(), range(3))
    resumed, _ = observe(latent, jax.tree.map(lambda x: x[3], unreset), keys[3])
    assert not np.allclose(resumed.agent.h, run(model.initial(), range(4)).agent.h)


def test_features_are_the_agent_level_for_actors_and_both_levels_for_critics(model):
    latent = jax.tree.map(lambda x: x[0], observed(model, some_rows(1))[0])
    z_agent, z_global = latent.agent.z.onehot(), latent.global_.z.onehot()
    own = np.concatenate([z_agent, latent.agent.h], -1)
    assert_array_equal(dense(model.actor_features(latent)), own)
    both = (z_agent, z_global, latent.agent.h, latent.global_.h)
    assert_array_equal(dense(model.critic_features(latent)), np.concatenate(both, -1))
    assert_array_equal(dense(model.global_features(latent)), z_global)


def test_a_team_starts_from_zeros_at_both_levels_and_acts_by_its_filter(model):
    start = model.initial()
    for level in start:
        assert_array_equal(level.h, np.zeros((3, 16)))
        assert_array_equal(level.z.onehot(), np.zeros((3, 12)))
        assert_array_equal(level.z.tilt, np.zeros((3, 3, 4)))  # to train
    assert model.filter is model.nets.filter


def test_nothing_is_dropped_in_training(model):
    rows, key = some_rows(3), jax.random.key(1)
    both = (observe_sequence(model, rows, key, train) for train in (False, True))
    jax.tree.map(assert_array_equal, *both)


# --- The decoders' first layers ----------------------------------------------------------------


AGENT, FULL = ("obs", "agent_reward"), ("terminated", "available", "action", "full_reward")
OWN, BOTH = (CodeShape(3, 4), 5), (CodeShape(3, 4), CodeShape(3, 4), 5, 5)


def some_heads(n_hidden: int, both_levels_reward: bool) -> Heads:
    return Heads(OWN, BOTH, 6, 3, 8, n_hidden, both_levels_reward, jax.random.key(0))


def seen() -> tuple:
    """What decoders see of some latents: of the agent's own level, and of both."""
    one, other = Code(jnp.array([1, 0, 3]), None, 4), Code(jnp.array([2, 2, 0]), None, 4)
    h, g = jnp.linspace(-1, 1, 5), jnp.linspace(2, 0, 5)
    return (one, h), (one, other, h, g)


@pytest.mark.parametrize("both_levels_reward", [False, True])
@pytest.mark.parametrize("n_hidden", [1, 2])
def test_decoders_with_merged_first_layers_are_networks_of_their_own(n_hidden, both_levels_reward):
    agent, full = seen()
    keys = jax.random.split(jax.random.key(0), 6)
    expected = {
        name: MLP(width, n, 8, n_hidden, key)(x)
        for name, width, n, key, x in (
            ("obs", 17, 6, keys[0], dense(agent)),
            ("agent_reward", 17, 1, keys[1], dense(agent)),
            ("terminated", 34, 1, keys[2], dense(full)),
            ("available", 34, 4, keys[3], dense(full)),
            ("action", 34, 3, keys[4], dense(full)),
            ("full_reward", 34, 1, keys[5], dense(full)),
        )
    }
    predicted = some_heads(n_hidden, both_levels_reward)(agent, full)
    close = {"rtol": 1e-5, "atol": 1e-6}
    for name in ("obs", "action"):
        assert_allclose(getattr(predicted, name), expected[name], **close, err_msg=name)
    assert_allclose(predicted.terminated, expected["terminated"][0], **close)
    assert_allclose(predicted.available, expected["available"][:3], **close)
    assert_allclose(predicted.alive, expected["available"][3], **close)
    if both_levels_reward:
        assert_allclose(predicted.reward, expected["full_reward"][0], **close)
        assert_allclose(predicted.agent_reward, expected["agent_reward"][0], **close)
    else:
        assert_allclose(predicted.reward, expected["agent_reward"][0], **close)
        assert predicted.agent_reward is None


@pytest.mark.parametrize(
    ("output", "decoder"),
    [
        ("obs", "obs"),
        ("agent_reward", "agent_reward"),
        ("terminated", "terminated"),
        ("available", "available"),
        ("alive", "available"),
        ("action", "action"),
        ("reward", "full_reward"),
    ],
)
def test_a_prediction_trains_its_decoder_alone(output, decoder):
    agent, full = seen()
    gradient = eqx.filter_grad(lambda heads: (getattr(heads(agent, full), output) ** 2).sum())(
        some_heads(1, True)
    )

    def trained(tree) -> bool:
        return max(float(jnp.abs(x).max()) for x in jax.tree.leaves(tree)) > 0

    for merged, names in ((gradient.agent_in, AGENT), (gradient.full_in, FULL)):
        for i, name in enumerate(names):
            first = jax.tree.map(lambda x, i=i: x[..., 8 * i : 8 * (i + 1)], merged)
            assert trained(first) == trained(getattr(gradient, name)) == (name == decoder), name


# --- model_loss -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def losses_of(model):
    """The terms of the loss at batched rows."""

    @jax.jit
    def terms(rows: TimeStep):
        return model_loss(model, rows, jax.random.key(0), CONFIG, SPEC.action_space)

    return terms


def batched(rows: TimeStep) -> TimeStep:
    return jax.tree.map(lambda x: x[None], rows)


def test_the_loss_is_the_sum_of_its_terms(losses_of):
    total, metrics = losses_of(batched(some_rows(4)))
    decoded = ("obs", "reward", "terminated", "available", "alive", "action")
    names = (*decoded, "kl_agent", "kl_global")
    terms = [float(metrics[f"world_model/loss_{name}"]) for name in names]
    assert {n for n in metrics if n.startswith("world_model/loss_")} == {
        f"world_model/loss_{name}" for name in names
    }
    assert min(terms) > 0
    assert_allclose(total, sum(terms), rtol=1e-6)
    assert_allclose(metrics["world_model/loss"], total)


def test_the_action_of_a_first_row_does_not_matter(losses_of):
    rows = some_rows(4, first=(0, 2))
    other = rows._replace(prev_action=rows.prev_action.at[jnp.array([0, 2])].set(2))
    jax.tree.map(assert_array_equal, losses_of(batched(rows)), losses_of(batched(other)))


class Rigged(eqx.Module):
    """A model that decodes its latent: 0 from posteriors, 1 from priors.

    It has one level, of two categoricals with known logits, and a second reward predictor if told.
    """

    n_agents: int = eqx.field(static=True)
    agent_reward: bool = eqx.field(static=True, default=False)
    filter: None = None

    def initial(self):
        return jnp.zeros(self.n_agents)

    def encode(self, row):
        return row.is_first

    def observe(self, latent, inputs, key, train=False):
        return latent, {"level": self.logits([0.5, 0.5], [0.9, 0.1])}

    def prior(self, latent, key):
        return jnp.ones(self.n_agents), {"level": self.logits([0.25, 0.75], [0.5, 0.5])}

    def logits(self, *probs):
        logits = jnp.log(jnp.array(probs))
        return jnp.broadcast_to(logits, (self.n_agents, *logits.shape))

    def predict(self, latent):
        return Predictions(
            obs=jnp.tile(latent[:, None], 4),
            reward=latent,
            agent_reward=latent + 1.0 if self.agent_reward else None,
            terminated=latent,
            available=jnp.tile(latent[:, None], 3),
            alive=latent,
            action=jnp.tile(latent[:, None], 3),
        )


def rigged_loss(rows: TimeStep, space=SPEC.action_space, **options) -> dict[str, float]:
    config = replace(CONFIG, **options)
    model = Rigged(3, config.reward_input == "both")
    _, metrics = model_loss(model, rows, jax.random.key(0), config, space)
    return {k.removeprefix("world_model/loss_"): float(v) for k, v in metrics.items()}


def test_each_term_by_hand():
    # Two rows, the first a reset; three agents.
    rows = some_rows(2)._replace(
        obs=jnp.array([[[1.0, 0, 0, 0]] * 3, [[3.0, 1.0, 0, 0]] * 3]),
        reward=jnp.array([[0.0, 0.0, 0.0], [2.0, 0.5, 2.0]]),
    )
    terms = rigged_loss(batched(rows))
    # Huber of 1, 3: 0.5, 2.5; summed over features 0.5 and 2.5 + 0.5, mean over two rows
    assert_allclose(terms["obs"], 1.75, rtol=1e-5)
    # Huber of 2, 0.5, 2: 1.5, 0.125, 1.5, and three zeros
    assert_allclose(terms["reward"], 3.125 / 6, rtol=1e-5)
    assert_allclose(terms["terminated"], np.log(2), rtol=1e-5)
    assert_allclose(terms["available"], 3 * np.log(2), rtol=1e-5)  # summed over three actions
    assert_allclose(terms["alive"], np.log(2), rtol=1e-5)
    assert_allclose(terms["action"], np.log(3) / 2, rtol=1e-5)  # not at the first row
    # Means over two categoricals of 0.143841 and 0.368064
    assert_allclose(terms["kl_level"], 0.255952, rtol=1e-5)


def test_options_of_the_losses_by_hand():
    rows = some_rows(2)._replace(reward=jnp.array([[0.0, 0.0, 0.0], [2.0, 0.5, 2.0]]))
    terms = rigged_loss(
        batched(rows), reward_loss="mse", kl_reduction="sum", kl_weight=0.1, free_nats=0.6
    )
    assert_allclose(terms["reward"], (2 + 0.125 + 2) / 6, rtol=1e-5)
    assert_allclose(terms["kl_level"], 0.06, rtol=1e-5)  # 0.511905 is raised to 0.6, times 0.1


def test_the_agents_own_reward_predictor_is_trained_beside_one_that_sees_both_levels():
    rows = batched(some_rows(2)._replace(reward=jnp.array([[0.0, 0.0, 0.0], [2.0, 0.5, 2.0]])))
    assert "agent_reward" not in rigged_loss(rows, reward_input="agent")
    terms = rigged_loss(rows, reward_input="both")
    # It predicts 1: Huber of errors 1, 1, 1, 1, 0.5, 1
    assert_allclose(terms["agent_reward"], (5 * 0.5 + 0.125) / 6, rtol=1e-5)
    assert_allclose(terms["reward"], 3.125 / 6, rtol=1e-5)


def test_overshooting_trains_the_decoders_on_what_the_prior_predicts():
    rows = some_rows(2)._replace(
        obs=jnp.array([[[1.0, 0, 0, 0]] * 3, [[3.0, 1.0, 0, 0]] * 3]),
        reward=jnp.array([[0.0, 0.0, 0.0], [2.0, 0.5, 2.0]]),
        terminated=jnp.array([[False] * 3, [True, True, False]]),
    )
    without = rigged_loss(batched(rows))
    terms = rigged_loss(batched(rows), overshooting=0.5, obs_weight=2.0)
    # The first row is a reset: it follows nothing, so that only the second of two rows counts.
    # Everything predicted is 1. Huber of 2, 0, 1, 1: 2.5, times 0.5 * 2
    assert_allclose(terms["ahead_obs"], 2.5 / 2, rtol=1e-5)
    # Huber of 1, 0.5, 1
    assert_allclose(terms["ahead_reward"], 0.5 * (2 * 0.5 + 0.125) / 6, rtol=1e-5)
    # Two of three terminated: log(1 + e) without, log(1 + 1/e) with
    assert_allclose(
        terms["ahead_terminated"],
        0.5 * (np.log1p(np.e) + 2 * np.log1p(1 / np.e)) / 6,
        rtol=1e-5,
    )
    assert_allclose(terms["obs"], 2 * without["obs"], rtol=1e-5)
    # All alive: log(1 + 1/e)
    assert_allclose(terms["ahead_alive"], 0.5 * np.log1p(1 / np.e) / 2, rtol=1e-5)
    for name in ("reward", "terminated", "available", "alive", "action", "kl_level"):
        assert terms[name] == without[name], name
    assert not any(name.startswith("ahead") for name in without)


def test_overshooting_trains_both_priors_and_what_they_rest_on():
    def ahead(model: MABL, rows: TimeStep) -> jax.Array:
        config = replace(model.config, overshooting=1.0, kl_weight=0.0)
        _, metrics = model_loss(model, batched(rows), jax.random.key(0), config, SPEC.action_space)
        names = [name for name in metrics if "loss_ahead" in name]
        return jnp.stack([metrics[name] for name in names]).sum()

    gradient = eqx.filter_jit(eqx.filter_grad(ahead))(build(), some_rows(3))
    for name in (*GLOBAL, "filter", "agent_prior", "heads"):
        leaves = jax.tree.leaves(getattr(gradient.nets, name))
        assert max(jnp.abs(x).max() for x in leaves) > 0, name


def test_dead_agents_neither_teach_observations_nor_actions():
    rows = some_rows(2)._replace(alive=jnp.array([[True, True, False], [True, False, False]]))
    other = rows._replace(
        obs=rows.obs.at[0, 2].set(77).at[1, 1:].set(77),
        prev_action=rows.prev_action.at[1, 1:].set(2),
    )
    before, after = rigged_loss(batched(rows)), rigged_loss(batched(other))
    assert before == after
    assert_allclose(before["action"], np.log(3) / 6, rtol=1e-5)  # one of six entries counts


def test_the_dead_do_teach_that_they_are_dead():
    rows = some_rows(2)._replace(alive=jnp.array([[True, True, False], [True, False, False]]))
    terms = rigged_loss(batched(rows), overshooting=1.0)
    # At logit 0 it makes no difference; at logit 1 it is log(1 + 1/e) for the one that lives on the
    # second row and log(1 + e) for the two that do not, and the first row does not count.
    assert_allclose(terms["alive"], np.log(2), rtol=1e-5)
    assert_allclose(terms["ahead_alive"], (0.313262 + 2 * 1.313262) / 6, rtol=1e-5)


def test_losses_of_the_decoders_are_told_by_row_and_agent():
    rows = batched(some_rows(2))._replace(
        obs=jnp.full((1, 2, 3, 4), 2.0),
        reward=jnp.array([[[0.0, 1.0, 3.0], [1.0, 1.0, 1.0]]]),
        terminated=jnp.array([[[True, False, False], [False, False, True]]]),
        available=jnp.ones((1, 2, 3, 3), bool).at[0, 0, 1, 2].set(False),
        alive=jnp.array([[[True, True, False], [True, False, True]]]),
    )
    predicted = jax.vmap(jax.vmap(Rigged(3, True).predict))(jnp.ones((1, 2, 3)))
    config = replace(CONFIG, obs_weight=0.5, reward_weight=10.0, agent_reward_weight=0.1)
    losses = decoder_losses(predicted, rows, config, SPEC.action_space)
    # Everything predicted is 1, and 2 by the agent's own reward predictor. Logits of 1 cost
    no, yes = np.log1p(np.e), np.log1p(1 / np.e)
    expected = {
        "obs": [[1, 1, 0], [1, 0, 1]],  # Huber of 1 four times, times 0.5; not of the dead
        "reward": [[5, 0, 15], [0, 0, 0]],  # Huber of 1, 0, 2, times 10
        "agent_reward": [[1.5, 0.5, 0.5], [0.5, 0.5, 0.5]],  # Huber of 2, 1, 1 and 1, 1, 1
        "terminated": [[yes, no, no], [no, no, yes]],
        "available": [[3 * yes, 2 * yes + no, 3 * yes], [3 * yes] * 3],
        "alive": [[yes, yes, no], [yes, no, yes]],
        "action": [[0, 0, 0], [np.log(3), 0, np.log(3)]],  # not at a first row, not of the dead
    }
    assert set(losses) == set(expected)
    for name, values in expected.items():
        assert_allclose(losses[name], [values], rtol=1e-5, err_msg=name)


class Studious(Rigged):
    """Its latent is 1 where it is observed to train."""

    def observe(self, latent, inputs, key, train=False):
        logits = super().observe(latent, inputs, key)[1]
        return jnp.full_like(latent, train), logits


def test_the_loss_alone_observes_to_train():
    model, rows, key = Studious(3), some_rows(2), jax.random.key(0)
    time_first = jax.tree.map(lambda x: x[:, None], rows)
    for train in (False, True):
        assert (observe_sequence(model, rows, key, train)[0] == train).all()
        assert (observe_batch(model, time_first, key, train).latents == train).all()
    assert not observe_sequence(model, rows, key)[0].any()
    assert not observe_batch(model, time_first, key).latents.any()
    # All alive: log(1 + 1/e) at logit 1.
    _, metrics = model_loss(model, batched(rows), key, CONFIG, SPEC.action_space)
    assert_allclose(metrics["world_model/loss_alive"], np.log1p(1 / np.e), rtol=1e-5)


class Counting(Rigged):
    """Its latent is how many rows there were."""

    def observe(self, latent, inputs, key, train=False):
        logits = super().observe(latent, inputs, key)[1]
        return latent + 1.0, logits


def test_batches_are_observed_time_first():
    rows = jax.tree.map(lambda x: jnp.stack([x] * 4, axis=1), some_rows(2))
    seen = observe_batch(Counting(3), rows, jax.random.key(0))
    assert_array_equal(seen.latents, [[[1] * 3] * 4, [[2] * 3] * 4])
    assert_array_equal(seen.prior_latents, np.ones((2, 4, 3)))
    assert seen.posterior["level"].shape == seen.prior["level"].shape == (2, 4, 3, 2, 2)


def test_a_batch_is_observed_as_its_sequences_are(model):
    # Every row is a first one, so that the agent level's logits do not depend on what is drawn.
    sequences = [some_rows(3, first=(0, 1, 2), seed=seed) for seed in (0, 1)]
    rows = jax.tree.map(lambda *x: jnp.stack(x, axis=1), *sequences)
    logits = jax.jit(observe_batch)(model, rows, jax.random.key(0)).posterior["agent"]
    for i, sequence in enumerate(sequences):
        alone = jax.jit(observe_sequence)(model, sequence, jax.random.key(1))[1]["agent"]
        assert_allclose(logits[:, i], alone, rtol=1e-5, atol=1e-6)


def test_the_loss_takes_sequences_batch_first():
    rows = jax.tree.map(lambda x: jnp.stack([x] * 4), some_rows(2))
    _, metrics = model_loss(Counting(3), rows, jax.random.key(0), CONFIG, SPEC.action_space)
    # All alive: log(1 + 1/e) at logit 1 in the first rows, log(1 + 1/e^2) at logit 2 in the second.
    expected = (np.log1p(np.exp(-1)) + np.log1p(np.exp(-2))) / 2
    assert_allclose(metrics["world_model/loss_alive"], expected, rtol=1e-5)


def test_continuous_actions_are_regressed():
    rows = some_rows(2)._replace(prev_action=jnp.full((2, 3, 3), 0.5))
    terms = rigged_loss(batched(rows), Continuous(3))
    assert_allclose(terms["action"], 3 * 0.125 / 2, rtol=1e-5)  # half of 0.5^2, three dimensions


def test_huber_is_quadratic_within_one_and_linear_beyond():
    reward, zeros = jnp.array([0.5, -1.0, 3.0]), jnp.zeros(3)
    assert_allclose(reward_loss(zeros, None, reward, "huber"), [0.125, 0.5, 2.5])
    assert_allclose(reward_loss(zeros, None, reward, "mse"), [0.125, 0.5, 4.5])
