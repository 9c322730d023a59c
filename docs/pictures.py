"""Draw the pictures and animations of the documentation.

    python docs/pictures.py [push grasp stochastic pusht limit_surfaces motion_cone real among_fixtures]
                            [--to FOLDER] [--suffix .gif]

Without a name, all are drawn; this takes four minutes, most of it for compiling. `real` needs PUSHJAX_DATA and `pusht`
needs gym-pusht; without, they are left out.
"""

import argparse
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")  # draws to files, because there may be no screen

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import pushjax as pj
from pushjax import plot
from pushjax.datasets import find_data
from pushjax.experiments import demo, squeeze, stochastic_push
from pushjax.experiments.table2 import conditions
from pushjax.friction.support import WrenchTwistPairs

PUSHES = 200
FRICTIONS = {"friction 0.1: it slides": 0.1, "friction 0.6: it sticks": 0.6}
REAL, STEPS, REAL_FRICTION = ("hardboard", "3pts1"), 60, 0.25
SHOWN = {"10th percentile": 0.1, "median": 0.5, "90th percentile": 0.9}
GRASPS = {"held flat": "grasped with offset", "wedged": "jammed"}


def square(side: float = 0.09) -> tuple[pj.Support, WrenchTwistPairs, pj.Slider]:
    """Return a square of this side (m) on 64 points: its support, its wrench-twist pairs, and the slider."""
    block = pj.Polygon.rectangle(side, side)
    support = pj.Support.uniform(block, points=64)
    pairs = support.wrench_twist_pairs(jax.random.key(0), 400)
    return support, pairs, pj.Slider(block, pj.fit_limit_surface(*pairs, degree=4))


def push() -> plot.Animation:
    """Draw oblique pushes of a square: with low friction the finger slides along its side, with high it sticks."""
    _, _, slider = square()
    hand, path = pj.Hand.finger(0.00475), pj.line((-0.052, 0.020), (0.018, -0.020), 120)
    pushes = {name: pj.rollout(slider, hand, path, pose=jnp.zeros(3), friction=mu) for name, mu in FRICTIONS.items()}
    return plot.animate(slider.shape, hand, pushes)


def grasp() -> plot.Animation:
    """Draw a parallel jaw that closes on a rectangle from two start poses: one ends held flat, the other wedged."""
    block = pj.Polygon.rectangle(squeeze.WIDTH, squeeze.HEIGHT)
    pairs = pj.Support.uniform(block, points=64).wrench_twist_pairs(jax.random.key(0), 400)
    slider = pj.Slider(block, pj.fit_limit_surface(*pairs, degree=4))
    hand = pj.Hand.parallel_jaw(squeeze.PAD, squeeze.THICKNESS)
    path = pj.line((0.0, 0.0, 0.0, squeeze.OPENING), (0.0, 0.0, 0.0, squeeze.CLOSED), 700)
    grasps = {}
    for name, start in GRASPS.items():
        x, y, angle = squeeze.STARTS[start]
        pose = jnp.array([x, y, np.radians(angle)])
        grasps[name] = pj.rollout(slider, hand, path, pose=pose, friction=squeeze.FRICTION)
    return plot.animate(block, hand, grasps, friction=squeeze.FRICTION)


def stochastic() -> plot.Animation:
    """Draw one push with 200 samples of the friction under the square and at the finger."""
    slider, hand, path = stochastic_push.push_setup(0, 100)
    model = pj.FrictionModel(dof=20, friction=(0.15, 0.35))
    many = pj.monte_carlo(
        jax.random.key(1), PUSHES, slider, hand, path, pose=jnp.zeros(3), model=model, trajectories=True
    )
    title = "One push under uncertain friction"
    return plot.animate_cloud(slider.shape, hand, path, np.asarray(many.trajectory), title=title)


