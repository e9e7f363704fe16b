"""Which parameters and inputs of MABL-SG, Dreamer-v2, MAMBA and MAG reach what; MAG's lookahead."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from numpy.testing import assert_allclose, assert_array_equal
from tests.tiny import tiny

from mabl.algorithms.base import Experience
from mabl.algorithms.config import LookaheadConfig
from mabl.algorithms.mag import best_candidate, predict_error
from mabl.behaviour.actor import MaskedCategorical
from mabl.envs.base import Discrete, EnvSpec
from mabl.errors import UserError
from mabl.imagination import Dream, ImaginationConfig, Imagined
from mabl.losses.kl import categorical_kl
from mabl.nets.categorical import still
from mabl.nets.mlp import MLP, dense
from mabl.replay import sample_sequences
from mabl.rows import TimeStep
from mabl.training.programs import build as build_training
from mabl.world_models.base import WorldModelConfig
from mabl.world_models.dreamer_v2 import DreamerV2
from mabl.world_models.heads import Predictions
from mabl.world_models.levels import Level, forget
from mabl.world_models.loss import decoder_losses, kl_losses
from mabl.world_models.mabl_sg import MABLSG
from mabl.world_models.mamba import MAMBA, CommunicationConfig, Team
from mabl.world_models.sequences import observe_batch, observe_sequence

SPEC = EnvSpec("stub", 3, 4, 5, Discrete(3), 10, "score")
CONFIG = WorldModelConfig(hidden=8, n_hidden=1, n_categoricals=3, n_classes=4)
COMMUNICATION = CommunicationConfig(n_layers=2, n_heads=2, dropout=0.5)
SEED = np.int32(5)
NAMES = ("dreamer-v2", "mabl-sg", "mamba", "mag")
TALKING = ("mamba", "mag")


@cache
def build(name: str, **options) -> Any:
    config = replace(CONFIG, **options)
    make = {
        "dreamer-v2": lambda key: DreamerV2(SPEC, config, key),
        "mabl-sg": lambda key: MABLSG(SPEC, config, key),
        "mamba": lambda key: MAMBA(SPEC, config, key, COMMUNICATION),
        "mag": lambda key: MAMBA(SPEC, config, key, COMMUNICATION, shared=False),
    }[name]
    return eqx.filter_jit(make)(jax.random.key(0))


def some_rows(length: int, first: tuple[int, ...] = (0,), seed: int = 0) -> TimeStep:
    """Random rows `[T, ...]` of three agents, resets at `first`."""
    rng = np.random.default_rng(seed)
    is_first = np.isin(np.arange(length), first)
    action = np.where(is_first[:, None], 0, rng.integers(0, 3, (length, 3)))
    return TimeStep(
        prev_action=action.astype(np.int32),
        reward=rng.normal(size=(length, 3)).astype(np.float32),
        terminated=np.zeros((length, 3), bool),
        truncated=np.zeros(length, bool),
        obs=rng.normal(size=(length, 3, 4)).astype(np.float32),
        state=rng.normal(size=(length, 5)).astype(np.float32),
        available=np.ones((length, 3, 3), bool),
        alive=np.ones((length, 3), bool),
        is_first=is_first,
        score=np.full(length, np.nan, np.float32),
    )


def put(rows: TimeStep, field: str, index: Any, value: Any) -> TimeStep:
    """The rows with another value there; a function is applied to what was there."""
    array = getattr(rows, field).copy()
    array[index] = value(array[index]) if callable(value) else value
    return rows._replace(**{field: array})


class Seen(NamedTuple):
    """What a model makes of a sequence `[T, ...]`."""

    latents: Any
    prior_latents: Any
    posterior: dict[str, Array]
    prior: dict[str, Array]
    predicted: Predictions


def on_host(function: Callable) -> Callable:
    """Compiled, with NumPy arrays as its result: to look at them compiles nothing."""
    compiled = eqx.filter_jit(function)
    return lambda *args: jax.device_get(compiled(*args))


@on_host
def observed(model: Any, rows: TimeStep) -> Seen:
    """With the same key each time. Always of four rows, so that little is compiled."""
    key_observe, key_prior = jax.random.split(jax.random.key(1))
    latents, posterior = observe_sequence(model, rows, key_observe)
    keys = jax.random.split(key_prior, len(rows.is_first))
    prior_latents, prior = jax.vmap(model.prior)(latents, keys)
    return Seen(latents, prior_latents, posterior, prior, jax.vmap(model.predict)(latents))


@on_host
def imagined(model: Any, latent: Any, action: Array, seed: Array = SEED) -> Any:
    return model.imagine(latent, SPEC.action_space.encode(action), jax.random.key(seed))


def vector(features: Callable, latent: Any) -> np.ndarray:
    """What is shown of a latent, as one array."""
    return on_host(lambda latent: dense(features(latent)))(latent)


def levels(latent: Any) -> list[Level]:
    """All levels of a latent, whatever it is made of."""
    parts = jax.tree.leaves(latent, is_leaf=lambda x: isinstance(x, Level))
    return [part for part in parts if isinstance(part, Level)]


def at(tree: Any, index: Any) -> Any:
    return jax.tree.map(lambda x: x[index], tree)


def flipped(level: Level, agents: Any = ...) -> Level:
    """Another sample, of some agents: the vector of zeros and ones backwards."""
    index = np.array(level.z.index)
    index[agents] = level.z.n_classes - 1 - index[agents][..., ::-1]
    return eqx.tree_at(lambda level: level.z.index, level, index)


def assert_same(a: Any, b: Any) -> None:
    """Bitwise equality of all leaves."""
    jax.tree.map(assert_array_equal, a, b)


def differ(a: Any, b: Any) -> bool:
    return not np.allclose(a, b, rtol=1e-4, atol=1e-6)


def sharp(model: Any, factor: float) -> Any:
    """The model with posteriors whose logits are `factor` times as large."""
    posteriors = {
        DreamerV2: lambda m: [m.filter.posterior],
        MABLSG: lambda m: [m.filter.posterior, m.nets.global_posterior],
        MAMBA: lambda m: [m.filter.team.nets.posterior],
    }[type(model)]
    return eqx.tree_at(
        lambda m: [posterior.mlp.layers[-1].weight for posterior in posteriors(m)],
        model,
        replace_fn=lambda x: factor * x,
    )


@pytest.fixture(params=NAMES)
def model(request):
    return build(request.param)


# --- what holds for all -----------------------------------------------------------------------


def test_a_first_row_resets_everything(model):
    rows = some_rows(5, first=(0, 3))
    rows = put(rows, "prev_action", 3, 2)  # must not matter
    rows = put(rows, "alive", (2, 1), False)  # nor who was dead before
    inputs = on_host(lambda rows: jax.vmap(model.encode)(rows))(rows)
    keys = list(jax.random.split(jax.random.key(1), 5))
    initial = jax.device_get(model.initial())
    observe = on_host(lambda *args: model.observe(*args))

    def run(at_rows):
        latent = initial
        for t in at_rows:
            latent, _ = observe(latent, at(inputs, t), keys[t])
        return latent

    for end in (4, 5):
        assert_same(run(range(end)), run(range(3, end)))
    # Without the reset the past does matter.
    unreset = put(inputs, "is_first", 3, False)
    resumed, _ = observe(run(range(3)), at(unreset, 3), keys[3])
    for one, other in zip(levels(resumed), levels(run(range(4))), strict=True):
        assert differ(one.h, other.h)


def test_imagination_advances_all_embeddings_as_observation_does(model):
    rows = some_rows(4)
    rows = put(rows, "alive", (1, 2), False)
    latents = observed(model, rows).latents
    after = imagined(model, at(latents, 1), rows.prev_action[2])
    for one, other in zip(levels(after), levels(at(latents, 2)), strict=True):
        assert_allclose(one.h, other.h, rtol=1e-5, atol=1e-6)
    # Another action leads elsewhere.
    other = imagined(model, at(latents, 1), (rows.prev_action[2] + 1) % 3)
    for one, moved in zip(levels(after), levels(other), strict=True):
        assert differ(one.h, moved.h)


def test_priors_do_not_see_the_row_they_predict(model):
    # Neither its samples nor who lives in it are inputs of a prior: only h, which precedes it.
    latent = at(observed(model, some_rows(4)).latents, 1)
    is_level = lambda x: isinstance(x, Level)  # noqa: E731
    changes = {
        "z": jax.tree.map(lambda x: flipped(x) if is_level(x) else ~x, latent, is_leaf=is_level),
        "h": jax.tree.map(
            lambda x: x._replace(h=x.h + 0.5) if is_level(x) else x, latent, is_leaf=is_level
        ),
    }
    prior = on_host(lambda latent: model.prior(latent, jax.random.key(0))[1])
    before = prior(latent)
    assert_same(before, prior(changes["z"]))
    moved = prior(changes["h"])
    for level, logits in before.items():
        assert differ(logits, moved[level])


def test_all_samples_are_one_hot_vectors_and_keep_their_embedding(model):
    rows = some_rows(4)
    seen = observed(model, rows)
    after = imagined(model, at(seen.latents, 3), rows.prev_action[1])
    for latent in (seen.latents, seen.prior_latents, after):
        for level in levels(latent):
            z = np.asarray(level.z.onehot()).reshape(-1, 3, 4)
            assert_array_equal(np.sort(z, axis=-1), np.broadcast_to([0, 0, 0, 1], z.shape))
    for before, prior in zip(levels(seen.latents), levels(seen.prior_latents), strict=True):
        assert_array_equal(before.h, prior.h)
        assert (before.z.index != prior.z.index).any()


def test_posterior_samples_follow_their_logits(model):
    # With certain logits the sample is their mode.
    seen = observed(sharp(model, 1e4), some_rows(4))
    assert len(seen.posterior) == len(levels(seen.latents))
    for logits, level in zip(seen.posterior.values(), levels(seen.latents), strict=True):
        gap = np.diff(np.sort(np.asarray(logits), axis=-1)[..., -2:])[..., 0]
        clear = gap > 30
        assert clear.mean() > 0.5
        assert_array_equal(level.z.index[clear], logits.argmax(-1)[clear])


# --- which term of the loss trains which part -------------------------------------------------


MERGED = {
    "agent_in": ("obs", "agent_reward"),
    "full_in": ("terminated", "available", "action", "full_reward"),
}
"""First layers of several heads, side by side."""


def parts_of(path: tuple, leaf: np.ndarray) -> dict[str, np.ndarray]:
    """Whose it is, such as `filter.encoder`, `agent_prior` or `heads.obs`; columns of several."""
    names = jax.tree_util.keystr(path, simple=True, separator=".").split(".")
    names = [name for name in names if name not in ("nets", "team", "decoders")]
    if names[0] == "heads" and names[1] in MERGED:
        columns = np.split(leaf, leaf.shape[-1] // CONFIG.hidden, axis=-1)
        heads = MERGED[names[1]][: len(columns)]  # the last is not in all
        return {f"heads.{head}": own for head, own in zip(heads, columns, strict=True)}
    return {".".join(names[:2] if names[0] in ("filter", "heads") else names[:1]): leaf}


@eqx.filter_jit
def jacobian(model: Any, rows: TimeStep, config: WorldModelConfig) -> dict[str, Any]:
    """The gradient of each term of the loss."""

    def terms(model: Any) -> dict[str, Array]:
        batch = jax.tree.map(lambda x: x[:, None], rows)
        seen = observe_batch(model, batch, jax.random.key(1))
        predicted = jax.vmap(jax.vmap(model.predict))(seen.latents)
        losses = decoder_losses(predicted, batch, config, SPEC.action_space)
        return {name: loss.mean() for name, loss in (losses | kl_losses(seen, config)).items()}

    return eqx.filter_jacrev(terms)(model)


@cache
def reached(name: str, first: tuple[int, ...] = (0,), **options) -> dict[str, set[str]]:
    """Parts of a model that each term of the loss trains, over three rows."""
    config = replace(CONFIG, **options)
    gradients = jax.device_get(jacobian(build(name, **options), some_rows(3, first), config))
    return {
        term: {
            part
            for path, leaf in jax.tree_util.tree_leaves_with_path(gradient)
            for part, own in parts_of(path, leaf).items()
            if np.abs(own).max() > 0
        }
        for term, gradient in gradients.items()
    }


HEADS = {
    "obs": {"heads.obs"},
    "reward": {"heads.agent_reward"},
    "terminated": {"heads.terminated"},
    "available": {"heads.available"},
    "alive": {"heads.available"},  # one Bernoulli more
    "action": {"heads.action"},
}
OWN = {"filter.encoder", "filter.recurrent", "filter.posterior"}
GLOBAL = {"state_encoder", "global_recurrent", "global_posterior"}
TALK = {f"filter.{x}" for x in ("encoder", "inputs", "communication", "cell", "posterior")}


def test_dreamers_terms_train_the_filter_and_their_own_head_and_the_kl_the_prior():
    parts = reached("dreamer-v2")
    assert parts == {
        "kl_agent": OWN | {"agent_prior"},
        **{term: OWN | heads for term, heads in HEADS.items()},
    }


@pytest.mark.parametrize("name", TALKING)
def test_mambas_terms_train_all_that_is_said_and_their_own_head_and_the_kl_the_prior(name):
    parts = reached(name)
    assert parts == {
        "kl_agent": TALK | {"prior"},
        **{term: TALK | heads for term, heads in HEADS.items()},
    }


def test_sgs_terms_train_the_levels_that_they_see():
    parts = reached("mabl-sg")
    assert parts == {
        # The global posterior through the samples of earlier rows
        "kl_agent": OWN | GLOBAL | {"agent_prior", "global_prior"},
        "kl_global": OWN | GLOBAL | {"global_prior"},  # bottom-up; the agents' prior is spared
        **{
            term: OWN | heads if term in ("obs", "reward") else OWN | GLOBAL | heads
            for term, heads in HEADS.items()
        },
    }


@pytest.mark.parametrize(
    ("source", "others"),
    [
        ("prior", {"global_prior", "global_recurrent"}),
        ("posterior", {"global_posterior", "global_recurrent", "state_encoder"}),
    ],
)
def test_sgs_agent_kl_reaches_the_global_level_through_the_sample_it_is_conditioned_on(
    source, others
):
    # Every row is a first one, so that nothing can come from an earlier row's global sample.
    parts = reached("mabl-sg", (0, 1, 2), agent_prior_input=source)["kl_agent"]
    assert parts == OWN | {"agent_prior"} | others


def test_sgs_reward_trains_the_global_level_if_it_sees_it():
    parts = reached("mabl-sg", reward_input="both")
    assert parts["reward"] == OWN | GLOBAL | {"heads.full_reward"}
    assert parts["agent_reward"] == OWN | {"heads.agent_reward"}


# --- Dreamer-v2 -------------------------------------------------------------------------------


def changed_rows(rows: TimeStep, what: str, t: Any = slice(None)) -> TimeStep:
    """The rows with something else at rows `t`; of teammates, agent 1's."""
    field, index, change = {
        "state": ("state", t, lambda x: x + 9),
        "teammate's obs": ("obs", (t, 1), lambda x: -9 * x),
        "teammate's action": ("prev_action", (t, 1), lambda x: (x + 1) % 3),
        "teammate's life": ("alive", (t, 1), False),
    }[what]
    return put(rows, field, index, change)


