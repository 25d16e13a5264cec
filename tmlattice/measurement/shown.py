"""What every measurement shows of itself."""

from typing import Any

import numpy as np

from tmlattice.late import Method
from tmlattice.speaks import Speaks, counted, last_part


class Shown(Speaks):
    """A measurement's line, its table in a notebook, and its figure."""

    plot = Method(
        "tmlattice.plots.speaking",
        "plot_measurement",
        "Draw what was read: along `ring` where it is given (a Ring, a name or a path), else by "
        "the number of the monitor; a matplotlib Figure.",
    )

    def _told(self) -> tuple[str, dict[str, str]]:
        own: dict[str, Any] = vars(self)
        shots, monitors = own.get("shots"), own.get("monitors")
        rows = {"shots": "" if shots is None else str(len(shots))}
        if own.get("readings") is not None:
            rows["turns"] = str(own["readings"].shape[1])
        if own.get("correctors") is not None:
            rows["correctors"] = str(len(own["correctors"]))
        if own.get("steps") is not None:
            rows["steps"] = str(len(own["steps"]))
        rows["monitors"] = "" if monitors is None else str(len(monitors))
        values = next((own[n] for n in ("readings", "orbit", "response") if n in own), None)
        if values is not None:
            missing = int(np.isnan(values).sum())
            rows["rms"] = f"{1e6 * np.sqrt(np.nanmean(np.square(values))):.4g} µm"
            rows["missing"] = counted(missing, "number") if missing else ""
        if monitors is not None:
            rows["noise"] = _noise(own.get("noise"))
        if "launches" in own:
            sigma = own["launch_sigma"]
            known = sigma is not None and np.isfinite(sigma[:, :4]).all()
            rows["launches"] = "stated" if known else "not known"
        if own.get("tune") is not None:
            pairs = (" ".join(f"{q:.5f}" for q in pair) for pair in own["tune"][:3])
            rows["tunes"] = "; ".join(pairs)
        rows["lattice"] = last_part(own.get("lattice") or "")
        return "", rows


def _noise(noise: Any) -> str:
    if noise is None or not np.isfinite(noise).any():
        return "not known"
    x, y = (1e6 * np.sqrt(np.nanmean(np.square(plane))) for plane in np.asarray(noise).T)
    return f"{x:.3g} µm" if np.isclose(x, y) else f"{x:.3g} µm in x, {y:.3g} µm in y"
