"""Pictures compared with those of gym-pusht."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pushjax.tasks.render import render

# The outline's vertices among the corners of gym-pusht's two rectangles, and the line between the rectangles.
OUTLINE = [0, 1, 2, 5, 6, 7, 4, 3]
SEAMS = ((3, 6),)
GOAL_COLOR, BLOCK_COLOR, AGENT_COLOR = (144, 238, 144), (143, 163, 184), (78, 126, 255)


@pytest.fixture(scope="module")
def scenes():
    """Return vertices, agents, the goal, gym-pusht's pixels of 30 states, and one of its large pictures."""
    gym = pytest.importorskip("gymnasium")
    pytest.importorskip("gym_pusht")
    env = gym.make("gym_pusht/PushT-v0", obs_type="pixels").unwrapped
    vertices, agents, pixels = [], [], []
    for seed in range(30):
        env.reset(seed=seed)
        pixels.append(env.step(np.array([200.0 + 5 * seed, 300.0]))[0])
        vertices.append(env.get_keypoints(env._block_shapes)[OUTLINE])
        agents.append(env.agent.position)
    goal = env.get_goal_pose_body(env.goal_pose)
    corners = [goal.local_to_world(v) for shape in env._block_shapes for v in shape.get_vertices()]
    return np.array(vertices), np.array(agents), np.array(corners)[OUTLINE], np.array(pixels), env.render()


@pytest.fixture(scope="module")
def drawn(scenes):
    vertices, agents, goal, _, _ = scenes
    draw = jax.jit(jax.vmap(lambda v, a: render(v, goal.astype(np.float32), a, seams=SEAMS)))
    return np.asarray(draw(vertices.astype(np.float32), agents.astype(np.float32)))


def near(pictures, color, tolerance=50):
    return np.all(np.abs(pictures.astype(int) - np.array(color)) < tolerance, axis=-1)


def test_pixels_are_those_of_gym_pusht(scenes, drawn):
    pixels = scenes[3]
    assert drawn.dtype == pixels.dtype
    assert drawn.shape == pixels.shape
    difference = np.abs(drawn.astype(int) - pixels)
    # What differs lies on outlines: gym-pusht rounds corners to whole pixels of its workspace.
    assert difference.mean() < 0.4
    assert np.mean(difference.max(axis=-1) > 40) < 0.004


@pytest.mark.parametrize(("color", "least"), [(GOAL_COLOR, 0.97), (BLOCK_COLOR, 0.95), (AGENT_COLOR, 0.85)])
def test_areas_of_each_color_are_those_of_gym_pusht(scenes, drawn, color, least):
    ours, theirs = near(drawn, color), near(scenes[3], color)
    assert np.sum(ours & theirs) / np.sum(ours | theirs) > least


def test_large_picture_with_action(scenes):
    vertices, agents, goal, _, expected = scenes
    picture = render(vertices[-1], goal, agents[-1], np.array([200.0 + 5 * 29, 300.0]), size=680, seams=SEAMS)
    difference = np.abs(np.asarray(picture).astype(int) - expected)
    assert difference.mean() < 0.5
    ours, theirs = near(np.asarray(picture), (255, 0, 0)), near(expected, (255, 0, 0))
    assert np.sum(ours & theirs) / np.sum(ours | theirs) > 0.8


def test_areas_are_those_of_the_shapes():
    triangle = jnp.array([[100.0, 100.0], [100.0, 300.0], [300.0, 100.0]])  # clockwise on a page with y down
    ring = jnp.array([[300.0, 400.0], [450.0, 400.0], [450.0, 450.0], [300.0, 450.0]])
    picture = np.asarray(render(ring, triangle, jnp.array([250.0, 350.0]), size=512))
    np.testing.assert_allclose(near(picture, GOAL_COLOR, 1).sum(), 200 * 200 / 2, rtol=0.02)
    np.testing.assert_allclose(near(picture, BLOCK_COLOR, 1).sum(), 145 * 45, rtol=0.02)
    np.testing.assert_allclose(near(picture, AGENT_COLOR, 1).sum(), np.pi * 11**2, rtol=0.1)
    row, column = 120, 110
    assert tuple(picture[row, column]) == GOAL_COLOR
    assert tuple(picture[425, 375]) == BLOCK_COLOR
    assert tuple(picture[400, 100]) == (255, 255, 255)
    assert tuple(picture[256, 5]) == (211, 211, 211)


def test_invalid_arguments():
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    with pytest.raises(ValueError, match="size must be a whole number, at least 1; got 0"):
        render(square, square, np.zeros(2), size=0)
    with pytest.raises(ValueError, match=r"action has shape \(3,\); expected \(2,\)"):
        render(square, square, np.zeros(2), np.zeros(3))