def pusht() -> plot.Animation:
    """Draw PushT in gym-pusht, solved by the planner of `pushjax reproduce pusht-mpc`."""
    import pusht_picture  # beside this file

    return pusht_picture.animation()


def limit_surfaces() -> Figure:
    """Draw the ellipsoid and the quartic of a square on four corners, with the twists of wrenches as arrows."""
    block = pj.Polygon.rectangle(demo.SIDE, demo.SIDE)
    support = pj.Support.points(block.vertices)
    pairs = support.wrench_twist_pairs(jax.random.key(0), 400)
    fitted = {name: pj.fit_limit_surface(*pairs, degree=d) for name, d in (("ellipsoid", 2), ("quartic", 4))}
    return plot.limit_surfaces(fitted, pairs, float(support.load))


def motion_cone() -> Figure:
    """Draw one contact of a square with its friction cone, its motion cone, and a push outside the motion cone."""
    return plot.motion_cone_figure(*demo.motion_cone_setup(jax.random.key(0)))


def real() -> Figure:
    """Draw a robot's pushes of a triangle on three support points, with predictions from the known support points.

    Nothing is fitted to the pushes. Three pushes are shown, at three percentiles of the deviation.
    """
    data = find_data()
    if data is None:
        raise SystemExit("real: set PUSHJAX_DATA to the folder of real data")
    log, geometry = conditions.load(data / "three_point_push", *REAL), conditions.GEOMETRIES["measured"]
    if log is None:
        raise SystemExit(f"real: {data} has no log of {', '.join(map(str, REAL))}")
    pushes, block = conditions.recorded(log, geometry, STEPS), conditions.outline(log, geometry)
    slider = pj.Slider(block, conditions.ideal_surface(log, "quartic", jax.random.key(0)))
    hand = pj.Hand.finger(geometry.radius)

    def end(start, path):
        return pj.rollout(slider, hand, path, pose=start, friction=REAL_FRICTION).pose[-1]

    predicted = jax.jit(jax.vmap(end))(pushes.start, pushes.path)
    off = plot.MM * np.asarray(pj.deviation(predicted, pushes.end, log.length))
    order = np.argsort(off)
    shown = {}
    for name, share in SHOWN.items():
        k = order[round(share * (len(order) - 1))]
        one = plot.RealPush(*(np.asarray(part[k]) for part in (pushes.start, pushes.end, predicted, pushes.path)))
        shown[f"{name}: {off[k]:.1f} mm"] = one
    return plot.real_figure(block, shown, hand)


def among_fixtures() -> Figure:
    """Draw a box that is pushed around fixtures, by a planner that knows them and by one that does not."""
    import fixtures_picture  # beside this file

    return fixtures_picture.figure()


MOVING: dict[str, Callable[[], plot.Animation]] = {
    "push": push,
    "grasp": grasp,
    "stochastic": stochastic,
    "pusht": pusht,
}
STILL: dict[str, Callable[[], Figure]] = {
    "limit_surfaces": limit_surfaces,
    "motion_cone": motion_cone,
    "real": real,
    "among_fixtures": among_fixtures,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(MOVING | STILL))
    parser.add_argument("--to", type=Path, default=Path(__file__).parent)
    parser.add_argument("--suffix", default=".gif", help="of what moves: .gif, .html or .mp4")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.names if name not in MOVING | STILL]
    if unknown:
        parser.error(f"no picture is named {', '.join(unknown)}; there are {', '.join(MOVING | STILL)}")
    without = ([] if find_data() else ["real"]) + ([] if find_spec("gym_pusht") else ["pusht"])
    for name in arguments.names or [name for name in MOVING | STILL if name not in without]:
        suffix = arguments.suffix if name in MOVING else ".png"
        path = plot.save((MOVING | STILL)[name](), arguments.to / f"{name}{suffix}")
        print(f"drew {path}, {path.stat().st_size / 1e3:.0f} kB", flush=True)


if __name__ == "__main__":
    main()
