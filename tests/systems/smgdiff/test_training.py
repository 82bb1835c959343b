"""SMGDiff's runs: splits, stages, folders, and what plans and players score."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.data import clips
from jaxmotion.data.ball_clips import save_ball_clips
from jaxmotion.learning import checkpoint, runs
from jaxmotion.learning.checkpoint import CheckpointError, latest_step, load_config
from jaxmotion.motion import trajectory
from jaxmotion.systems.smgdiff import controller as smgdiff_controller
from jaxmotion.systems.smgdiff import data as smgdiff_data
from jaxmotion.systems.smgdiff import evaluation as smgdiff_evaluation
from jaxmotion.systems.smgdiff import guidance as smgdiff_guidance
from jaxmotion.systems.smgdiff import model as smgdiff_model
from jaxmotion.systems.smgdiff import players as smgdiff_players
from jaxmotion.systems.smgdiff import scoring as smgdiff_scoring
from jaxmotion.systems.smgdiff import training as smgdiff_training
from jaxmotion.systems.smgdiff import trajectory as smgdiff_trajectory
from jaxmotion.systems.smgdiff.guidance import UNGUIDED
from tests import ball_walker, tiny

pytestmark = pytest.mark.slow

SIZES = dict(
    past=4, future=12, num_steps=2, width=16, depth=1, heads=2, hidden=32, dropout=0.0
)
PATHS = dict(width=16, depth=1, heads=2, hidden=32, frames_per_token=2)
BUDGET = runs.Budget(steps=4, batch=4, chunk=2, save_every=2)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """As it is read back, before any stage."""
    folder = tmp_path_factory.mktemp("run")
    data = folder / "clips.npz"
    save_ball_clips(data, ball_walker.clips(60))
    smgdiff_training.prepare(
        folder / "run", data, held_out=0.3, sizes=SIZES, paths=PATHS
    )
    return smgdiff_training.load_run(folder / "run")


@pytest.fixture(scope="module")
def trained(run):
    """Both stages, trained for four updates."""
    for stage in ("motion_2", "paths_1"):
        smgdiff_training.train_stage(run, stage, budget=BUDGET, draft_steps=2)
    return smgdiff_training.load_run(run.record.folder)


def setting_of(run, evaluator_steps):
    return smgdiff_evaluation.make_setting(
        run.train,
        run.held_out,
        run.model,
        number=16,
        replications=3,
        evaluator_steps=evaluator_steps,
        seed=0,
    )


@pytest.fixture(scope="module")
def setting(run):
    """With an evaluator of one update."""
    return setting_of(run, 1)


@pytest.mark.slow
def test_a_motion_model_starts_from_a_draft_with_weights_of_its_own(trained):
    run = trained
    draft, last = (
        load_config(run.record.folder / "motion_2" / where / "checkpoints")
        for where in ("draft", "")
    )
    assert draft["model"] | smgdiff_training.DRAFT == draft["model"]
    assert draft["model"] != last["model"] == dataclasses.asdict(run.model.config)
    assert latest_step(run.record.folder / "motion_2" / "draft" / "checkpoints") == 2
    assert not (run.record.folder / "paths_1" / "draft").exists()


def test_pieces_of_one_recording_stay_together():
    data = ball_walker.clips(40)
    # Pieces, their mirror images, and a ball drawn anew.
    kinds = ("@{}+40", "_mirrored@{}+40#2", "", "_mirrored#3")
    names = tuple(f"take{i // 2}" + kinds[i % 4].format(i) for i in range(8))
    data = dataclasses.replace(
        data, clips=dataclasses.replace(data.clips, clip_names=names)
    )
    parts = smgdiff_data.split(data, fraction=0.5, seed=3)
    takes = [{n[:5] for n in part.clips.clip_names} for part in parts]
    assert not takes[0] & takes[1] and len(takes[0] | takes[1]) == 4
    for part in parts:
        assert set(np.asarray(part.clips.labels["skill"])) == {0, 1}
        assert part.position.shape[0] == part.clips.num_frames


@pytest.mark.parametrize("fraction", [0.0, 1.0, -0.1])
def test_fractions_out_of_range_are_refused(fraction):
    with pytest.raises(ValueError, match="between 0 and 1"):
        smgdiff_data.split(ball_walker.clips(40), fraction=fraction)


def test_windows_are_of_one_clip_and_have_its_skill():
    data = ball_walker.clips(40)
    arrays = smgdiff_data.scene_arrays(data, 16)
    scenes, labels = smgdiff_data.sample_scenes(jax.random.key(0), arrays, batch=32)
    away = np.linalg.norm(
        np.asarray(scenes.ball - scenes.motion.root_position)[..., ::2], axis=-1
    )
    assert set(np.asarray(labels)) == {0, 1}
    np.testing.assert_array_equal((away > 5).all(axis=1), np.asarray(labels) == 1)
    np.testing.assert_array_equal((away > 5).any(axis=1), np.asarray(labels) == 1)


def test_a_run_comes_back_from_its_folder(run):
    assert run.model.labels == ("dribble", "off_ball")
    assert run.model.config.num_features == 30 + 3 + 7 + 2 + 2
    # Two speeds of the walker, as often: the median lies between.
    assert all(0.6 < speed < 1.5 for speed in run.model.speeds)
    lowest = clips.toe_height(run.train.clips)
    assert run.model.toe_height == pytest.approx(lowest, abs=1e-6)


@pytest.mark.slow
def test_a_stage_comes_back_from_its_folder(trained):
    model, params = smgdiff_training.load_stage(trained, "motion_2")
    assert model.config.num_steps == 2
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(params))


def test_another_model_does_not_go_into_the_same_folder(run):
    data = run.record.folder.parent / "clips.npz"
    for change, message in (
        (dict(sizes=SIZES | dict(width=32)), "sizes.width is 16, given 32"),
        (dict(paths=PATHS | dict(depth=2)), "paths.depth is 1, given 2"),
        (dict(held_out=0.4), "held_out is 0.3, given 0.4"),
    ):
        given = dict(held_out=0.3, sizes=SIZES, paths=PATHS) | change
        with pytest.raises(ValueError, match=f"made otherwise: {message}"):
            smgdiff_training.prepare(run.record.folder, data, **given)


def test_training_goes_on_from_an_exported_model(run, tmp_path):
    """With the file's units and parameters, and a seam of its own."""
    file, folder = tmp_path / "first.npz", tmp_path / "run"
    shifted = run.model.representation.normalizer
    shifted = dataclasses.replace(shifted, mean=shifted.mean + 1.0)
    first = dataclasses.replace(
        run.model,
        representation=dataclasses.replace(
            run.model.representation, normalizer=shifted
        ),
        starts=None,
    )
    params = {
        "motion": tiny.random_params(smgdiff_model.init, first.config),
        "paths": tiny.random_params(smgdiff_trajectory.init, first.paths),
    }
    checkpoint.export_params(file, params, smgdiff_model.to_json(first))
    sizes = SIZES | dict(seam_half_life=5.0, weight_foot=9.0, cubic_wishes=0.5)
    data = run.record.folder.parent / "clips.npz"
    common = dict(held_out=0.3, paths=PATHS)
    made = smgdiff_training.prepare(folder, data, sizes=sizes, init=file, **common)
    found = made.model.representation.normalizer
    np.testing.assert_allclose(found.mean, shifted.mean, rtol=1e-6)
    assert made.model.config.seam_half_life == 5.0
    still = dataclasses.replace(BUDGET, steps=1, learning_rate=1e-12, ema=0.5)
    smgdiff_training.train_stage(
        made, "motion_2", budget=still, draft_steps=2, init=file
    )
    assert latest_step(made.record.checkpoints("motion_2/draft")) is None
    _, trained = smgdiff_training.load_stage(made, "motion_2")
    jax.tree.map(
        lambda x, y: np.testing.assert_allclose(x, np.float16(y), atol=1e-3),
        trained,
        params["motion"],
    )
    with pytest.raises(ValueError, match="config.width is 16, given 32"):
        smgdiff_training.prepare(
            tmp_path / "other", data, sizes=sizes | dict(width=32), init=file, **common
        )


