"""Pictures of a block, its goal and what pushes it, in the colors and the layout of gym-pusht.

The color of a pixel depends on the signed distances of its center from the edges of what is drawn. Across an edge the
color changes over one pixel of the workspace. So it does in gym-pusht, which draws the workspace with hard edges and
then resizes the picture with linear interpolation.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt8

from pushjax._internal.checks import ArrayLike, as_float, check_count, check_shape, common_dtype
from pushjax._internal.jit import quick_jit
from pushjax.simulation.fixtures import Wall
from pushjax.simulation.hand import Hand, RoundFinger
from pushjax.tasks.shared import placed

WORKSPACE = 512.0  # side of the drawn square, px
WALL_LOW, WALL_HIGH = 5.0, 506.0  # center lines of the walls, px
# Half the width of walls and of the outline of the block, px. In `render_table` the border of a round finger, which
# lies inside its circle, has this width.
LINE_HALF_WIDTH = 2.5
AGENT_RADIUS, AGENT_FILL_RADIUS = 15.0, 11.0  # px
MARKER_ARM, MARKER_HALF_WIDTH = 21.0, 3.4  # of the cross at the action, px

Color = tuple[float, float, float]
WHITE: Color = (255, 255, 255)
LIGHT_GREEN: Color = (144, 238, 144)
LIGHT_GRAY: Color = (211, 211, 211)
ROYAL_BLUE: Color = (65, 105, 225)
ROYAL_BLUE_FILL: Color = (78, 126, 255)
LIGHT_SLATE_GRAY: Color = (119, 136, 153)
LIGHT_SLATE_GRAY_FILL: Color = (143, 163, 184)
BURLY_WOOD: Color = (190, 155, 110)
BURLY_WOOD_FILL: Color = (222, 184, 135)
RED: Color = (255, 0, 0)


def render(
    vertices: ArrayLike,
    goal_vertices: ArrayLike,
    agent: ArrayLike,
    action: ArrayLike | None = None,
    *,
    size: int = 96,
    seams: tuple[tuple[int, int], ...] = (),
) -> UInt8[Array, "size size 3"]:
    """Draw the workspace of PushT, 512 x 512 px, with x to the right and y down.

    Pictures of a batch come from `vmap`.

    Args:
        vertices: Vertices of the block, shape (vertices, 2), px, a simple polygon.
        goal_vertices: Vertices of the goal, shape (goal_vertices, 2), px, a simple polygon.
        agent: Center of the agent, shape (2,), px.
        action: Where to draw a red cross, shape (2,), px. None: no cross.
        size: Width and height of the picture in pixels.
        seams: Pairs of indices of vertices, between which a line is drawn like the outline. gym-pusht draws its block
            as two rectangles, with a line between them.

    Returns:
        The picture, shape (size, size, 3), RGB, rows from the top.

    Raises:
        ValueError: If an array has another shape, or `size` is not a whole number of at least one.
        TypeError: If an array does not consist of real numbers.
    """
    check_count("size", size)
    dtype = common_dtype(vertices, goal_vertices, agent)
    outlines, points = [], []
    for name, value in (("vertices", vertices), ("goal_vertices", goal_vertices)):
        outlines.append(as_float(value, dtype, name))
        check_shape(name, outlines[-1], (name, 2))
    for name, value in (("agent", agent), ("action", action)):
        points.append(None if value is None else as_float(value, dtype, name))
        if points[-1] is not None:
            check_shape(name, points[-1], (2,))
    return _render(outlines[0], outlines[1], points[0], points[1], size, seams)


@quick_jit
def _render(
    vertices: Array, goal: Array, agent: Array, action: Array | None, size: int, seams: tuple[tuple[int, int], ...]
) -> Array:
    pixels = _Pixels.of(size, vertices.dtype)
    picture = _Picture.blank(size, vertices.dtype).polygon(pixels, goal, LIGHT_GREEN)
    picture = picture.layer(LIGHT_GRAY, LINE_HALF_WIDTH - pixels.from_walls())
    from_agent = jnp.hypot(pixels.x - agent[0], pixels.y - agent[1])
    picture = picture.layer(ROYAL_BLUE, AGENT_RADIUS - from_agent)
    picture = picture.layer(ROYAL_BLUE_FILL, AGENT_FILL_RADIUS - from_agent)
    inside, from_line = _outline(pixels, vertices, seams)
    picture = picture.layer(LIGHT_SLATE_GRAY_FILL, jnp.where(inside, 1.0, -1.0))
    picture = picture.layer(LIGHT_SLATE_GRAY, LINE_HALF_WIDTH - from_line)
    if action is not None:
        x, y = action[0], action[1]
        across = _squared_distance(pixels, (x - MARKER_ARM, y), (x + MARKER_ARM, y))
        along = _squared_distance(pixels, (x, y - MARKER_ARM), (x, y + MARKER_ARM))
        picture = picture.layer(RED, MARKER_HALF_WIDTH - jnp.sqrt(jnp.minimum(across, along)))
    return picture.rgb()


@quick_jit
def render_table(
    vertices: Float[Array, "vertices 2"],  # of the block, m
    goal: Float[Array, "goal_vertices 2"],  # its vertices at the goal, m; none for no goal
    hand: Hand,
    configuration: Float[Array, "dof"],  # of the hand, m and rad
    walls: tuple[Wall, ...],  # what is behind them is drawn gray
    width: float,  # width and height of the part of the table that is drawn, m
    size: int,  # width and height of the picture in pixels
    others: tuple[Float[Array, "vertices 2"], ...] = (),  # vertices of other blocks, m
) -> UInt8[Array, "size size 3"]:
    """Draw a table from above in RGB, rows from the top, with x to the right, y up and the origin in the middle."""
    pixels, scale = _Pixels.of(size, vertices.dtype), WORKSPACE / width

    def drawn(points: Array) -> Array:
        return WORKSPACE / 2 + scale * points * jnp.array([[1.0, -1.0]], points.dtype)

    picture = _Picture.blank(size, vertices.dtype)
    if len(goal):
        picture = picture.polygon(pixels, drawn(goal), LIGHT_GREEN)
    for wall in walls:
        along, into = width * jnp.array([-wall.normal[1], wall.normal[0]]), -width * wall.normal
        behind = jnp.stack([along, -along, into - along, into + along]) + wall.point[None]
        picture = picture.polygon(pixels, drawn(behind), LIGHT_GRAY)
    for other in others:
        picture = picture.polygon(pixels, drawn(other), BURLY_WOOD_FILL, BURLY_WOOD)
    picture = picture.polygon(pixels, drawn(vertices), LIGHT_SLATE_GRAY_FILL, LIGHT_SLATE_GRAY)
    for finger, pose in zip(hand.fingers, hand.poses(configuration[None])[0], strict=True):
        if isinstance(finger, RoundFinger):
            x, y = drawn(pose[None, :2])[0]
            depth = scale * finger.radius - jnp.hypot(pixels.x - x, pixels.y - y)
            picture = picture.layer(ROYAL_BLUE, depth).layer(ROYAL_BLUE_FILL, depth - LINE_HALF_WIDTH)
        else:
            picture = picture.polygon(pixels, drawn(placed(finger.shape.vertices, pose)), ROYAL_BLUE_FILL, ROYAL_BLUE)
    return picture.rgb()


class _Pixels(NamedTuple):
    """Centers of all pixels in the workspace, px."""

    x: Float[Array, "1 size"]
    y: Float[Array, "size 1"]

    @staticmethod
    def of(size: int, dtype: jnp.dtype) -> "_Pixels":
        # In gym-pusht a point of the workspace is the center of a pixel of its picture, not the corner of one.
        center = (jnp.arange(size, dtype=dtype) + 0.5) * (WORKSPACE / size) - 0.5
        return _Pixels(center[None, :], center[:, None])

    def from_walls(self) -> Array:
        """Return the distance from the center lines of the walls, shape (size, size), px."""
        middle, half = (WALL_HIGH + WALL_LOW) / 2, (WALL_HIGH - WALL_LOW) / 2
        return jnp.abs(jnp.maximum(jnp.abs(self.x - middle), jnp.abs(self.y - middle)) - half)


def _outline(
    pixels: _Pixels,
    vertices: Float[Array, "vertices 2"],  # px
    seams: tuple[tuple[int, int], ...] = (),  # pairs of vertices with a line between them
) -> tuple[Bool[Array, "size size"], Float[Array, "size size"]]:
    """Return which pixels are inside a polygon, and the distance of each from the nearest edge or seam, px."""
    corners = [(vertex[0], vertex[1]) for vertex in vertices]
    edges = list(zip(corners, corners[1:] + corners[:1], strict=True))
    inside, squared = jnp.zeros((), bool), jnp.asarray(jnp.inf, vertices.dtype)
    for start, end in edges + [(corners[i], corners[j]) for i, j in seams]:
        squared = jnp.minimum(squared, _squared_distance(pixels, start, end))
    for (x, y), (next_x, next_y) in edges:
        # Does a ray toward +x cross the edge? Inside, the number of crossings is odd.
        left = ((pixels.x - x) * (next_y - y) < (pixels.y - y) * (next_x - x)) == (next_y > y)
        inside = inside ^ (left & ((y <= pixels.y) != (next_y <= pixels.y)))
    return inside, jnp.sqrt(squared)


def _squared_distance(pixels: _Pixels, start: tuple[Array, Array], end: tuple[Array, Array]) -> Array:
    """Return the squared distance of all pixels from a line segment, shape (size, size), px^2."""
    edge_x, edge_y = end[0] - start[0], end[1] - start[1]
    scale = 1 / jnp.maximum(edge_x**2 + edge_y**2, jnp.finfo(edge_x.dtype).tiny)
    x, y = pixels.x - start[0], pixels.y - start[1]
    fraction = jnp.clip(x * (edge_x * scale) + y * (edge_y * scale), 0, 1)  # along the segment, of the nearest point
    return (x - fraction * edge_x) ** 2 + (y - fraction * edge_y) ** 2


class _Picture(NamedTuple):
    """The channels of a picture, each of shape (size, size), from 0 to 255."""

    red: Array
    green: Array
    blue: Array

    @staticmethod
    def blank(size: int, dtype: jnp.dtype) -> "_Picture":
        return _Picture(*(jnp.full((size, size), channel, dtype) for channel in WHITE))

    def layer(self, color: Color, depth: Float[Array, "size size"]) -> "_Picture":
        """Draw a color on the picture."""
        # `depth` is how far inside the drawn area each pixel is, px of the workspace, negative outside.
        alpha = jnp.clip(depth + 0.5, 0, 1)
        return _Picture(*(old + (new - old) * alpha for old, new in zip(self, color, strict=True)))

    def polygon(
        self, pixels: _Pixels, vertices: Float[Array, "vertices 2"], color: Color, line: Color | None = None
    ) -> "_Picture":
        """Draw a polygon, with an outline of another color if that is given."""
        inside, from_line = _outline(pixels, vertices)
        picture = self.layer(color, jnp.where(inside, from_line, -from_line) + 0.5)
        return picture if line is None else picture.layer(line, LINE_HALF_WIDTH - from_line)

    def rgb(self) -> Array:
        """Return the picture as 8-bit integers, shape (size, size, 3)."""
        # One word for a pixel: XLA's CPU code computes it in a vectorized loop, but not a stack along a last axis.
        red, green, blue = ((channel + 0.5).astype(jnp.uint32) for channel in self)
        return jax.lax.bitcast_convert_type(red | (green << 8) | (blue << 16), jnp.uint8)[..., :3]
