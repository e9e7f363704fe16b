"""Suites as data: what they expand to, and what is said of mistakes."""

from pathlib import Path

import pytest

from mabl import UserError, cli, preset
from mabl.experiments.jobs import Job, in_a_row, jobs_of, read_job
from mabl.experiments.processes import LocalBackend
from mabl.experiments.suite import load, narrowed
from mabl.training.programs import build

TABLE_1 = {  # of the paper: steps by task
    "smac/2s_vs_1sc": 100_000,
    "smac/3s_vs_4z": 100_000,
    "smac/3s_vs_5z": 200_000,
    "smac/corridor": 450_000,
    "smac/3s5z_vs_3s6z": 450_000,
    "flatland/5_agents": 100_000,
    "flatland/10_agents": 450_000,
    "mamujoco/Humanoid": 200_000,
    "mamujoco/HumanoidStandup": 800_000,
}


@pytest.fixture(autouse=True)
def nothing_runs(monkeypatch):
    """A mistake that is none must not train for minutes."""
    monkeypatch.setattr(LocalBackend, "submit", lambda self, job: pytest.fail("it would run"))


def written(folder: Path, text: str) -> Path:
    path = folder / "mine.yaml"
    path.write_text(text)
    return path


def test_the_papers_table_is_the_papers():
    configs = list(load("paper-table1").configs(Path("runs")))
    assert {c.env: c.total_steps for c in configs} == TABLE_1
    assert {c.algo for c in configs} == {"mabl", "dreamer-v2", "mappo", "mamba", "mag"}
    assert len(configs) == 45 and all(c.preset == "paper" for c in configs)


def test_the_ablation_is_that_of_figure_5():
    configs = list(load("paper-ablation").configs(Path("runs")))
    assert {c.algo for c in configs} == {"mabl", "mabl-sg", "dreamer-v2"}
    assert {c.env for c in configs} == {"smac/3s_vs_4z", "smac/3s_vs_5z", "smac/corridor"}


def test_smax_has_the_papers_maps_and_budgets():
    steps = {c.env: c.total_steps for c in load("smax").configs(Path("runs"))}
    maps = {name for name in TABLE_1 if name.startswith("smac/")}
    assert steps == {name.replace("smac", "smax"): TABLE_1[name] for name in maps}


def test_every_job_of_the_quick_suite_can_be_built():
    for job in jobs_of(load("quick"), Path("runs")):
        assert job.seeds == (0, 1, 2)
        build(job.config)


def test_later_settings_win(tmp_path):
    path = written(
        tmp_path,
        """
        tasks: [smax/3m, {env: smax/2s3z, config: {total_steps: 7, training: {num_envs: 3}}}]
        algorithms:
          - mabl
          - {algo: mabl, label: mabl-5, config: {total_steps: 9, training: {model_updates: 5}}}
          - mappo
        config: {total_steps: 5, training: {checkpoint_every: 4}, world_model: {hidden: 32}}
        """,
    )
    first, _, _, plain, changed, free = load(str(path)).configs(tmp_path)
    assert (first.total_steps, plain.total_steps, changed.total_steps) == (5, 7, 9)
    assert changed.training.num_envs == 3 and changed.training.checkpoint_every == 4
    assert changed.training.model_updates == 5 and changed.name == "mabl-5"
    assert (
        plain.training.prefill_steps == preset("quick", "smax/2s3z", "mabl").training.prefill_steps
    )
    assert plain.world_model.hidden == 32 and free.algo == "mappo"


def test_seeds_of_compiled_environments_are_one_job_and_others_are_many(tmp_path):
    path = written(tmp_path, "{tasks: [test/coordination, test/host-counting], algorithms: [mabl]}")
    jobs = jobs_of(load(str(path)), tmp_path)
    assert [job.seeds for job in jobs] == [(0, 1, 2), (0,), (1,), (2,)]
    assert [job.name for job in jobs][:2] == [
        "test-coordination_mabl_seeds-0-2",
        "test-host-counting_mabl_seed-0",
    ]


def test_a_job_is_written_and_read_back(tmp_path):
    path = written(
        tmp_path,
        "{tasks: [{env: test/coordination, env_kwargs: [x=1]}], algorithms: [mabl], seeds: 2}",
    )
    (job,) = jobs_of(load(str(path)), tmp_path / "logs")
    assert read_job(job.write()) == job and isinstance(job, Job)