def test_a_balanced_stage_learns_from_other_windows(run, tmp_path):
    found = {}
    for power in (0.0, 1.0):
        own = smgdiff_training.prepare(
            tmp_path / str(power),
            run.record.folder.parent / "clips.npz",
            held_out=0.3,
            sizes=SIZES,
            paths=PATHS,
        )
        smgdiff_training.train_stage(own, "paths_1", budget=BUDGET, balance=power)
        found[power] = smgdiff_training.load_stage(own, "paths_1")[1]
    gaps = jax.tree.map(lambda x, y: np.abs(x - y).max(), *found.values())
    assert max(jax.tree.leaves(gaps)) > 1e-6
    with pytest.raises(ValueError, match="other settings"):
        smgdiff_training.train_stage(own, "paths_1", budget=BUDGET, balance=0.5)


def test_a_model_takes_the_paths_of_another_run(run, tmp_path):
    """Those of most steps."""
    data = run.record.folder.parent / "clips.npz"
    make = functools.partial(smgdiff_training.prepare, data=data, held_out=0.3)
    paths = PATHS | {"noise": "bridge"}
    other = make(tmp_path / "other", sizes=SIZES, paths=paths)
    assert other.model.paths.seconds == 12 / 30
    for stage in ("paths_1", "paths_2"):
        smgdiff_training.train_stage(other, stage, budget=BUDGET)
    given = {"motion": jnp.zeros(1), "paths": jnp.zeros(1)}
    model, params = smgdiff_training.with_paths(given, run.model, other)
    assert (model.paths.num_steps, model.paths.noise) == (2, "bridge")
    assert params["motion"] is given["motion"] and model.config == run.model.config
    wanted = smgdiff_training.load_stage(other, "paths_2")[1]
    jax.tree.map(np.testing.assert_array_equal, params["paths"], wanted)
    long = make(tmp_path / "long", sizes=SIZES | dict(future=14), paths=paths)
    with pytest.raises(CheckpointError):
        smgdiff_training.with_paths(given, run.model, long)
    smgdiff_training.train_stage(long, "paths_1", budget=BUDGET)
    with pytest.raises(ValueError, match=r"long: skills, frames and rate are .* 14"):
        smgdiff_training.with_paths(given, run.model, long)


