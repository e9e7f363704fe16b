"""Features in parts are to behaviour what their concatenation is."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mabl.behaviour.mappo import MAPPO, MAPPOConfig
from mabl.behaviour.qmix import QMIX, QMIXConfig
from mabl.envs.base import Continuous, Discrete
from mabl.nets.categorical import Code
from mabl.nets.mlp import Linear, dense, parts_of
from mabl.types import TeamView

MAPPO_TINY = MAPPO(MAPPOConfig(hidden=16, n_hidden=1, n_heads=2, actor_out_scale=1.0))
QMIX_TINY = QMIX(QMIXConfig(hidden=16, n_hidden=1, mixer_hidden=4, hypernet_hidden=8))
KEY = jax.random.key(1)


def some_views() -> TeamView:
    """Of eight teams of two: three categoricals of four classes or none, and h of 5."""
    keys = jax.random.split(jax.random.key(0), 3)
    z, z_global = (Code(jax.random.randint(k, (8, 2, 3), 0, 5), None, 4) for k in keys[:2])
    h, h_global = jax.random.normal(keys[2], (2, 8, 2, 5))
    full = z, z_global, h, h_global
    return TeamView((z, h), full, jnp.ones((8, 2, 3), bool), jnp.ones((8, 2), bool))


def stacked(net):
    """Each layer's blocks of weights as one matrix."""

    def stack(x):
        if not isinstance(x, Linear):
            return x
        rows = [block.reshape(-1, block.shape[-1]) for block in parts_of(x.weight)]
        return eqx.tree_at(lambda x: x.weight, x, jnp.concatenate(rows))

    return jax.tree.map(stack, net, is_leaf=lambda x: isinstance(x, Linear))


def choose(actor, view):
    return jax.vmap(actor)(view.actor_features, view.available)


# A fresh network for a team's view, and what it makes of one.
NETWORKS = {
    "actor": (
        lambda view: MAPPO_TINY.init(view, Discrete(3), KEY).actor,
        lambda actor, view: choose(actor, view).log_probs,
    ),
    "continuous actor": (
        lambda view: MAPPO_TINY.init(view, Continuous(3), KEY).actor,
        lambda actor, view: choose(actor, view).log_prob(jnp.zeros((2, 3))),
    ),
    "critic": (
        lambda view: MAPPO_TINY.init(view, Discrete(3), KEY).critic,
        lambda critic, view: critic(view.critic_features),
    ),
    "mixer": (
        lambda view: QMIX_TINY.init(view, Discrete(3), KEY).values,
        lambda values, view: values.chosen(view, jnp.array([0, 2])),
    ),
}


@pytest.mark.parametrize("name", NETWORKS)
def test_parts_are_worth_their_concatenation(name):
    init, apply = NETWORKS[name]
    views = some_views()
    if name == "mixer":  # sees the global codes alone
        views = views._replace(critic_features=views.critic_features[1])
    joined = views._replace(
        actor_features=dense(views.actor_features), critic_features=dense(views.critic_features)
    )

    @eqx.filter_jit
    def seen_by(net, views):
        """Of each team, and the gradient of the sum of squares."""

        def loss(net):
            out = jax.vmap(apply, in_axes=(None, 0))(net, views)
            return (out**2).sum(), out

        gradient, out = eqx.filter_grad(loss, has_aux=True)(net)
        return out, gradient

    net = init(jax.tree.map(lambda x: x[0], views))
    whole = init(jax.tree.map(lambda x: x[0], joined))
    jax.tree.map(assert_array_equal, stacked(net), whole)
    (out, gradient), (expected, expected_gradient) = seen_by(net, views), seen_by(whole, joined)
    assert np.ptp(expected) > 0.1
    assert_allclose(out, expected, rtol=1e-5, atol=1e-6)
    pairs = zip(*map(jax.tree.leaves, (stacked(gradient), expected_gradient)), strict=True)
    for got, wanted in pairs:
        assert wanted.ndim == 1 or np.abs(wanted).max() > 1e-3  # keys' biases change nothing
        assert_allclose(got, wanted, rtol=1e-4, atol=1e-5)