def test_seeds_in_a_row():
    assert in_a_row([4, 0, 1, 7, 5]) == [[0, 1], [4, 5], [7]]


def test_a_part_of_a_suite():
    part = narrowed(load("quick"), ["smax/3m"], ["mappo", "mabl"])
    assert [task.env for task in part.tasks] == ["smax/3m"]
    assert [one.algo for one in part.algorithms] == ["mabl", "mappo"]


MISTAKES = {
    "name": ("quikc", "unknown suite 'quikc': did you mean quick?"),
    "file": ("none.yaml", "cannot read none.yaml (No such file or directory)"),
    "yaml": ("tasks: [", "is not readable YAML"),
    "alias": ("tasks: &a [smax/3m]\nalgorithms: *a", "aliases are not read"),
    "list": ("3", "is no suite: give tasks and algorithms"),
    "no tasks": ("algorithms: [mabl]", "has no list of tasks"),
    "none": ("{tasks: [], algorithms: [mabl]}", "has no tasks: give at least one"),
    "field": ("{tasks: [smax/3m], algorithms: [mabl], sneeds: 3}", "unknown config field 'sneeds'"),
    "seeds": ("{tasks: [smax/3m], algorithms: [mabl], seeds: 0}", "--seeds is 0"),
    "no env": ("{tasks: [{config: {}}], algorithms: [mabl]}", "missing"),
    "algo": ("{tasks: [smax/3m], algorithms: [mable]}", "unknown algorithm 'mable'"),
    "env": ("{tasks: [smox/3m], algorithms: [mabl]}", "unknown environment 'smox/3m'"),
    "config": (
        "{tasks: [smax/3m], algorithms: [mabl], config: {training: {num_env: 3}}}",
        "unknown config field 'training.num_env'",
    ),
    "type": (
        "{tasks: [smax/3m], algorithms: [mabl], config: {total_steps: many}}",
        "config field total_steps is 'many': give int",
    ),
    "twice": ("{tasks: [smax/3m], algorithms: [mabl, mabl]}", "twice: give one of them a label"),
    "label": ("{tasks: [smax/3m], algorithms: [{algo: mabl, label: a/b}]}", "--label is 'a/b'"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_in_a_suite_is_one_line(name, tmp_path):
    text, expected = MISTAKES[name]
    suite = text if name in ("name", "file") else str(written(tmp_path, text))
    with pytest.raises(UserError) as error:
        cli.run(["suite", "run", suite, f"--logdir={tmp_path}"])
    assert expected in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ([], "needs a verb"),
        (["quick"], "needs a verb"),
        (["run", "quick", "--tasks", "smax/4m"], "unknown task of suite quick 'smax/4m'"),
        (["run", "quick", "--algorithms", "mag"], "unknown algorithm of suite quick 'mag'"),
        (["run", "quick", "--address", "auto"], "add --backend ray"),
        (["run", "quick", "--cpus", "4096"], "this machine has"),
    ],
)
def test_a_mistake_on_the_command_line_is_one_line(given, expected, tmp_path):
    with pytest.raises(UserError, match=expected):
        cli.run(["suite", *given, *([f"--logdir={tmp_path}"] if given[:1] == ["run"] else [])])


def test_suites_are_listed(capsys):
    assert cli.run(["suite", "list"]) == 0
    said = capsys.readouterr().out
    assert all(name in said for name in ("paper-table1", "paper-ablation", "smax", "quick"))


def test_jobs_are_written_for_other_schedulers(capsys, tmp_path):
    run = ["suite", "jobs", "quick", f"--logdir={tmp_path}", "--total-steps=100", "--num-seeds=2"]
    assert cli.run([*run, "--algorithms", "mabl", "mappo"]) == 0
    jobs = [read_job(Path(line)) for line in capsys.readouterr().out.splitlines()]
    assert [(job.config.env, job.config.algo) for job in jobs] == [
        ("smax/3m", "mabl"),
        ("smax/3m", "mappo"),
        ("test/coordination", "mabl"),
        ("test/coordination", "mappo"),
    ]
    assert {job.seeds for job in jobs} == {(0, 1)} and jobs[0].config.total_steps == 100