def test_stages_are_named_by_kind_and_steps(run):
    assert smgdiff_training.with_steps(run.model, "paths_3").paths.num_steps == 3
    for name in ("motion", "motion_0", "motion_x", "dance_8"):
        with pytest.raises(ValueError, match="unknown stage"):
            smgdiff_training.with_steps(run.model, name)
    with pytest.raises(CheckpointError):
        smgdiff_training.load_stage(run, "motion_5")


def test_situations_hold_what_was_and_what_came(run):
    model = run.model
    known = smgdiff_scoring.eval_windows(run.held_out, model, number=10, seed=0)
    assert known.future.ball.shape[1:] == (12, 3) and known.past.ball.shape[1:] == (
        4,
        3,
    )
    last = known.past.motion.root_position[:, -1, ::2]
    np.testing.assert_allclose(last, 0.0, atol=1e-5)
    # The smoothed path begins where the person is.
    start = np.linalg.norm(known.condition.trajectory.position[:, 0], axis=-1)
    assert (start < 0.1).all()
    with pytest.raises(ValueError, match="expected 4"):
        smgdiff_scoring.eval_windows(run.held_out, model, number=2, seed=0)
    names = run.held_out.clips.clip_names
    assert set(np.asarray(known.piece)) <= set(range(len(names)))