def of_agent(seen: Seen, agents: Any) -> Any:
    """Everything of some agents, in models all of whose arrays are `[T, N, ...]`."""
    return jax.tree.map(lambda x: x[:, agents], seen)


@pytest.mark.parametrize(
    "what", ["state", "teammate's obs", "teammate's action", "teammate's life"]
)
def test_nothing_in_dreamer_sees_the_state_or_teammates(what):
    model, rows = build("dreamer-v2"), some_rows(4)
    before, after = observed(model, rows), observed(model, changed_rows(rows, what))
    others = np.array([0, 2])
    assert_same(of_agent(before, others), of_agent(after, others))
    # Positive controls
    if what == "teammate's obs":
        assert (before.posterior["agent"][:, 1] != after.posterior["agent"][:, 1]).any((1, 2)).all()
    elif what == "teammate's action":
        assert differ(before.latents.h[1:, 1], after.latents.h[1:, 1])
    else:  # its own either
        assert_same(before, after)


def test_nothing_in_dreamers_imagination_sees_teammates():
    model, rows = build("dreamer-v2"), some_rows(4)
    latent = at(observed(model, rows).latents, 1)
    moved = flipped(put(latent, "h", 1, lambda x: x + 1), 1)
    action = np.array([0, 1, 2])
    before, after = imagined(model, latent, action), imagined(model, moved, np.array([0, 2, 2]))
    others = np.array([0, 2])
    assert_same(at(before, others), at(after, others))
    assert differ(before.h[1], after.h[1])


