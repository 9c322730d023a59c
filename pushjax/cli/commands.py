"""The commands with their options: one class each, of which tyro makes a parser.

Nothing here imports JAX, so that `--help` and wrong options are answered at once. An experiment's defaults therefore
stand twice, here and in the signature of its `run`; a test compares them.
"""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Union

import tyro

from pushjax.experiments._cli_option import cli_option
from pushjax.experiments.identify_logs.options import Options
from pushjax.experiments.plan.options import Options as PlanOptions

COMMANDS = ("demo", "reproduce", "identify", "plan", "data")
DATA_SETS = ("triangle",)

DataFolder = Annotated[Path | None, cli_option("FOLDER")]


@dataclass
class Common:
    """Options of every command that computes."""

    module: ClassVar[str] = ""  # of the experiment, below `pushjax.experiments`

    @property
    def title(self) -> str:
        """Name of the command or experiment, for messages."""
        names = [name for name, kind in EXPERIMENTS.items() if kind is type(self)]
        return names[0] if names else type(self).__name__.lower()

    out: Path = Path("pushjax-out")
    """Folder for pictures and pages."""
    json: Annotated[Path | None, cli_option("FILE")] = None
    """File for every figure that the command prints. Default: NAME.json in --out."""
    seed: int = 0
    """Seed of everything random."""
    cache: bool = True
    """Keep compiled programs in the user's cache folder, or in JAX_COMPILATION_CACHE_DIR, for the next time."""

    def check(self) -> None:
        """Raise ValueError for invalid options, as far as they can be checked without JAX."""

    def settings(self) -> dict[str, Any]:
        """Return the arguments for `run` of the experiment that only this command has, without those that are None."""
        common = {each.name for each in fields(Common)}
        own = {each.name: getattr(self, each.name) for each in fields(self) if each.name not in common}
        return {name: value for name, value in own.items() if value is not None}


@dataclass
class Demo(Common):
    """Fit an ellipsoid and a quartic to a square, push it with both, and draw the result.

    Takes about 20 s of processor time, and 10 s once its programs are compiled.
    """

    module = "demo"


@dataclass
class Table1(Common):
    """Eleven objects on two surfaces, pushed by a robot: predicted against measured final poses (table I).

    Takes about eleven minutes on two cores. If it is interrupted, the next call goes on.
    """

    module = "table1"

    data: DataFolder = None
    """Folder of the recorded pushes. Default: the environment variable PUSHJAX_DATA."""
    method: Annotated[tuple[Literal["wrench_twist", "identified"], ...], cli_option("{wrench_twist,identified} …")] = (
        "wrench_twist",
        "identified",
    )
    """Where the limit surface is from: measured forces, or final poses. Default: both."""
    surface: Annotated[tuple[Literal["abs", "plywood", "delrin"], ...] | None, cli_option("{abs,plywood,delrin} …")] = (
        None
    )
    """What the objects lie on; delrin is in the published folders only. Default: abs, plywood."""
    object: Annotated[tuple[str, ...] | None, cli_option("OBJECT …")] = None
    """Which of rect1, rect2, rect3, tri1, tri2, tri3, ellip1, ellip2, ellip3, hex, butter. Default: all."""
    steps: int = 100
    """Steps of each push."""


@dataclass
class Table2(Common):
    """A triangle on three support points, pushed by a robot: predicted against measured final poses (table II).

    Takes about ten minutes of processor time, and less than two without the method `identified`.
    """

    module = "table2"

    data: DataFolder = None
    """Folder of the recorded pushes. Default: PUSHJAX_DATA, else what `pushjax data triangle` has fetched."""
    geometry: Literal["nominal", "measured"] = "nominal"
    """nominal: as in the paper. measured: contact begins as the force sensor says, pushes end as the robot was told."""
    method: Annotated[
        tuple[Literal["ideal", "wrench_twist", "identified"], ...], cli_option("{ideal,wrench_twist,identified} …")
    ] = ("ideal", "wrench_twist", "identified")
    """Where the limit surface is from: the known support, measured forces, or final poses. Default: all."""
    steps: int = 100
    """Steps of each push."""


@dataclass
class TwoFinger(Common):
    """The triangle pushed by two fingers: predicted against measured poses (not in the paper).

    Takes about 90 s of processor time, most of it to compile.
    """

    module = "two_finger"

    data: DataFolder = None
    """Folder of the recorded pushes. Default: PUSHJAX_DATA, else what `pushjax data triangle` has fetched."""
    steps: int = 60
    """Steps of each push."""


@dataclass
class Squeeze(Common):
    """A parallel jaw closes on a rectangle from four start poses.

    Takes about 70 s of processor time, most of it to compile.
    """

    module = "squeeze"

    steps: int = 1500
    """Steps in which the jaw closes."""


@dataclass
class Jam(Common):
    """Two fingers that jam, and the friction from which they jam.

    Takes about 50 s of processor time, most of it to compile.
    """

    module = "jam"


@dataclass
class StochasticPush(Common):
    """A square pushed many times under random friction: the distribution of its motion.

    Takes about 80 s of processor time, most of it to compile.
    """

    module = "stochastic_push"

    n: int = 2000
    """Number of pushes."""
    steps: int = 200
    """Steps of each push."""
    dof: float = 20.0
    """Degrees of freedom of the limit surface's noise; fewer, more noise."""
    friction: Annotated[tuple[float, float], cli_option("LOWEST HIGHEST")] = (0.15, 0.35)
    """Range of the friction coefficient. Default: 0.15 0.35."""