def test_halves_take_pieces_of_recordings_whole():
    pieces = np.random.default_rng(1).integers(30, size=200)
    found = smgdiff_evaluation.halves(pieces, number=4, seed=0)
    assert len({tuple(sorted(half)) for half in found}) == 4
    for half in found:
        assert half.size == len({*half}) == 100
        inside = np.isin(np.arange(200), half)
        parted = [p for p in range(30) if len({*inside[pieces == p]}) > 1]
        assert len(parted) <= 1
        # Not one piece after the other: the first few are of several.
        assert len({*pieces[half[:10]]}) > 4


def test_images_and_other_balls_are_of_one_piece(run):
    names = ("a@10+200", "a_mirrored@0+150", "b@0+99#2", "b_mirrored@160+99#3", "c#2")
    clips = dataclasses.replace(
        run.train.clips,
        clip_names=names,
        offsets=jnp.array([0, 200, 350, 449, 548, 600]),
        fps=30.0,
    )
    data = dataclasses.replace(run.train, clips=clips)
    # a's frames 10, 149, 150, 0 and 149; b's frames 0, 160 and 258; c's first.
    owner = np.array([0, 0, 0, 1, 1, 2, 3, 3, 4])
    start = np.array([0, 139, 140, 200, 349, 350, 449, 547, 548])
    found = smgdiff_data.pieces(data, owner, start)
    assert found.tolist() == [0, 0, 1, 0, 0, 2, 3, 3, 4]


@pytest.mark.slow
def test_what_really_happened_scores_well(run):
    scores = smgdiff_evaluation.score_real(setting_of(run, 40))
    assert len(scores) == 3
    for one in scores:
        assert float(one["ball_in_ground"]) == pytest.approx(0.0, abs=1e-3)
        assert float(one["trajectory_error"]) < 20
        assert float(one["skill_accuracy"]) > 0.9  # a ball at hand, or far away


def test_what_is_spoiled_is_farther_from_what_happened(setting):
    """Limbs that stand still, and the ball of somebody else."""
    future = setting.known.future
    joints = future.motion.joint_rotation
    frozen = jnp.broadcast_to(joints[:, :1], joints.shape)
    motion = dataclasses.replace(future.motion, joint_rotation=frozen)
    away = future.ball - future.motion.root_position
    ball = future.motion.root_position + jnp.roll(away, 1, axis=0)
    spoiled = [
        future,
        dataclasses.replace(future, motion=motion),
        dataclasses.replace(future, ball=ball),
    ]
    wanted, label = setting.known.condition.trajectory, setting.known.label
    found = [float(setting.score(x, wanted, label)["fid_held_out"]) for x in spoiled]
    assert found[0] == pytest.approx(0.0, abs=1e-3 * min(found[1:]))


def test_planted_errors_are_measured(setting):
    """The ball sunk by 13 mm; the person moved to the side."""

    def sunk(scene):
        return dataclasses.replace(scene, ball=scene.ball.at[..., 1].add(-0.013))

    score = setting.score
    known = setting.known
    wanted = known.condition.trajectory
    found = score(sunk(known.future), wanted, known.label)
    assert float(found["ball_in_ground"]) == pytest.approx(13.0, abs=1e-3)
    plain = score(known.future, wanted, known.label)
    # Nobody touches a ball that rests: no part of no touches, rather than the best.
    rests = dataclasses.replace(known.future, ball=jnp.ones_like(known.future.ball))
    resting = score(rests, wanted, known.label)
    assert float(resting["touches"]) == float(resting["missed"]) == 0.0
    assert np.isnan([resting["missed_part"], resting["touch_distance"]]).all()
    assert float(found["foot_slide"]) == float(plain["foot_slide"])
    wrong = score(known.future, wanted, 1 - known.label)
    total = float(wrong["skill_accuracy"]) + float(plain["skill_accuracy"])
    assert total == pytest.approx(1.0, abs=1e-5)


