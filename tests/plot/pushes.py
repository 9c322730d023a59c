"""Trajectories whose arrays are written directly, for tests of pictures."""

import jax.numpy as jnp

import pushjax as pj


def trajectory(pose, configuration, contacts: int = 1, **given) -> pj.Trajectory:
    """Return a trajectory of these poses and configurations; everything else is zero where it is not given."""
    steps, at_contacts = len(pose) - 1, (contacts, 2)
    shapes = {"twist": (3,), "wrench": (3,), "overlap": ()}
    shapes |= dict.fromkeys(("force", "contact_point", "contact_normal"), at_contacts)
    numbers = {name: jnp.zeros((steps, *shape)) for name, shape in shapes.items()}
    whole = {name: jnp.zeros((steps, *shape), jnp.int8) for name, shape in (("mode", (contacts,)), ("status", ()))}
    parts = numbers | whole | {name: jnp.asarray(value) for name, value in given.items()}
    return pj.Trajectory(pose=jnp.asarray(pose), configuration=jnp.asarray(configuration), **parts)
