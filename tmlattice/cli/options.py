"""Options that several commands share."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from tmlattice.measurement import Measurement

FILE = click.Path(path_type=Path)

REGULARIZATIONS = ["symplectic", "none", "l1", "l2"]


class Numbers(click.ParamType):  # type: ignore[type-arg]
    """Numbers separated by commas, as one word.

    Args:
        name: how they are shown: one name each.
        least: the smallest that is allowed.
        advice: what a wrong value is answered with.
    """

    def __init__(self, name: str, advice: str, least: float = float("-inf")) -> None:
        self.name = name
        self._advice = advice
        self._least = least

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        """As many finite numbers as there are names."""
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(part) for part in str(value).split(","))
        except ValueError:
            numbers = ()
        allowed = all(self._least <= n and abs(n) < float("inf") for n in numbers)
        if len(numbers) != len(self.name.split(",")) or not allowed:
            self.fail(f"'{value}'{self._advice}", param, ctx)
        return numbers


LAUNCH = Numbers(
    "x,px,y,py", " is no launch; give four numbers in m and rad, such as 1e-3,0,1e-3,0"
)
LAUNCH_SIGMA = Numbers(
    "X,PX,Y,PY,DELTA", ": give five rms values, such as 1e-4,2e-5,1e-4,2e-5,0", least=0.0
)


class BackgroundText(click.ParamType):  # type: ignore[type-arg]
    """NAME or NAME=RMS."""

    name = "NAME[=RMS]"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, float | None]:
        """Effect and rms, or None for the catalogue's."""
        if isinstance(value, tuple):
            return value
        name, _, size = str(value).partition("=")
        try:
            return name.strip(), float(size) if size else None
        except ValueError:
            self.fail(f"'{size}' is no rms; give {name}=1e-3, say", param, ctx)


def background_option(title: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """`--background NAME[=RMS]`, repeated."""
    return click.option(
        "--background",
        type=BackgroundText(),
        multiple=True,
        help=f"{title}, with this rms or the catalogue's; `all`, or `all=SCALE`, for every usual "
        "one, or `none`.",
    )


class NameList(click.ParamType):  # type: ignore[type-arg]
    """Names separated by commas."""

    name = "NAME,NAME"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, ...]:
        """One name or more."""
        if isinstance(value, tuple):
            return value
        names = tuple(name.strip() for name in str(value).split(",") if name.strip())
        if not names:
            self.fail("give one name or more, separated by commas", param, ctx)
        return names


def lattice_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Which sequence of the lattice, at which energy."""
    for decorate in (
        click.option("--energy", type=click.FloatRange(0, min_open=True), metavar="GEV",
                     help="Beam energy; else what the lattice states."),
        click.option("--sequence", metavar="NAME",
                     help="The lattice file's variable that holds the ring."),
    ):  # fmt: skip
        function = decorate(function)
    return function


def lattice_argument(function: Callable[..., Any]) -> Callable[..., Any]:
    """LATTICE, petra3 where none is named, and its options."""
    return click.argument("lattice", default="petra3")(lattice_options(function))


def recipe_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """What `tune-fit` and its study share: the perturbation, the measurement, the fit."""
    for decorate in reversed((
        click.option("--change", type=float, default=-0.2, show_default=True,
                     help="Relative change of the magnet's strength."),
        click.option("--launch", type=LAUNCH, default="1e-3,0,1e-3,0", show_default=True,
                     help="State at the start of the ring, m and rad."),
        click.option("--noise", type=click.FloatRange(0), default=2e-5, show_default=True,
                     help="Rms of one reading, m."),
        click.option("--epochs", type=click.IntRange(1), default=1000, show_default=True,
                     help="Gradient steps at most."),
        click.option("--turns", type=click.IntRange(16), default=500, show_default=True,
                     help="Tracked for the tunes."),
        click.option("--regularization-rate", type=click.FloatRange(0), default=1e-10,
                     show_default=True, help="lambda: weight of the regularization."),
        click.option("--learning-rate", type=click.FloatRange(0, min_open=True), default=1e-6,
                     show_default=True, help="Adam's step."),
        click.option("--seed", type=click.IntRange(0), default=0, show_default=True,
                     help="Of the readings' noise."),
    )):  # fmt: skip
        function = decorate(function)
    return function


def json_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """--json FILE."""
    return click.option("--json", "json_file", type=FILE, metavar="FILE",
                        help="Write the result as JSON.")(function)  # fmt: skip


def quiet_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """--quiet."""
    return click.option("--quiet", "-q", is_flag=True, help="Print nothing but errors.")(function)


def trajectories(path: Path, refusal: str) -> "Measurement":
    """The first turns of a measurement folder, or of a table.

    Raises:
        MeasurementError: an orbit response, with what the command says to it.
    """
    from tmlattice.errors import MeasurementError
    from tmlattice.measurement import Measurement, read_measurement

    data = read_measurement(path)
    if not isinstance(data, Measurement):
        raise MeasurementError(f"'{path}' is an orbit response{refusal}")
    return data


def console() -> "Console":
    """Where results are printed: as wide as the terminal, else 100 columns."""
    from rich.console import Console

    wide = Console(highlight=False, markup=False)
    return wide if wide.is_terminal else Console(highlight=False, markup=False, width=100)


def table(*columns: str) -> "Table":
    """A table with its first column left, the others right."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    made = Table(box=SIMPLE_HEAD, pad_edge=False)
    for i, column in enumerate(columns):
        made.add_column(column, justify="right" if i else "left")
    return made
