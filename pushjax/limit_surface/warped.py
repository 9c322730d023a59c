"""A limit surface of wrenches that are changed first: H(T F).

What a table that is not alike everywhere does to a slider: T stretches the force, and takes the torque about another
point. The twist is T' grad H(T F), so that power is what it was.
"""

from typing import NamedTuple

from pushjax._vec import Scalar, Vec3
from pushjax.limit_surface._base import Form, Symmetric3


class Warp(NamedTuple):
    """T F = (S f, tau - c x f), normalised. xx, yy, xy: of the symmetric S. cx, cy: c over the length."""

    xx: Scalar
    yy: Scalar
    xy: Scalar
    cx: Scalar
    cy: Scalar

    def times(self, f: Vec3) -> Vec3:
        return Vec3(
            self.xx * f.x + self.xy * f.y,
            self.xy * f.x + self.yy * f.y,
            f.z - self.cx * f.y + self.cy * f.x,
        )

    def transposed(self, g: Vec3) -> Vec3:
        return Vec3(
            self.xx * g.x + self.xy * g.y + self.cy * g.z,
            self.xy * g.x + self.yy * g.y - self.cx * g.z,
            g.z,
        )


class _WarpedFields(NamedTuple):
    base: Form
    warp: Warp


class WarpedForm(_WarpedFields):
    """H(T F) in scalars."""

    @property
    def degree(self) -> int:
        return self.base.degree

    @property
    def length(self) -> Scalar:
        return self.base.length

    def scaled(self, factor: Scalar) -> "WarpedForm":
        return WarpedForm(self.base.scaled(factor), self.warp)

    def value(self, f: Vec3) -> Scalar:
        return self.base.value(self.warp.times(f))

    def gradient(self, f: Vec3) -> Vec3:
        return self.warp.transposed(self.base.gradient(self.warp.times(f)))

    def spin(self, f: Vec3) -> Scalar:
        return self.base.spin(self.warp.times(f))

    def hessian(self, f: Vec3) -> Symmetric3:
        base, t = self.base.hessian(self.warp.times(f)), self.warp
        zero, one = 0 * t.xx, 0 * t.xx + 1
        x, y, z = Vec3(t.xx, t.xy, t.cy), Vec3(t.xy, t.yy, -t.cx), Vec3(zero, zero, one)
        bx, by, bz = base.times(x), base.times(y), base.times(z)
        return Symmetric3(x.dot(bx), y.dot(by), z.dot(bz), x.dot(by), x.dot(bz), y.dot(bz))

    def restrict(self, a: Vec3, b: Vec3) -> tuple[Scalar, ...]:
        return self.base.restrict(self.warp.times(a), self.warp.times(b))
