"""The push as MuJoCo sees it: what is simulated (`Scene`), how (`Settings`), and the model that both make.

The push is planar, and so that it stays so the tip touches the slider at the height of the table: a push above it would
shift load from one support to another. Contacts are given as pairs (the tip and the slider, each support and the
table): nothing else collides, and friction is the pair's own, not the larger of two geoms'.

What the settings do, found on eight pushes that stick and slide, three supports and four, against the exact Coulomb
answer (`coulomb`):

- cone "elliptic". A pyramid has 1.4 times more friction along its diagonals than along its axes: 3.7 mm off at any
  step.
- A sliding contact of MuJoCo dilates: its normal force is D (μ b s − b v_n − k r), where s is the speed of sliding, b =
  2 / (d t) the damping of its time constant t, and D = d / ((1 − d) A) with the impedance d and the inverse inertia A.
  If μ b s alone carries more than the load, the support loses the table, lands, and hops on: of MuJoCo's own setting
  (elliptic, one time constant of 0.02 s) 2.8 mm at 20 mm/s, and more with smaller time constants or steps. So sliding
  has a time constant of its own (`solreffriction`), several times as long as the normal one, and the speed is low.
- A sticking contact creeps with R f / b: long time constants creep. `impratio` makes R smaller and costs nothing. The
  tip's own time constant of sliding is shorter than the supports', since it sticks or slides slowly.
- The normal time constant says how far the tip sinks in: as short as the step allows. Impedances from 0.65 to 0.93 do
  about as well; near 1 the supports are stiff enough to hop. Constant, so that stiffness does not depend on depth.
- integrator "discrete" (3.13 and later) treats contacts implicitly: the time constant may be one step, where that of
  the others is at least two. Best at few steps; at many "implicitfast" does as well.
- solver "CG", tolerance 1e-6: as exact as "Newton" and 10 to 25 % faster (5.5 to 6 µs a step); "PGS" takes twice as
  long. Looser tolerances add 0.05 mm and more, and "implicitfast" cannot bear them at all (1e-4: millimetres).
- noslip iterations remove little creep at small steps (9 to 4 µm) and disturb the answer at large ones (0.17 mm).
- The table is a conveyor (`surfacevel`, 3.11 and later) and the tip stands still, so that there are six degrees of
  freedom.

The speed is a compromise: a slower tip leaves less inertia and dilation, but more time to creep. At a tenth of it the
final poses differ by 0.19 mm at most. Time constants are in seconds, so that smaller steps converge. Length, time and
gravity scale: a push of half the speed under a quarter of gravity in twice the timestep is the same computation.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

FOOT = 0.01  # radius of a support's sphere, m: it slides, so the size does not matter
HALF_HEIGHT = 0.01
GRAVITY = 9.81
# Of a tip that has a joint: three newtons slow it by 0.2 % within 5 ms, and after each step it is put right (`mjx`). A
# tip of a million tons left alone would coast, but the solver's tolerance is relative to all the inertia there is.
TIP_MASS = 1e3


@dataclass(frozen=True)
class Scene:
    """What is pushed: a slider on point supports, by a round tip. m, kg, m/s; the slider's body frame.

    supports: where the table carries it; of three the loads follow from statics, of more from equal stiffness.
    outline: (vertices) of a convex polygon about the centre of mass; a square of `side` unless given.
    travel: of the pushes of `mujoco.fan`. speed: the tip's.

    Raises ValueError for fewer than three supports or anything not positive.
    """

    supports: tuple[tuple[float, float], ...]
    side: float = 0.09
    outline: tuple[tuple[float, float], ...] = ()
    tip_radius: float = 0.00475
    friction_tip: float = 0.25
    friction_table: float = 0.3
    mass: float = 1.0
    speed: float = 0.007
    travel: float = 0.05

    def __post_init__(self):
        if len(self.supports) < 3:
            raise ValueError(f"supports must be at least three points; got {len(self.supports)}")
        for name in ("side", "tip_radius", "friction_table", "mass", "speed", "travel"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive; got {getattr(self, name)}")

    @property
    def vertices(self) -> np.ndarray:
        """(vertices, 2) m, body frame."""
        half = self.side / 2
        return np.array(self.outline or ((-half, -half), (half, -half), (half, half), (-half, half)), float)


@dataclass(frozen=True)
class Settings:
    """How MuJoCo computes it; the module header says why these.

    normal, sliding, tip_sliding: time constants (s) of normal contact, of the supports' friction and of the tip's; a
    friction's is as `normal` where it is 0. impedance: its least and greatest value (solimp).
    """

    cone: str = "elliptic"
    solver: str = "CG"
    integrator: str = "discrete"
    impratio: float = 170.0
    normal: float = 0.010
    sliding: float = 0.050
    tip_sliding: float = 0.013
    impedance: tuple[float, float] = (0.86, 0.86)
    iterations: int = 100
    line_search: int = 50
    tolerance: float = 1e-6
    noslip: int = 0


def engine() -> Any:
    """The package mujoco. Raises ValueError without it."""
    try:
        import mujoco
    except ImportError as missing:
        raise ValueError("--peers needs the extra: pip install '.[bench]'") from missing
    return mujoco


def build(scene: Scene, settings: Settings, timestep: float, conveyor: bool = True) -> Any:
    """The MjModel. Its world has x along the push, and the tip's centre at the origin when the push begins.

    timestep: s. conveyor: the table moves under a tip that stands still; else the tip has a joint of its own.
    qpos: the slider's free joint (7), and how far the tip has come if it has a joint.
    """
    mujoco = engine()
    table = f'surfacevel="{-scene.speed:.9g} 0 0"' if conveyor else ""
    joint = '<joint type="slide" axis="1 0 0"/>' if not conveyor else ""
    body, mesh = slider_body(scene)
    tip = pair("tip", "slider", scene.friction_tip, settings.normal, settings.tip_sliding, settings.impedance)
    text = f"""<mujoco>
      {options(settings, timestep)}
      <asset>{mesh}</asset>
      <default><geom contype="0" conaffinity="0" mass="0"/></default>
      <worldbody>
        <geom name="table" type="plane" size="1 1 .1" {table}/>
        {body}
        <body name="tip">{joint}<inertial mass="{TIP_MASS}" pos="0 0 0" diaginertia="1 1 1"/>
          <geom name="tip" type="sphere" size="{scene.tip_radius}"/>
        </body>
      </worldbody>
      <contact>{supported(scene, settings)}{tip}</contact>
    </mujoco>"""
    return mujoco.MjModel.from_xml_string(text)


def _slider(scene: Scene) -> tuple[str, str]:
    """The slider's geom, and the mesh that it needs. A box is quicker, and MJX has it exactly."""
    if not scene.outline:
        return f'type="box" size="{scene.side / 2} {scene.side / 2} {HALF_HEIGHT}"', ""
    corners = " ".join(f"{x} {y} {z}" for x, y in scene.vertices for z in (-HALF_HEIGHT, HALF_HEIGHT))
    return 'type="mesh" mesh="slider"', f'<mesh name="slider" vertex="{corners}"/>'