@dataclass
class Capture(Common):
    """Two fingers push a disk from anywhere: from where they catch it.

    Takes about 70 s of processor time, most of it to compile.
    """

    module = "capture"

    n: int = 500
    """Number of start poses."""
    steps: int = 525
    """Steps of each push."""
    dof: Annotated[tuple[float, ...], cli_option("DOF DOF")] = (200.0, 10.0)
    """Two degrees of freedom of the limit surface's noise, to compare. Default: 200 10."""
    friction: Annotated[tuple[float, ...], cli_option("MU …")] = (0.25, 0.1, 0.5)
    """Friction coefficients; the first one is drawn. Default: 0.25 0.1 0.5."""


@dataclass
class Grasp(Common):
    """A parallel jaw closes on an object from random poses under random friction."""

    module = "grasps"
    slider: ClassVar[str] = ""  # name of the object

    n: Annotated[int | None, cli_option("N")] = None
    """Number of grasps. Default: the paper's."""
    steps: int = 840
    """Steps of each grasp."""
    dof: float = 250.0
    """Degrees of freedom of the limit surface's noise; fewer, more noise."""
    friction: Annotated[tuple[float, float], cli_option("LOWEST HIGHEST")] = (0.015, 0.02)
    """Range of the friction coefficient. Default: 0.015 0.02."""

    def settings(self) -> dict[str, Any]:
        """Return the arguments of the experiment's `run` that are its own."""
        return {"slider": self.slider} | super().settings()


@dataclass
class GraspRectangle(Grasp):
    """A parallel jaw closes on a rectangle from random poses under random friction.

    Takes about 100 s of processor time, most of it to compile.
    """

    slider = "rectangle"


@dataclass
class GraspButterfly(Grasp):
    """A parallel jaw closes on a butterfly-shaped block from random poses under random friction.

    Takes about 200 s of processor time.
    """

    slider = "butterfly"


@dataclass
class PushtMpc(Common):
    """PushT in the package gym-pusht, solved by a planner whose model is pushjax.

    The first call compiles for about a minute.
    """

    module = "pusht_mpc"

    episodes: int = 50
    """Number of episodes; their starts have the seeds from --seed on."""
    lookahead: bool = True
    """Consider plans of two pushes."""
    cost_to_go: bool = True
    """Far from the goal, choose pushes by the cost to go; without it, by the distance to the goal."""
    feedback: bool = True
    """Correct a push while it runs."""
    friction_in_model: float = 0.0
    """Friction at the finger in the model; the plant has none."""
    actuation_noise: float = 0.0
    """Standard deviation of noise on the actions, px."""
    observation_noise: float = 0.0
    """Standard deviation of noise on the positions that the controller sees, px."""


EXPERIMENTS: dict[str, type[Common]] = {
    "table1": Table1,
    "table2": Table2,
    "two-finger": TwoFinger,
    "stochastic-push": StochasticPush,
    "capture": Capture,
    "squeeze": Squeeze,
    "jam": Jam,
    "grasp-rectangle": GraspRectangle,
    "grasp-butterfly": GraspButterfly,
    "pusht-mpc": PushtMpc,
}
Experiment = Union[*(Annotated[kind, tyro.conf.subcommand(name)] for name, kind in EXPERIMENTS.items())]  # pyright: ignore


@dataclass
class Reproduce:
    """Reproduce an experiment: of the paper, or pusht-mpc. The tables are compared with the paper's own figures."""

    experiment: Annotated[Experiment, tyro.conf.arg(name="")]  # pyright: ignore[reportInvalidTypeForm]
    """Name of the experiment."""


@dataclass
class Identify(Options, Common):
    """Identify friction, limit surface and calibration from logs of pushes, with intervals, and write a report.

    Takes about a minute of processor time for some dozens of pushes, most of it to compile.
    """

    module = "identify_logs"

    logs: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="LOG …", help_behavior_hint=""), tyro.conf.Positional] = ()
    """Files of recorded pushes: CSV with the columns push, hand_x, hand_y, object_x, object_y, object_theta (SI units,
    world frame; blank where the object was not seen), NPZ with start, path, end, MIT pushing data (JSON, HDF5), or
    triangle logs (text)."""

    def check(self) -> None:
        """Raise ValueError for invalid options, or if there is no log."""
        Options.check(self)
        if not any(log.exists() for log in self.logs):
            missing = ", ".join(map(str, self.logs)) or "file"
            raise ValueError(f"LOG: give at least one file of recorded pushes; there is no {missing}")

    def settings(self) -> dict[str, Any]:
        """Return the arguments of `run` that are its own."""
        return {"logs": list(self.logs), "options": self}


@dataclass
class Plan(PlanOptions, Common):
    """Plan pushes of a finger that bring a block from pose to pose, and write them as way points for a robot.

    Takes about two minutes of processor time, most of it to compile, and 20 s for each further attempt.
    """

    module = "plan"

    def settings(self) -> dict[str, Any]:
        """Return the arguments of `run` that are its own."""
        return {"options": PlanOptions(**{each.name: getattr(self, each.name) for each in fields(PlanOptions)})}


@dataclass
class Data:
    """Fetch recorded pushes from where they are published."""

    name: Annotated[Literal["triangle"], tyro.conf.Positional]
    """triangle: the authors' logs of the triangle, pushed by one finger and by two, 118 files of 34 MB in all."""
    to: DataFolder = None
    """Where to. Default: pushjax's data folder of this user, where `reproduce table2` and `two-finger` look."""


# The commands that are one experiment each, which `reproduce` and `data` are not.
COMMAND_CLASSES: dict[str, type[Common]] = {"demo": Demo, "identify": Identify, "plan": Plan}
Command = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Reproduce, tyro.conf.subcommand("reproduce")]
    | Annotated[Identify, tyro.conf.subcommand("identify")]
    | Annotated[Plan, tyro.conf.subcommand("plan")]
    | Annotated[Data, tyro.conf.subcommand("data")]
)