def test_dreamers_actors_and_critics_see_the_agents_own_level():
    model = build("dreamer-v2")
    latent = at(observed(model, some_rows(4)).latents, 0)
    own = np.concatenate([latent.z.onehot(), latent.h], -1)
    assert_array_equal(vector(model.actor_features, latent), own)
    assert_array_equal(vector(model.critic_features, latent), own)


# --- MABL-SG ----------------------------------------------------------------------------------


def test_sg_has_one_global_latent_without_an_axis_of_agents():
    seen = observed(build("mabl-sg"), some_rows(4))
    for latents in (seen.latents, seen.prior_latents):
        assert latents.agent.h.shape == (4, 3, 8) and latents.agent.z.onehot().shape == (4, 3, 12)
        assert latents.global_.h.shape == (4, 8) and latents.global_.z.onehot().shape == (4, 12)
    for logits in (seen.posterior, seen.prior):
        assert logits["agent"].shape == (4, 3, 3, 4) and logits["global"].shape == (4, 3, 4)


def test_sgs_global_posterior_sees_the_state_and_every_agents_sample():
    model, rows = build("mabl-sg"), some_rows(1)

    @on_host
    def influence(state: Array, obs: Array) -> tuple[Array, Array]:
        """Straight through the samples: nothing else of the first row's observations is seen."""

        def logits(state: Array, obs: Array) -> Array:
            seen = rows._replace(state=state, obs=obs)
            return observe_sequence(model, seen, jax.random.key(1))[1]["global"]

        return jax.jacrev(logits, argnums=(0, 1))(state, obs)

    by_state, by_obs = influence(rows.state, rows.obs)
    assert (np.abs(by_state).sum((0, 1, 2)) > 0).all()  # every feature of the state
    assert (np.abs(by_obs).sum((0, 1, 2, 3, 5)) > 0).all()  # every agent

    # And it is the samples that count: the logits are those of (state, samples of all, h).
    rows = some_rows(4)
    seen = observed(model, rows)

    @on_host
    def posterior(state: Array, latent: Any) -> Array:
        state = jax.nn.relu(model.nets.state_encoder(state))
        return model.nets.global_posterior(state, latent.agent.z.ravel(), latent.global_.h)

    logits = posterior(rows.state[0], at(seen.latents, 0))
    assert_allclose(logits, seen.posterior["global"][0], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("what", ["state", "teammate's obs", "teammate's action"])
def test_sgs_agent_level_sees_neither_state_nor_teammates(what):
    model, rows = build("mabl-sg"), some_rows(4)
    before, after = observed(model, rows), observed(model, changed_rows(rows, what))
    for agent in (0, 2):
        own = lambda seen, i=agent: (at(seen.latents.agent, np.s_[:, i]),)  # noqa: E731
        assert_same(own(before), own(after))
        assert_array_equal(before.posterior["agent"][:, agent], after.posterior["agent"][:, agent])
        assert_array_equal(before.predicted.obs[:, agent], after.predicted.obs[:, agent])
    # Positive control: the team's level does.
    since = 1 if what == "teammate's action" else 0
    moved = before.posterior["global"][since:] != after.posterior["global"][since:]
    assert moved.any()


def test_sgs_agents_priors_see_the_teams_sample():
    model = build("mabl-sg")
    seen = observed(model, some_rows(4))
    team = jax.vmap(model.nets.agent_prior, in_axes=(0, None))
    prior = on_host(lambda h, z: jax.vmap(team)(h, z))
    h = seen.latents.agent.h
    assert_allclose(
        prior(h, seen.prior_latents.global_.z), seen.prior["agent"], rtol=1e-5, atol=1e-6
    )
    assert differ(prior(h, seen.latents.global_.z), seen.prior["agent"])
    # With `posterior` it is the posterior's.
    seen = observed(build("mabl-sg", agent_prior_input="posterior"), some_rows(4))
    assert_allclose(prior(h, seen.latents.global_.z), seen.prior["agent"], rtol=1e-5, atol=1e-6)


def test_sgs_agents_priors_may_see_the_teams_level():
    model = build("mabl-sg", agent_prior_sees="level")
    seen = observed(model, some_rows(4))
    prior = on_host(jax.vmap(jax.vmap(model.nets.agent_logits, in_axes=(0, None))))
    h, team = seen.latents.agent.h, seen.prior_latents.global_
    assert_allclose(prior(h, team), seen.prior["agent"], rtol=1e-5, atol=1e-6)
    assert differ(prior(h, team._replace(h=-team.h)), seen.prior["agent"])


@pytest.mark.parametrize("identity", [False, True])
def test_sgs_agents_priors_know_whose_they_are_with_agent_identity(identity):
    """Two agents with the same latent have the same prior, or each its own."""
    model = build("mabl-sg", agent_identity=identity)
    latent = at(observed(model, some_rows(4)).latents, 3)
    same = latent._replace(agent=at(latent.agent, np.array([0, 0, 2])))
    prior = on_host(lambda latent: model.prior(latent, jax.random.key(0))[1]["agent"])(same)
    assert differ(prior[0], prior[1]) == identity


def test_sgs_imagined_agents_follow_the_one_imagined_global_state():
    # Rig the agents' prior to copy the global sample, for certain.
    model = build("mabl-sg")

    def copier(net):  # hidden units are too few for all 12 inputs: the first 8 pass
        first, last = net.mlp.layers
        of_h, of_z = first.weight
        unit = jnp.arange(8)
        return eqx.tree_at(
            lambda n: (n.mlp.layers[0].weight, n.mlp.layers[1].weight),
            net,
            (
                (jnp.zeros_like(of_h), jnp.eye(12, 8).reshape(of_z.shape)),
                jnp.zeros_like(last.weight).at[unit, unit].set(50.0),
            ),
        )

    rigged = eqx.tree_at(lambda m: m.nets.agent_prior, model, copier(model.nets.agent_prior))
    initial, seen = jax.device_get(model.initial()), set()
    for seed in range(4):
        latent = imagined(rigged, initial, np.zeros(3, int), np.int32(seed))
        team = latent.global_.z.index[:2]
        assert_array_equal(latent.agent.z.index[:, :2], [team] * 3)
        seen.add(tuple(np.asarray(team)))
    assert len(seen) > 1


def test_sgs_actors_see_their_own_level_critics_the_teams_too_and_mixers_the_teams_sample():
    model = build("mabl-sg")
    latent = at(observed(model, some_rows(4)).latents, 0)
    (h, z), (team_h, team_z) = ((level.h, level.z.onehot()) for level in latent)
    team_h, team_z = np.stack([team_h] * 3), np.stack([team_z] * 3)
    for seen, parts in (
        (model.actor_features, [z, h]),
        (model.critic_features, [z, team_z, h, team_h]),
        (model.global_features, [team_z]),
    ):
        assert_array_equal(vector(seen, latent), np.concatenate(parts, -1))


# --- MAMBA and MAG ----------------------------------------------------------------------------


@pytest.fixture(params=TALKING)
def talking(request):
    return build(request.param)


@pytest.fixture(params=TALKING)
def decided(request):
    """Models whose samples follow what is seen, so that another observation is another sample."""
    return sharp(build(request.param), 30.0)


def test_a_teammates_observation_is_heard_at_the_next_row(decided):
    rows = some_rows(4)
    before = observed(decided, rows)
    after = observed(decided, changed_rows(rows, "teammate's obs", 1))
    one, other = (seen.latents.level.z.index[1, 1] for seen in (before, after))
    assert (one != other).any()  # it draws anew
    for agent in (0, 2):
        assert_same(
            at(before.latents.level, np.s_[:2, agent]), at(after.latents.level, np.s_[:2, agent])
        )
        assert differ(before.latents.level.h[2, agent], after.latents.level.h[2, agent])


def test_a_teammates_action_is_heard_with_the_row_it_leads_to(talking):
    rows = some_rows(4)
    before = observed(talking, rows)
    after = observed(talking, changed_rows(rows, "teammate's action", 2))
    assert_same(at(before.latents, np.s_[:2]), at(after.latents, np.s_[:2]))
    for agent in (0, 1, 2):
        assert differ(before.latents.level.h[2, agent], after.latents.level.h[2, agent])


def test_the_state_changes_nothing(talking):
    rows = some_rows(4)
    assert_same(observed(talking, rows), observed(talking, changed_rows(rows, "state")))


def test_who_is_dead_at_a_row_is_not_heard_from_then_on(decided):
    rows = some_rows(4)

    def compared(rows: TimeStep) -> tuple[Seen, Seen]:
        """With another teammate's observation at row 1 and action from there to row 2."""
        other = changed_rows(changed_rows(rows, "teammate's obs", 1), "teammate's action", 2)
        before, after = observed(decided, rows), observed(decided, other)
        assert (before.latents.level.z.index[1, 1] != after.latents.level.z.index[1, 1]).any()
        assert differ(before.latents.level.h[2, 1], after.latents.level.h[2, 1])  # to itself
        return before, after

    others = np.array([0, 2])
    dead = put(rows, "alive", np.s_[1:, 1], False)
    before, after = compared(dead)
    assert_same(of_agent(before, others), of_agent(after, others))
    before, after = compared(rows)
    for agent in others:
        assert differ(before.latents.level.h[2, agent], after.latents.level.h[2, agent])
    # Who dies at row 2 is heard there for the last time.
    before, after = compared(put(rows, "alive", np.s_[2:, 1], False))
    for agent in others:
        assert differ(before.latents.level.h[2, agent], after.latents.level.h[2, agent])


def living(model: MAMBA, logit: Array) -> MAMBA:
    """The model with this logit of being alive."""
    where = lambda m: m.decoders.nets.heads.available.layers[-1].bias  # noqa: E731
    return eqx.tree_at(where, model, where(model).at[..., -1].set(logit))


def hears(model: MAMBA, latent: Any, teammate: int) -> np.ndarray:
    """Who, in the next imagined row, is another when a teammate's sample and action are."""
    action = np.array([0, 1, 2])
    said = latent._replace(level=flipped(latent.level, teammate))
    before = imagined(model, latent, action)
    after = imagined(model, said, np.where(np.arange(3) == teammate, (action + 1) % 3, action))
    return np.asarray((before.level.h != after.level.h).any(-1))


def test_who_is_predicted_to_die_is_not_heard_from_the_next_step_on():
    start = at(observed(build("mamba"), some_rows(4)).latents, 1)
    for logit, everyone in ((-100.0, False), (100.0, True)):
        model = living(build("mamba"), logit)
        assert_array_equal(hears(model, start, 1), [True] * 3)  # alive at the start, whatever comes
        after = imagined(model, start, np.array([0, 1, 2]))
        assert_array_equal(after.alive, [everyone] * 3)
        assert_array_equal(hears(model, after, 1), [everyone, True, everyone])
    # Nobody comes back to life.
    dead = start._replace(alive=np.array([True, False, True]))
    after = imagined(living(build("mamba"), 100.0), dead, np.array([0, 1, 2]))
    assert_array_equal(after.alive, [True, False, True])


@pytest.mark.parametrize(("sample", "share"), [(True, 0.8), (False, 1.0)])
def test_who_is_drawn_dead_in_imagination_is_not_heard_from(sample, share):
    model = living(build("mamba"), float(np.log(4.0)))  # alive with probability .8
    start = at(observed(model, some_rows(4)).latents, 1)
    config = ImaginationConfig(sample_life=sample)
    dream = Dream(model, None, SPEC.action_space, config, CONFIG, lambda latent: ())  # pyright: ignore
    latent = still(jax.tree.map(jnp.asarray, start))
    state = Imagined(latent, jnp.ones((3, 3), bool), jnp.ones(3, bool))
    step = jax.jit(lambda key: dream.step(state, jnp.array([0, 1, 2]), key)[0])
    after = jax.device_get(jax.vmap(step)(jax.random.split(jax.random.key(0), 200)))
    assert_array_equal(after.latent.alive, after.alive)
    assert abs(after.alive.mean() - share) < 0.06


def test_in_mag_who_dies_is_each_agents_own_prediction():
    start = at(observed(build("mag"), some_rows(4)).latents, 1)
    model = living(build("mag"), jnp.array([100.0, -100.0, 100.0]))
    after = imagined(model, start, np.array([0, 1, 2]))
    assert_array_equal(after.alive, [True, False, True])
    assert_array_equal(hears(model, after, 1), [False, True, False])
    assert_array_equal(hears(model, after, 2), [True] * 3)


@on_host
def sequence(model: MAMBA, rows: TimeStep, key: Array, train: bool) -> Any:
    return observe_sequence(model, rows, key, train)[0]


def test_dropout_falls_in_training_alone(talking):
    # The first row's h follows from nothing but zeros, hence from no sample.
    rows, keys = some_rows(4), [jax.random.key(seed) for seed in (0, 1)]
    plain, same = (sequence(talking, rows, key, False).level.h[0] for key in keys)
    assert_array_equal(plain, same)
    one, other = (sequence(talking, rows, key, True).level.h[0] for key in keys)
    assert differ(one, other)
    assert differ(one, plain)
    assert_same(sequence(talking, rows, keys[0], True), sequence(talking, rows, keys[0], True))


def test_execution_is_the_posterior_without_dropout(talking):
    rows = some_rows(4, first=(0, 2))
    rows = put(rows, "alive", (1, 2), False)
    key = jax.random.key(3)
    latents = sequence(talking, rows, key, False)

    @on_host
    def joint(memory: Any, row: TimeStep, key: Array) -> Any:
        action = SPEC.action_space.encode(row.prev_action)
        memory, action = forget((memory, action), row.is_first)
        return talking.filter.joint(memory, action, row.obs, row.alive, key)

    memory = talking.filter.initial()
    for t, key_t in enumerate(jax.random.split(key, 4)):
        row = at(rows, t)
        memory = joint(memory, row, key_t)
        assert_allclose(memory.level.h, latents.level.h[t], rtol=1e-5, atol=1e-6)
        assert_array_equal(memory.level.z.index, latents.level.z.index[t])
        assert_array_equal(memory.alive, row.alive)
        own = np.concatenate([memory.level.z.onehot(), memory.level.h], -1)
        for seen in (talking.filter.features, talking.actor_features, talking.critic_features):
            assert_array_equal(vector(seen, memory), own)


def test_only_without_sharing_every_parameter_has_an_axis_of_agents():
    shared, own = build("mamba"), build("mag")
    pairs = list(zip(jax.tree.leaves(shared), jax.tree.leaves(own), strict=True))
    assert len(pairs) > 40
    for one, each in pairs:
        assert each.shape == (3, *one.shape)
    # They start apart where they start at random.
    weights = [each for one, each in pairs if one.ndim > 1]
    for weight in weights:
        assert differ(weight[0], weight[1]) and differ(weight[1], weight[2])


def test_in_mag_an_agents_parameters_are_its_own_and_teammates_are_heard_all_the_same():
    model = build("mag")
    start = at(observed(model, some_rows(4)).latents, 1)
    rng = np.random.default_rng(0)

    def disturbed(x: np.ndarray) -> np.ndarray:
        """Agent 1's are others."""
        noise = rng.normal(size=x.shape).astype(np.float32)
        noise[[0, 2]] = 0
        return x + noise

    other = jax.tree.map(disturbed, jax.device_get(model))
    action = np.array([0, 1, 2])
    before, after = imagined(model, start, action), imagined(other, start, action)
    others = np.array([0, 2])
    assert_same(at(before, others), at(after, others))
    assert differ(before.level.h[1], after.level.h[1])
    # Observing, likewise, in the first row; in the second its other sample is heard.
    before, after = observed(model, some_rows(4)), observed(other, some_rows(4))
    assert_same(at(of_agent(before, others), np.s_[:1]), at(of_agent(after, others), np.s_[:1]))
    assert (before.latents.level.z.index[0, 1] != after.latents.level.z.index[0, 1]).any()
    assert differ(before.latents.level.h[1, 0], after.latents.level.h[1, 0])
    assert_array_equal(hears(model, start, 1), [True] * 3)


def test_heads_that_do_not_divide_the_width_are_a_users_mistake():
    with pytest.raises(UserError, match=r"--world-model.hidden is 8.*--communication.n-heads"):
        MAMBA(SPEC, CONFIG, jax.random.key(0), replace(COMMUNICATION, n_heads=3))


# --- MAG's lookahead --------------------------------------------------------------------------


class Fork(NamedTuple):
    """The latent of `Forking`."""

    start: Array
    kind: Array
    row: Array
    action: Array


# What rows 1 to 4 of each kind are feared to be, from start 0
FEARS = np.array(
    [
        [0, 3.0, 3.0, 0.0],
        [9, 4.0, 1.0, 9.0],
        [9, 9.0, 0.0, -20.0],
    ]
)
BEST = {
    # Row 1 is the candidate's own and does not count.
    1: 0,  # 3, 4 or 9
    2: 1,  # 3 + 3, 4 + 1 or 9 + 0
    3: 2,  # 6, 14 or -11
}


class Forking(eqx.Module):
    """A world model that draws one of three kinds at its first row, for good.

    Start 1 has start 0's kinds in another order. Agent 0's feature is twice what is feared of the
    row, agent 1's the negative of it; after action 0, all is reversed.
    """

    def imagine(self, latent: Fork, action: Array, key: Array) -> Fork:
        kind = jnp.where(latent.row == 0, jax.random.randint(key, (), 0, 3), latent.kind)
        return Fork(latent.start, kind, latent.row + 1, action[0].argmax())

    def actor_features(self, latent: Fork) -> Array:
        kind = (latent.kind - latent.start) % 3
        fear = jnp.asarray(FEARS)[kind, jnp.maximum(latent.row - 1, 0)]
        fear = jnp.where(latent.action == 1, fear, -fear)
        return jnp.stack([2 * fear, -fear])[:, None].astype(jnp.float32)

    def predict(self, latent: Fork) -> Predictions:
        each = jnp.full(2, latent.kind, jnp.float32)
        return Predictions(
            obs=each[:, None],
            reward=each,
            agent_reward=None,
            terminated=each,
            available=jnp.full((2, 2), 99.0),
            alive=each + 1.0,
            action=jnp.zeros((2, 2)),
        )


def choose(starts: list[int], **options) -> tuple[Imagined, Predictions]:
    """`best_candidate` at several starts, after action 0; the policy goes on with action 1."""
    dream = Dream(
        Forking(),
        lambda features, available: MaskedCategorical.of(jnp.array([-99.0, 99.0]), available),
        Discrete(2),
        ImaginationConfig(),
        WorldModelConfig(),
        lambda latent: jnp.zeros((2, 1)),
    )
    # Linear networks that repeat what they see
    error = Team(lambda key: MLP(1, 1, 1, 0, key), 2, False, jax.random.key(0))
    error = eqx.tree_at(lambda e: e.nets.layers[0].weight, error, jnp.ones((2, 1, 1)))
    config = LookaheadConfig(**options)
    zero = jnp.int32(0)

    @jax.jit
    @jax.vmap
    def at_start(start: Array, key: Array) -> tuple[Imagined, Predictions]:
        latent = Fork(start, zero, zero, zero)
        state = Imagined(latent, jnp.ones((2, 2), bool), jnp.array([True, False]))
        return best_candidate(dream, error, config, state, jnp.zeros(2, int), key)

    return at_start(jnp.array(starts), jax.random.split(jax.random.key(1), len(starts)))


@pytest.mark.parametrize("steps", BEST)
def test_of_many_candidates_each_start_keeps_the_one_feared_least_further_on(steps):
    # Of 64 draws from three kinds every kind is among them.
    starts = [0, 1, 0, 1, 1]
    state, predicted = choose(starts, candidates=64, steps=steps)
    kinds = [(BEST[steps] + start) % 3 for start in starts]
    assert_array_equal(state.latent.kind, kinds)
    # It is the next state that is kept, not one further on, and what is predicted of it.
    assert_array_equal(state.latent.row, [1] * 5)
    assert_array_equal(state.latent.action, [0] * 5)
    assert_array_equal(predicted.reward, np.array(kinds)[:, None].repeat(2, 1))
    assert_array_equal(state.alive, [[True, False]] * 5)


def test_with_one_candidate_nothing_is_chosen():
    state, predicted = choose([0] * 40, candidates=1, steps=3)
    assert set(np.asarray(state.latent.kind)) == {0, 1, 2}
    assert_array_equal(predicted.reward[:, 0], state.latent.kind)


@pytest.fixture(scope="module")
def mag():
    """A tiny MAG and what it can learn from."""
    config = tiny("mag")  # with a KL that shows
    config = replace(config, world_model=replace(config.world_model, kl_weight=30.0))
    training = build_training(config)

    @jax.jit
    def begin(key: Array) -> tuple[Any, Experience]:
        state = training.init(key)
        collectors, collected = training.collect(state.learner, state.collectors, key)
        replay = training.store(state.replay, collected)
        return state.learner, Experience(replay, collectors, collected)

    algorithm = training.algorithm
    config = algorithm.config.world_model

    @jax.jit
    def learn(learner: Any, experience: Experience, key: Array) -> tuple:
        """An update of the model, and the losses of what it then saw and the error foretold."""
        after, metrics = algorithm.update_model(learner, experience, key)
        _, key_sample, key_observe = jax.random.split(key, 3)
        rows = sample_sequences(
            experience.replay, key_sample, config.batch_size, config.batch_length
        )
        rows = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), rows)
        model = after.base.model
        seen = observe_batch(model, rows, key_observe)
        predicted = jax.vmap(jax.vmap(model.predict))(seen.latents)
        losses = decoder_losses(predicted, rows, config, algorithm.spec.action_space)
        nats = categorical_kl(seen.posterior["agent"], seen.prior["agent"]).sum(-1)
        # What balancing divides comes to the whole.
        losses["kl"] = config.kl_weight * nats
        features = jax.vmap(jax.vmap(model.actor_features))(seen.prior_latents)
        foretold = jax.vmap(jax.vmap(lambda x: predict_error(learner.error, x)))(features)
        return after, metrics, losses, foretold

    return config, learn, *begin(jax.random.key(0))


