"""Results of pushes: of one step, and of a path of steps."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from pushjax._math.vec import Scalar
from pushjax.contact.status import Status
from pushjax.simulation.step import StepRecord, hand_stops


class Step(eqx.Module):
    """Result of one step of a push.

    Twist, wrench, force, contacts and mode are the solution of the contact problem when the slider is halfway through
    its motion, in the body frame of that halfway pose. Where nothing pushes, twist, wrench, force, contact points and
    normals are zero, and the modes are SEPARATED. Otherwise the wrench lies on the limit surface ("on H = 1" below),
    and the forces, which act at the contact points, sum to it. The tangent of a contact with normal n is (-n_y, n_x).
    A contact without force is where its finger might touch next; past the end of an edge, it is off the outline.

    Contacts are in the order of the fingers, and then of the fixtures. A round finger has one contact, or two on an
    outline that is not convex. A pad has two contacts in general, one on a disk, and three on a polygon that is not
    convex. A wall has two contacts, or one on a disk or an ellipse. The contacts of one finger may change places from
    step to step.

    The contact point moves in a straight line, and the rest of the slider turns about it. The twist is one of chords:
    the slider turns by 2 asin(twist[2] / 2), and its pose after the step agrees with the exponential of the twist to
    second order only. For a step that was divided (`pushjax.simulation.substeps`), the twist is the sum over its parts;
    wrench, force, contacts and mode come from halfway through the last part in which the slider moved.

    MOVING, FREE, JAMMED and GRASPED promise a bound on the overlap after the step: the overlap before the step or, if
    that is more, a tenth of the largest displacement of the fingers in the step, but at least 1e-5 of the surface's
    length.

    Attributes:
        pose: Pose of the slider after the step, (3,), world, m and rad.
        twist: Twist of the slider over the step, (3,), body frame, m and rad.
        wrench: Wrench on the slider, (3,), body frame, N and N m, on H = 1.
        force: Forces along normal and tangent of each contact, (contacts, 2), N, on H = 1.
        contact_point: Points where the forces act, (contacts, 2), body frame, m. Not differentiated.
        contact_normal: Unit normals of the contacts, into the slider, (contacts, 2), body frame. Not differentiated.
        mode: `ContactMode` of each contact, (contacts,).
        status: `Status` of the step.
        overlap: Depth of the deepest finger or fixture in the slider after the step, m, computed from the whole
            outline; negative where all are apart. Not differentiated.
    """

    pose: Float[Array, "3"]
    twist: Float[Array, "3"]
    wrench: Float[Array, "3"]
    force: Float[Array, "contacts 2"]
    contact_point: Float[Array, "contacts 2"]
    contact_normal: Float[Array, "contacts 2"]
    mode: Int[Array, "contacts"]
    status: Int[Array, ""]
    overlap: Float[Array, ""]


class Trajectory(eqx.Module):
    """A push, step by step: the fields of `Step` with a leading axis of steps, and the configurations of the hand.

    At a jam the hand stops, within a sixteenth of a step before the jam (right after a failed step, within a whole
    step). The status is then JAMMED, or GRASPED if every finger and no fixture holds the slider, at this step and at
    every step after it, and nothing moves any more.

    Attributes:
        pose: Poses of the slider, (steps + 1, 3), world, m and rad; the first is the start.
        configuration: Actual configurations of the hand, (steps + 1, dof): the path up to a jam, then where the hand
            stopped.
        twist: Twist of the slider over each step, (steps, 3), body frame, m and rad.
        wrench: Wrench on the slider in each step, (steps, 3), body frame, N and N m, on H = 1.
        force: Forces along normal and tangent of each contact, (steps, contacts, 2), N, on H = 1.
        contact_point: Points of contact, (steps, contacts, 2), body frame, m. Not differentiated.
        contact_normal: Unit normals into the slider, (steps, contacts, 2), body frame. Not differentiated.
        mode: `ContactMode` of each contact, (steps, contacts).
        status: `Status` of each step, (steps,).
        overlap: Depth of the deepest finger or fixture in the slider after each step, (steps,), m. Not differentiated.
        contacts: The two bodies of each contact, by kind and number, such as ("slider 0", "finger 1"). Point and normal
            are in the frame of the first one.
    """

    pose: Float[Array, "steps+1 3"]
    configuration: Float[Array, "steps+1 dof"]
    twist: Float[Array, "steps 3"]
    wrench: Float[Array, "steps 3"]
    force: Float[Array, "steps contacts 2"]
    contact_point: Float[Array, "steps contacts 2"]
    contact_normal: Float[Array, "steps contacts 2"]
    mode: Int[Array, "steps contacts"]
    status: Int[Array, "steps"]
    overlap: Float[Array, "steps"]
    contacts: tuple[tuple[str, str], ...] = eqx.field(default=(), static=True)

    @property
    def failed(self) -> Bool[Array, "steps"]:
        """Steps whose status is a failure (`Status.failed`), (steps,).

        There the slider stays where it was, or where the last part of the step that could be done left it.
        """
        return jnp.isin(self.status, jnp.array([s for s in Status if s.failed], self.status.dtype))

    @property
    def stopped(self) -> Int[Array, ""]:
        """Index of the step at which the hand jammed or grasped, or -1."""
        return first_true(hand_stops(self.status))

    @property
    def first_failure(self) -> Int[Array, ""]:
        """Index of the first failed step, or -1."""
        return first_true(self.failed)


def first_true(mask: Bool[Array, "... steps"]) -> Int[Array, "..."]:
    """Return the index of the first True along the last axis, or -1."""
    return jnp.where(jnp.any(mask, axis=-1), jnp.argmax(mask, axis=-1), -1)


def to_arrays(record: StepRecord, length: Scalar) -> Step:
    """Return the record of one step as arrays, or a stacked record, whose entries have an axis of steps."""
    # the torque of the record is divided by the length of the limit surface
    record = record._replace(
        wrench=record.wrench._replace(z=record.wrench.z * jnp.broadcast_to(length, record.wrench.z.shape))
    )
    fields = record._asdict()
    return Step(
        **{name: jnp.stack(entry, axis=-1) if isinstance(entry, tuple) else entry for name, entry in fields.items()}
    )


def trajectory_of(
    records: StepRecord,  # stacked
    length: Scalar,  # of the limit surface, m; or those of several sliders
    path: Float[Array, "steps+1 dof"],
    first_pose: Float[Array, "*sliders 3"],  # that was computed with
    fraction: Scalar,  # of the last step that a stopped hand did
    pose: Float[Array, "*sliders 3"],  # that was given
    valid: Bool[Array, ""],  # whether this pose is one that can be computed with
    contacts: tuple[tuple[str, str], ...],
) -> Trajectory:
    """Return the records of all steps as a trajectory."""
    results, steps = to_arrays(records, length), len(path) - 1
    stop_step = first_true(hand_stops(results.status))
    last_done = jnp.where(stop_step >= 0, stop_step, steps)
    index = jnp.arange(steps + 1)
    # if the step of the jam was divided, the hand did the first part of it
    last_displacement = jax.lax.stop_gradient(fraction) * (path[jnp.minimum(last_done + 1, steps)] - path[last_done])
    configuration = path[jnp.minimum(index, last_done)]
    configuration += jnp.where((index > last_done)[:, None], last_displacement[None], 0.0)
    poses = jnp.concatenate([first_pose[None], results.pose])
    poses = jnp.where(valid, poses, jnp.broadcast_to(pose, poses.shape))
    other_fields = {name: getattr(results, name) for name in Step.__dataclass_fields__ if name != "pose"}
    return Trajectory(pose=poses, configuration=configuration, contacts=contacts, **other_fields)
