"""What a user states of files of readings (the machine file): names, unit, noise, bad monitors."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Any

from tmlattice.errors import unknown_name

COLUMNS = ("monitor", "plane", "value", "shot", "turn")


@dataclass(frozen=True)
class Stated:
    """Of a file.

    Attributes:
        unit: of readings whose header has none; None: from their size.
        noise: rms of a reading, m; None: unknown.
        names: device or column in the file -> the lattice's monitor or corrector.
        in_order: the devices are the lattice's monitors in beam order, whatever their names.
        bad: monitors to leave out, by either name; patterns.
        columns: what columns are called: of `COLUMNS`, the name in the file.
        assume: conventions that the readings have, see `measurement.assume`.
    """

    unit: str | None = None
    noise: float | None = None
    names: Mapping[str, str] = field(default_factory=dict)
    in_order: bool = False
    bad: tuple[str, ...] = ()
    columns: Mapping[str, str] = field(default_factory=dict)
    assume: tuple[str, ...] = ()

    def name_of(self, device: str) -> str:
        """The lattice's name of a device, or the device's own."""
        plain = device.casefold()
        return next((own for key, own in self.names.items() if key.casefold() == plain), device)

    def bad_among(self, monitors: Mapping[str, str], others: Iterable[str] = ()) -> list[str]:
        """The monitors that are bad, as stated.

        Args:
            monitors: of the data, and the device of each.
            others: of the lattice, which the data need not have.

        Raises:
            UnknownNameError: a pattern of no monitor, and of no name that is stated.
        """
        found, others = [], [*others, *self.names]
        for pattern in self.bad:
            like = [
                own for own, device in {**dict.fromkeys(others, ""), **monitors}.items()
                if any(fnmatchcase(n.casefold(), pattern.casefold()) for n in (own, device))
            ]  # fmt: skip
            if not like:
                known = [*others, *monitors, *monitors.values()]
                raise unknown_name("BPM", pattern, dict.fromkeys(known))
            found += like
        return [own for own in monitors if own in found]


def machine_text(
    lattice: str,
    stated: Mapping[str, Any],
    silent: Mapping[str, Any],
    channels: Mapping[str, str | None],
    knob: Mapping[str, Any],
) -> str:
    """The text of a machine file (TOML): what is known is filled in, the rest is a comment.

    Args:
        lattice: a built-in name, or a path from the folder of the file.
        stated: values of the keys of [lattice] and [data], of any of them.
        silent: values that are shown in comments.
        channels: device or column in the data -> the lattice's BPM; None: a comment.
        knob: of a power supply, as an example.
    """

    every = {**EXAMPLES, **silent, "file": lattice, **stated}

    def lines(*keys: str) -> list[str]:
        used = ["" if key == "file" or key in stated else "# " for key in keys]
        values = [
            f"{mark}{key} = {_toml(every[key])}" for mark, key in zip(used, keys, strict=True)
        ]
        return [f"{v:<36}  # {MEANINGS[key]}" for v, key in zip(values, keys, strict=True)]

    named = [
        f"{'' if name else '# '}{_toml(device)} = {_toml(name or '')}"
        for device, name in channels.items()
    ]
    return "\n".join([
        "# The machine file of tmlattice: with it, commands need none of this, nor LATTICE, again.",
        "# Every line may be left out. Paths are relative to this file.", "",
        "[lattice]",
        *lines("file", "sequence", "energy", "particle", "monitors", "correctors"), "",
        "[data]  # of files of other programs; a measurement folder states all of it itself",
        *lines("unit", "noise", "bad", "assume", "in_order", "columns"), "",
        "[channels]  # device or column in the data = BPM or corrector of the lattice",
        *(named or ['# "SR:BPM-001" = "bpm_1"']), "",
        "# Power supplies, for `tmlattice correct`: what is left out is taken from the lattice.",
        '# Or a table, above [lattice]: supplies = "knobs.csv" (`tmlattice correct --example`).',
        "# [[supplies]]",
        *(f"# {key} = {_toml(value)}" for key, value in knob.items()), "",
    ])  # fmt: skip


EXAMPLES: Mapping[str, Any] = {
    "sequence": "ring", "energy": 6.0, "particle": "electron", "monitors": ["BPM*"],
    "correctors": ["COR*"], "unit": "mm", "noise": "20 um", "bad": ["BPM_9*"],
    "assume": ["x-reversed"], "in_order": True, "columns": {"monitor": "pv", "shot": "cycle"},
}  # fmt: skip
MEANINGS: Mapping[str, str] = {
    "file": "or a built-in name",
    "sequence": "of a file that holds several",
    "energy": "GeV; else what the lattice states",
    "particle": 'or "proton"; else what the lattice states',
    "monitors": "elements that are BPMs although the file has them as markers or drifts",
    "correctors": "elements that are correctors too",
    "unit": "of readings whose file states none: m, mm, um, nm; else taken from their size",
    "noise": "rms of one reading; else estimated",
    "bad": "BPMs to leave out, by name or channel",
    "assume": "signs and units that are not the package's; `tmlattice check` names them",
    "in_order": "the channels are the lattice's BPMs in beam order, whatever their names",
    "columns": "what columns are called, where the names are not the usual ones",
}


def _toml(value: Any) -> str:
    """A value as TOML."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key} = {_toml(own)}" for key, own in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, str):
        value = value.encode(errors="replace").decode()
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