def test_the_error_predictor_never_moves_the_world_model(mag):
    _, learn, learner, experience = mag
    wild = learner._replace(error=jax.tree.map(lambda x: 100 * x + 1, learner.error))
    key = jax.random.key(2)
    (one, metrics, *_), (other, wild_metrics, *_) = (
        learn(x, experience, key) for x in (learner, wild)
    )
    assert_same(one.base, other.base)
    for before, after in zip(
        jax.tree.leaves(learner.base.model), jax.tree.leaves(one.base.model), strict=True
    ):
        assert (before != after).any()
    name = "world_model/loss_predicted_error"
    assert wild_metrics[name] > 10 * metrics[name] > 0
    for before, after in zip(
        jax.tree.leaves(learner.error), jax.tree.leaves(one.error), strict=True
    ):
        assert (before != after).any()


def test_the_predicted_error_is_the_models_loss_at_each_row_of_each_agent(mag):
    config, learn, learner, experience = mag
    assert config.kl_reduction == "sum" and not config.free_nats
    assert config.kl_prior_weight + config.kl_posterior_weight == pytest.approx(1.0)
    names = ("kl", "obs", "reward", "terminated", "available")
    key = jax.random.key(2)

    def sum_of(losses: dict[str, Array], *names: str) -> np.ndarray:
        return np.sum([losses[name] for name in names], axis=0)

    # Right in the middle, so that some rows and agents are worse and some better than foretold
    losses, foretold = jax.device_get(learn(learner, experience, key)[2:])
    error = eqx.tree_at(
        lambda e: e.nets.layers[-1].bias,
        learner.error,
        replace_fn=lambda x: x + np.median(sum_of(losses, *names) - foretold),
    )
    _, metrics, losses, foretold = jax.device_get(
        learn(learner._replace(error=error), experience, key)
    )
    assert foretold.shape == (5, 4, 2)  # rows, batch, agents
    off = foretold - sum_of(losses, *names)
    assert 0.2 < (off > 0).mean() < 0.8

    def huber(x: np.ndarray) -> float:
        return np.where(np.abs(x) < 1, 0.5 * x**2, np.abs(x) - 0.5).mean()

    found = metrics["world_model/loss_predicted_error"]
    assert_allclose(found, huber(off), rtol=1e-4)
    others = [sum_of(losses, *x) for x in (names[1:], names[:-1], (*names, "action"))]
    others.append(sum_of(losses, *names, "alive"))
    wrong = [huber(foretold - other) for other in others] + [huber(off.mean(i)) for i in (0, 2)]
    assert np.abs(wrong / found - 1).min() > 2e-3  # twenty times the tolerance