def feet(scene: Scene) -> str:
    """Spheres under the slider, one a support."""
    each = enumerate(scene.supports)
    return "".join(f'<geom name="foot{k}" type="sphere" size="{FOOT}" pos="{x} {y} {FOOT}"/>' for k, (x, y) in each)


def pair(one: str, other: str, friction: float, normal: float, sliding: float, impedance: tuple[float, float]) -> str:
    """A contact of two geoms: time constants (s) of its normal and of its friction, which has the normal's if 0."""
    rest = f'solreffriction="{sliding} 1"' if sliding else ""
    return (
        f'<pair geom1="{one}" geom2="{other}" condim="3" friction="{friction} {friction} 0 0 0" '
        f'solref="{normal} 1" solimp="{impedance[0]} {impedance[1]} 0.001 0.5 2" {rest}/>'
    )


def supported(scene: Scene, settings: Settings) -> str:
    """The contacts of table and feet."""
    of = scene.friction_table, settings.normal, settings.sliding, settings.impedance
    return "".join(pair("table", f"foot{k}", *of) for k in range(len(scene.supports)))


def options(settings: Settings, timestep: float) -> str:
    return (
        f'<option timestep="{timestep:.12g}" integrator="{settings.integrator}" cone="{settings.cone}" '
        f'jacobian="dense" solver="{settings.solver}" iterations="{settings.iterations}" '
        f'tolerance="{settings.tolerance}" ls_iterations="{settings.line_search}" '
        f'noslip_iterations="{settings.noslip}" impratio="{settings.impratio}" gravity="0 0 {-GRAVITY}"/>'
    )


def slider_body(scene: Scene) -> tuple[str, str]:
    """The slider on its feet, free, and the mesh that it needs."""
    inertia = scene.mass * np.mean(np.sum(scene.vertices**2, axis=1)) / 3
    shape, mesh = _slider(scene)
    body = f"""<body name="slider"><freejoint/>
          <inertial mass="{scene.mass}" pos="0 0 0" diaginertia="{inertia / 2} {inertia / 2} {inertia}"/>
          <geom name="slider" {shape}/>{feet(scene)}
        </body>"""
    return body, mesh
