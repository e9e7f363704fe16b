import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import pytest
from tests.tiny import flags, tiny

from mabl import bench
from mabl.errors import UserError
from mabl.nets.product import product


def test_work_is_counted_by_hand():
    x, w = jnp.ones((5, 3)), jnp.ones((3, 7))

    def looped(x):
        step = jax.jit(lambda x, _: (x, jax.vmap(lambda row: jnp.tanh(row @ w))(x)))
        return jax.lax.scan(step, x, None, length=4)

    # 2 * 5 * 3 * 7 = 210, four times; with a batch axis of 2 twice that
    assert bench.flop(jax.make_jaxpr(lambda x: x @ w)(x).jaxpr) == 210
    assert bench.flop(jax.make_jaxpr(looped)(x).jaxpr) == 840
    assert bench.flop(jax.make_jaxpr(jax.vmap(looped))(jnp.ones((2, 5, 3))).jaxpr) == 1680
    assert bench.flop(jax.make_jaxpr(lambda x: (x * x).sum())(x).jaxpr) == 0
    # Of networks: 210, and both gradients as much again
    assert bench.flop(jax.make_jaxpr(jax.grad(lambda w: product(x, w).sum()))(w).jaxpr) == 420
    learned = jax.grad(lambda x, w: product(product(x, w), w.T).sum(), (0, 1))
    assert bench.flop(jax.make_jaxpr(learned)(x, w).jaxpr) == 6 * 210

    def either(x):  # one product or two
        return jax.lax.cond(x[0, 0] > 0, lambda x: x @ w, lambda x: (x @ w) @ w.T @ w, x)

    assert bench.flop(jax.make_jaxpr(either)(x).jaxpr) == 630
    wasted = bench.Part(lambda x: (x @ w, x)[1], (x,))
    assert bench.flop_of(wasted) == 0  # nobody reads it


@pytest.mark.parametrize("algo", ["mabl", "mag", "mappo"])
def test_every_part_is_timed(algo):
    heard = []
    report = bench.measure(tiny(algo), 2, (), heard.append)
    parts = ["replay sampling", "model update", "imagination", "behaviour update"]
    expected = ["collection", *parts * (algo != "mappo"), "cycle"]
    assert list(report.timings) == expected
    assert [name for name in heard if name in expected] == expected
    for timing in report.timings.values():
        assert len(timing.seconds) == 2 and min(timing.seconds) > 0
    assert all(rate > 0 for rate in report.peak.values())
    assert report.compile_seconds > 0 and report.memory > 2**20
    if algo != "mappo":
        flop = {name: timing.flop for name, timing in report.timings.items()}
        learning = flop["imagination"] + flop["behaviour update"]
        assert flop["model update"] > 0 and learning > 0
        assert flop["cycle"] == 2 * flop["model update"] + learning  # as SIZES say


def test_seeds_are_timed_together():
    one = bench.measure(tiny("mabl"), 1, ("model update",), str).timings["model update"]
    config = replace(tiny("mabl"), num_seeds=3)
    three = bench.measure(config, 1, ("model update",), str).timings["model update"]
    assert three.flop == 3 * one.flop


def test_bench_writes_what_it_compares_with(tmp_path, mabl):
    arguments = ["bench", *flags("mabl", "test/coordination"), "--repeats=1", "--parts"]
    path = tmp_path / "first.json"
    code, out, _ = mabl(*arguments, "replay sampling", "model update", f"--json={path}")
    assert code == 0 and "model update" in out and "times as fast" not in out
    written = json.loads(path.read_text())
    assert set(written["timings"]) == {"replay sampling", "model update"}
    assert written["subject"]["env"] == "test/coordination"
    assert "jax" in written["machine"] and "git" in written["machine"]

    written["timings"]["model update"]["median"] = 1000.0  # seconds, so that ours is far faster
    written["subject"]["precision"] = "bfloat16"
    path.write_text(json.dumps(written))
    code, out, _ = mabl(*arguments, "model update", "collection", f"--against={path}")
    (model,) = (line for line in out.splitlines() if line.strip().startswith("model update"))
    (collection,) = (line for line in out.splitlines() if line.strip().startswith("collection"))
    assert code == 0 and float(model.split()[-1].replace(",", "")) > 1000
    assert collection.split()[-1] == "-"  # it was not timed before
    assert "against another: precision bfloat16 -> float32" in out


def test_what_cannot_be_timed_is_said(tmp_path, mabl):
    with pytest.raises(UserError, match="mappo has no part 'model update': give collection, cycle"):
        bench.measure(tiny("mappo"), 1, ("model update",), str)
    arguments = ["bench", *flags("mabl", "test/coordination")]
    other = tmp_path / "other.json"
    other.write_text("{}")
    odd = tmp_path / "odd.json"
    odd.write_text('{"timings": []}')
    for wrong, message in (
        ("--repeats=0", "--repeats is 0: give a number above 0"),
        (f"--against={tmp_path / 'none.json'}", "is no report of mabl bench --json"),
        (f"--against={other}", "is no report of mabl bench --json"),
        (f"--against={odd}", "is no report of mabl bench --json"),
        (f"--json={tmp_path / 'none' / 'x.json'}", "there is no folder"),
        (f"--json={tmp_path}", "is a folder: give a file"),
    ):
        code, _, err = mabl(*arguments, wrong)
        assert code == 2 and message in err and "Traceback" not in err


def test_a_replay_smaller_than_the_prefill_is_filled():
    config = tiny("mabl")
    plan = replace(config.training, replay_capacity=90, prefill_steps=100)
    report = bench.measure(replace(config, training=plan), 1, ("replay sampling",), str)
    assert list(report.timings) == ["replay sampling"]


def test_programs_are_compiled_and_not_read_from_the_cache():
    events = []
    jax.monitoring.register_event_listener(lambda name, **_: events.append(name))
    hits, misses = (f"/jax/compilation_cache/cache_{kind}" for kind in ("hits", "misses"))
    try:
        for _ in range(2):
            events.clear()
            bench.measure(tiny("dreamer-v2"), 1, ("collection",), events.append)
            compiling = events[events.index("compiling") : events.index("peak")]
            assert hits not in compiling and misses not in compiling
        assert {hits, misses} & set(events)  # the cache is on again
    finally:
        jax.monitoring.clear_event_listeners()
