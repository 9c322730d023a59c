"""The push in MuJoCo: what is simulated (`Scene`), with which settings (`Settings`), and the model built from both.

The push is planar. To keep it so, the tip touches the slider at the height of the table: a push above the table would
shift load from one support to another. Contacts are given as pairs (the tip and the slider, each support and the
table). Nothing else collides, and each pair has its own friction instead of the larger one of two geoms.

The settings were chosen on eight pushes that stick and slide, on three supports and on four, by comparison with the
exact Coulomb answer (`coulomb`).

- cone "elliptic". A pyramid has 1.4 times more friction along its diagonals than along its axes. It causes an error of
  3.7 mm at any timestep.
- A sliding contact of MuJoCo dilates. Its normal force is D (μ b s − b v_n − k r), where s is the sliding speed,
  b = 2 / (d t) is the damping for the time constant t, and D = d / ((1 − d) A) for the impedance d and the inverse
  inertia A. If μ b s alone carries more than the load, the support lifts off the table, lands, and hops on. With
  MuJoCo's default (elliptic, one time constant of 0.02 s) the error is 2.8 mm at 20 mm/s, and more with smaller time
  constants or timesteps. Therefore sliding has its own time constant (`solreffriction`), several times as long as the
  normal one, and the speed is low.
- A sticking contact creeps with R f / b, so long time constants increase the creep. `impratio` reduces R at no cost.
  The tip's time constant of sliding is shorter than that of the supports, because the tip sticks or slides slowly.
- The normal time constant determines the penetration depth of the tip. It is as short as the timestep allows.
  Impedances from 0.65 to 0.93 do about equally well; near 1 the supports are stiff enough to hop. The impedance is
  constant, so that the stiffness does not depend on the depth.
- integrator "discrete" (3.13 and later) treats contacts implicitly. The time constant may be one timestep; the other
  integrators need at least two. "discrete" is best at large timesteps; at small ones "implicitfast" does as well.
- solver "CG", tolerance 1e-6. It is as exact as "Newton" and 10 to 25 % faster (5.5 to 6 µs a step). "PGS" takes twice
  as long. Looser tolerances add 0.05 mm and more, and with "implicitfast" they fail (1e-4: errors of millimeters).
- noslip iterations reduce the creep little at small timesteps (from 9 to 4 µm) and disturb the answer at large ones
  (0.17 mm).
- The table is a conveyor (`surfacevel`, 3.11 and later) and the tip stands still, so that there are six degrees of
  freedom.

The speed is a compromise: a slower tip reduces inertia and dilation, but gives more time to creep. At a tenth of the
speed the final poses differ by 0.19 mm at most. Time constants are in seconds and do not change with the timestep, so
that smaller timesteps converge. Length, time and gravity scale: a push at half the speed, under a quarter of gravity
and with twice the timestep, is the same computation.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

FOOT = 0.01  # m; radius of a support's sphere, which slides, so that its size does not matter
HALF_HEIGHT = 0.01
GRAVITY = 9.81
# Mass of a tip that has a joint, kg. Three newtons slow it by 0.2 % within 5 ms, and its speed is reset after each step
# (`mjx`). A tip of a million tons would keep its speed without that, but the solver's tolerance is relative to the
# total inertia.
TIP_MASS = 1e3


@dataclass(frozen=True)
class Scene:
    """A slider on point supports, and the round tip that pushes it, in SI units and the slider's body frame."""

    # Loads follow from statics for three supports, and from equal stiffness for more.
    supports: tuple[tuple[float, float], ...]
    side: float = 0.09  # of the square
    tip_radius: float = 0.00475
    friction_tip: float = 0.25  # coefficient between tip and slider
    friction_table: float = 0.3  # coefficient between supports and table
    mass: float = 1.0  # of the slider
    speed: float = 0.007  # of the tip
    travel: float = 0.05  # length of the pushes of `mujoco.fan`

    def __post_init__(self):
        if len(self.supports) < 3:
            raise ValueError(f"supports must be at least three points; got {len(self.supports)}")
        for name in ("side", "tip_radius", "friction_table", "mass", "speed", "travel"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive; got {getattr(self, name)}")

    @property
    def vertices(self) -> np.ndarray:
        """Vertices of the square, counterclockwise, (4, 2), m, body frame."""
        half = self.side / 2
        return np.array(((-half, -half), (half, -half), (half, half), (-half, half)), float)


@dataclass(frozen=True)
class Settings:
    """Settings of MuJoCo; the module header gives the reasons for the defaults."""

    cone: str = "elliptic"  # type of friction cone
    solver: str = "CG"
    integrator: str = "discrete"
    impratio: float = 170.0  # ratio of frictional to normal impedance
    normal: float = 0.010  # time constant of normal contact, s
    sliding: float = 0.050  # time constant of the supports' friction, s; 0 uses `normal`
    tip_sliding: float = 0.013  # time constant of the tip's friction, s; 0 uses `normal`
    impedance: tuple[float, float] = (0.86, 0.86)  # least and greatest (solimp)
    iterations: int = 100  # largest number of the solver
    line_search: int = 50  # largest number of iterations
    tolerance: float = 1e-6  # of the solver


def engine() -> Any:
    """Import and return the package mujoco, or raise ValueError if it is not installed."""
    try:
        import mujoco
    except ImportError as missing:
        raise ValueError("--peers needs the extra: pip install '.[bench]'") from missing
    return mujoco


def build(
    scene: Scene, settings: Settings, timestep: float, conveyor: bool = True, fixtures: tuple[str, ...] = ()
) -> Any:
    """Build the MjModel of a push, with x along the push and the tip's center at the world's origin at the start."""
    # Its qpos holds the slider's free joint (7 numbers), then the position of the tip along x if the tip has a joint.
    # With a conveyor, the table moves under a tip that stands still; otherwise the tip has a joint. `fixtures` are
    # attributes of geoms that the slider touches, with the friction and the settings of the tip.
    mujoco = engine()
    table = f'surfacevel="{-scene.speed:.9g} 0 0"' if conveyor else ""
    joint = '<joint type="slide" axis="1 0 0"/>' if not conveyor else ""
    body = slider_body(scene)
    of_tip = scene.friction_tip, settings.normal, settings.tip_sliding, settings.impedance
    contacts = "".join(
        pair(name, "slider", *of_tip) for name in ("tip", *(f"fixture{k}" for k in range(len(fixtures))))
    )
    geoms = "".join(f'<geom name="fixture{k}" {each}/>' for k, each in enumerate(fixtures))
    text = f"""<mujoco>
      {options(settings, timestep)}
      <default><geom contype="0" conaffinity="0" mass="0"/></default>
      <worldbody>
        <geom name="table" type="plane" size="1 1 .1" {table}/>
        {body}{geoms}
        <body name="tip">{joint}<inertial mass="{TIP_MASS}" pos="0 0 0" diaginertia="1 1 1"/>
          <geom name="tip" type="sphere" size="{scene.tip_radius}"/>
        </body>
      </worldbody>
      <contact>{supported(scene, settings)}{contacts}</contact>
    </mujoco>"""
    return mujoco.MjModel.from_xml_string(text)


def feet(scene: Scene) -> str:
    """Return the XML of spheres under the slider, one for each support."""
    each = enumerate(scene.supports)
    return "".join(f'<geom name="foot{k}" type="sphere" size="{FOOT}" pos="{x} {y} {FOOT}"/>' for k, (x, y) in each)


def pair(one: str, other: str, friction: float, normal: float, sliding: float, impedance: tuple[float, float]) -> str:
    """Return the XML of a contact between two geoms with time constants in s; `sliding` 0 uses `normal`."""
    rest = f'solreffriction="{sliding} 1"' if sliding else ""
    return (
        f'<pair geom1="{one}" geom2="{other}" condim="3" friction="{friction} {friction} 0 0 0" '
        f'solref="{normal} 1" solimp="{impedance[0]} {impedance[1]} 0.001 0.5 2" {rest}/>'
    )


def supported(scene: Scene, settings: Settings) -> str:
    """Return the XML of the contacts between table and supports."""
    of = scene.friction_table, settings.normal, settings.sliding, settings.impedance
    return "".join(pair("table", f"foot{k}", *of) for k in range(len(scene.supports)))


def options(settings: Settings, timestep: float) -> str:
    """Return the XML of MuJoCo's options; `timestep` in s."""
    return (
        f'<option timestep="{timestep:.12g}" integrator="{settings.integrator}" cone="{settings.cone}" '
        f'jacobian="dense" solver="{settings.solver}" iterations="{settings.iterations}" '
        f'tolerance="{settings.tolerance}" ls_iterations="{settings.line_search}" '
        f'impratio="{settings.impratio}" gravity="0 0 {-GRAVITY}"/>'
    )


def slider_body(scene: Scene) -> str:
    """Return the XML of the slider, a free body on its supports."""
    inertia = scene.mass * np.mean(np.sum(scene.vertices**2, axis=1)) / 3
    size = f"{scene.side / 2} {scene.side / 2} {HALF_HEIGHT}"
    return f"""<body name="slider"><freejoint/>
          <inertial mass="{scene.mass}" pos="0 0 0" diaginertia="{inertia / 2} {inertia / 2} {inertia}"/>
          <geom name="slider" type="box" size="{size}"/>{feet(scene)}
        </body>"""