@pytest.mark.slow
def test_plans_are_scored_alike_whatever_the_chunk(trained, setting):
    model, params = smgdiff_training.load_stage(trained, "motion_2")
    plan = smgdiff_guidance.sampler(
        params,
        config=model.config,
        representation=model.representation,
        guided=UNGUIDED,
    )
    found = [
        smgdiff_evaluation.score_plans(
            setting, smgdiff_evaluation.plan_many(plan, model, chunk=chunk)
        )
        for chunk in (1, 3)
    ]
    for a, b in zip(*found, strict=True):
        assert float(a["fid"]) == pytest.approx(float(b["fid"]), rel=1e-3)
    assert all(np.isfinite(float(v)) for v in found[0][0].values())


@pytest.mark.slow
def test_players_are_scored_with_their_spread(trained, setting):
    model, params = smgdiff_training.load_stage(trained, "motion_2")
    plan = smgdiff_guidance.sampler(
        params,
        config=model.config,
        representation=model.representation,
        guided=UNGUIDED,
    )
    play = smgdiff_players.player(
        smgdiff_players.straight(model),
        plan,
        model,
        ticks=24,
        repeats=2,
        chunk=2,
        control=smgdiff_controller.Control(apply=5, reuse=4),
    )
    scores = smgdiff_players.score_players(setting, model, play, repeats=2, starts=2)
    assert len(scores) == 3 and float(scores[0]["pose_variance"]) > 0


def test_a_straight_path_owes_nothing_to_noise(run, setting):
    model = run.model
    found = smgdiff_players.path_spread(
        jax.random.key(0),
        smgdiff_players.straight(model),
        setting.known,
        setting.known,
        model,
        repeats=3,
    )
    np.testing.assert_allclose(found["generated"], 0.0, atol=1e-4)
    end = setting.known.future.motion.root_position[..., ::2]
    part = jnp.arange(1, end.shape[1] + 1)[:, None] / end.shape[1]
    away = jnp.linalg.norm(part[None] * end[:, -1:] - end, axis=-1)
    np.testing.assert_allclose(
        found["energy"], 100 * away.mean(0), rtol=1e-3, atol=1e-3
    )
    error = 100 * jnp.sqrt(jnp.mean(away**2, axis=0))
    np.testing.assert_allclose(found["error"], error, rtol=1e-3, atol=1e-3)
    assert found["recorded"].shape == (model.config.future,)
    assert float(found["recorded"][-1]) > 0.0


def test_paths_of_noise_alone_vary_by_their_noise(run, setting):
    model, shape = run.model, (run.model.config.future, 2)

    def generate(key, wish):
        place = 0.1 * jax.random.normal(key, shape)
        return trajectory.Trajectory(position=place, facing=jnp.ones(shape))

    found = smgdiff_players.path_spread(
        jax.random.key(0), generate, setting.known, setting.known, model, repeats=8
    )
    # 10 cm in each of two directions, draws 10 sqrt(pi) cm apart.
    real = np.asarray(setting.known.future.motion.root_position)[..., ::2]
    drawn = 0.1 * np.random.default_rng(0).normal(size=(500, *real.shape))
    away = np.linalg.norm(drawn - real, axis=-1).mean((0, 1))
    energy = 100 * (away - 0.05 * np.sqrt(np.pi))
    assert float(jnp.mean(found["energy"])) == pytest.approx(energy.mean(), rel=0.05)
    assert float(jnp.mean(found["generated"])) == pytest.approx(14.1, rel=0.05)


def test_the_evaluator_sees_the_ball_no_farther_than_the_reach(run):
    representation = run.model.representation
    scene = ball_walker.scene(12, speed=1.0)
    far = dataclasses.replace(scene, ball=scene.ball.at[..., 0].add(30.0))
    near, away = (
        np.asarray(smgdiff_scoring.evaluator_input(x, representation))
        for x in (scene, far)
    )
    np.testing.assert_allclose(near[:, :15], away[:, :15], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(away[:, 15:], axis=-1), 2.0, rtol=1e-5)
    assert tiny.skeleton().num_joints * 3 == 15
