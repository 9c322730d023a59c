"""FLOPs, bytes and kernels of a compiled program, counted in its HLO text with loops as often as they run.

XLA's own cost analysis counts the body of a loop once. Here the body counts as often as the loop runs, if the compiler
knows that number. Any other loop counts once, such as that of a root finder, which ends when the whole batch has
converged. So the counts are lower bounds. A kernel is taken to move its operands and its result, as if nothing stayed
in a cache. Of an array that it slices or updates in place, it moves only that part.
"""

import math
import re
from functools import cache
from typing import NamedTuple

# Operations that count as one FLOP for each floating-point number of their result.
ARITHMETIC = frozenset(
    "abs add atan2 cbrt cosine divide exponential log maximum minimum multiply negate power rsqrt sine sqrt subtract "
    "tan tanh".split()
)
MOVES_NOTHING = frozenset("after-all bitcast constant get-tuple-element opt-barrier parameter tuple".split())
BYTES = {"pred": 1, "s8": 1, "u8": 1, "s16": 2, "u16": 2, "f16": 2, "bf16": 2, "f64": 8, "s64": 8, "u64": 8}

_COMPUTATION = re.compile(r"^(ENTRY )?%?([\w.-]+) \(.*\{\s*$")
_INSTRUCTION = re.compile(r"^\s+(ROOT )?%?([\w.-]+) = (\(.*?\)|\S+) ([\w-]+)\((.*)$")
_ARRAY = re.compile(r"([a-z]+\d*)\[([\d,]*)\]")
_CALLED = re.compile(r"(?:calls|to_apply|body|condition|true_computation|false_computation)=%?([\w.-]+)")
_BRANCHES = re.compile(r"branch_computations=\{([^}]*)\}")
_COMMENT = re.compile(r"/\*.*?\*/")
_ROUNDS = re.compile(r'known_trip_count":\{"n":"(\d+)"')


class Traffic(NamedTuple):
    """What one run of a program computes and moves."""

    flops: float  # number of floating-point operations
    bytes: float  # number that the kernels read and write
    kernels: int  # number of different kernels

    def times(self, count: int) -> "Traffic":
        """Return the traffic of `count` runs."""
        return self._replace(flops=count * self.flops, bytes=count * self.bytes)


class _Instruction(NamedTuple):
    """One instruction of a computation, with the names of its operands and of the computations that it calls."""

    root: bool
    shape: str
    opcode: str
    operands: tuple[str, ...]
    called: tuple[str, ...]
    rounds: int  # how often a loop runs, if the compiler knows it, else one


def traffic(text: str) -> Traffic:
    """Count what one run of a compiled program computes and moves, given the text of `Compiled.as_text()`."""
    computations, entry = _parsed(text)

    @cache
    def total(name: str) -> tuple[float, float]:
        """Return the FLOPs and bytes of a computation."""
        flops = moved = 0.0
        here = computations[name]
        for each in here.values():
            inner = [total(called) for called in each.called]
            if each.opcode in ("while", "call", "conditional"):
                flops += each.rounds * sum(f for f, _ in inner)
                moved += each.rounds * sum(b for _, b in inner)
            elif each.opcode not in MOVES_NOTHING:
                operands = [here[operand].shape for operand in each.operands if operand in here]
                if each.opcode == "fusion":
                    flops += sum(f for f, _ in inner)
                    moved += _of_kernel(computations[each.called[0]])
                else:
                    flops += _flops(each, operands)
                    moved += _of_one(each, operands)
        return flops, moved

    kernels = sum(each.opcode == "fusion" for here in computations.values() for each in here.values())
    return Traffic(*total(entry), kernels)


SLICES, UPDATES = ("dynamic-slice", "slice", "gather"), ("dynamic-update-slice", "scatter")


def _of_one(each: _Instruction, operands: list[str]) -> int:
    """Return the bytes that an instruction outside of kernels moves."""
    if each.opcode in SLICES:
        return 2 * _size(each.shape)
    if each.opcode in UPDATES:
        return 2 * _size(operands[-1 if each.opcode == "scatter" else 1])
    return sum(map(_size, (each.shape, *operands)))


def _of_kernel(inside: dict[str, _Instruction]) -> int:
    """Return the bytes that a kernel moves; an array that it only slices or updates counts with that part alone."""
    users: dict[str, list[tuple[int, _Instruction]]] = {}
    for each in inside.values():
        for place, operand in enumerate(each.operands):
            users.setdefault(operand, []).append((place, each))
    moved = 0
    for name, each in inside.items():
        if each.opcode != "parameter":
            continue
        mine = users.get(name, [])
        if mine and all(place == 0 and user.opcode in SLICES for place, user in mine):
            moved += sum(_size(user.shape) for _, user in mine)
        elif not (mine and all(place == 0 and user.opcode in UPDATES for place, user in mine)):
            moved += _size(each.shape)
    last = next(each for each in inside.values() if each.root)
    while last.opcode in MOVES_NOTHING and last.opcode != "tuple" and last.operands and last.operands[0] in inside:
        last = inside[last.operands[0]]
    results = [inside[name] for name in last.operands if name in inside] if last.opcode == "tuple" else [last]
    for result in results:
        new = inside.get(result.operands[1]) if result.opcode in UPDATES and len(result.operands) > 1 else None
        moved += _size((new or result).shape)
    return moved


def _flops(each: _Instruction, operands: list[str]) -> float:
    """Return the FLOPs of an instruction."""
    if each.opcode == "dot":  # 2 m k n for matrices (m, k) and (k, n)
        return 2 * math.sqrt(math.prod(map(_count, (each.shape, *operands))))
    if each.opcode in ("reduce", "reduce-window"):
        return float(max(map(_count, operands), default=0))
    return float(_count(each.shape)) if each.opcode in ARITHMETIC and re.match(r"b?f\d", each.shape) else 0.0


def _parsed(text: str) -> tuple[dict[str, dict[str, _Instruction]], str]:
    """Return the instructions of each computation by name, and the name of the entry computation."""
    computations: dict[str, dict[str, _Instruction]] = {}
    entry, here = "", {}
    for line in _COMMENT.sub("", text).splitlines():
        if opening := _COMPUTATION.match(line):
            here = computations[opening[2]] = {}
            entry = opening[2] if opening[1] else entry
        elif found := _INSTRUCTION.match(line):
            root, name, shape, opcode, rest = found.groups()
            arguments, _, attributes = rest.partition(")")
            operands = tuple(word.split()[-1].lstrip("%") for word in arguments.split(",") if word.strip())
            branches = [branch for group in _BRANCHES.findall(attributes) for branch in group.split(",")]
            called = (*_CALLED.findall(attributes), *(branch.strip().lstrip("%") for branch in branches))
            rounds = _ROUNDS.search(attributes)
            here[name] = _Instruction(bool(root), shape, opcode, operands, called, int(rounds[1]) if rounds else 1)
    return computations, entry


def _count(shape: str) -> int:
    """Return the number of elements of all arrays in the text of a shape."""
    return sum(math.prod(int(n) for n in size.split(",") if n) for _, size in _ARRAY.findall(shape))


def _size(shape: str) -> int:
    """Return the bytes of all arrays in the text of a shape."""
    return sum(
        BYTES.get(kind, 4) * math.prod(int(n) for n in size.split(",") if n) for kind, size in _ARRAY.findall(shape)
    )
