"""Studies of the robot's pushes of table 1, and the types of their options."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from pushjax.experiments._cli_option import cli_option

DataFolder = Annotated[Path | None, cli_option("FOLDER")]
Surfaces = Annotated[Sequence[str] | None, cli_option("{abs,plywood,delrin} …")]
Objects = Annotated[Sequence[str], cli_option("OBJECT …")]
