"""Interactive figures for plotly.js, as plain dictionaries.

The same figures as those of `tmlattice.plots`, whose pictures are in the printed page,
or where scripts are off. The colours "@ink" and "@faint" follow the reader's light or dark page.

>>> figures(diagnosis)["scan"]["layout"]["xaxis"]["title"]["text"]
"""

from collections.abc import Callable, Iterable, Sequence
from textwrap import wrap
from typing import Any

import numpy as np
from matplotlib.colors import to_hex
from numpy.typing import ArrayLike

from tmlattice.diagnosis.result import Diagnosis
from tmlattice.effects import find
from tmlattice.lattice import Ring
from tmlattice.lattice.survey import survey
from tmlattice.plots import plan as plan_view
from tmlattice.plots import strip as strip_view
from tmlattice.plots.diagnosis import (
    FLOOR,
    STYLES,
    around,
    clearest,
    drawable,
    free_kicks,
    gap_labels,
    middles,
    noise_rms,
    over_decades,
    thresholds,
)
from tmlattice.plots.readings import AFTER, BEFORE, models_of, parts_along, worst_shot
from tmlattice.plots.response import RESIDUALS, beta_beats, gradient_errors, step_labels
from tmlattice.report.amounts import amount_text, words
from tmlattice.speaks import micrometres

Figure = dict[str, Any]

SYMBOLS = {
    "o": "circle", "s": "square", "D": "diamond", "^": "triangle-up", "v": "triangle-down",
    "P": "cross", "X": "x",
}  # fmt: skip
"""Plotly's names of matplotlib's markers."""

MOST = 4000
"""Points of the scan that are drawn, so that the page stays quick. The picture has all."""


def figures(diagnosis: Diagnosis) -> dict[str, Figure]:
    """Figures by the name of the picture in `plots.diagnosis.figures`."""
    made: dict[str, Callable[[Diagnosis], Figure]] = {
        "plan": plan, "scan": scan, "readings": parts if diagnosis.parts else readings,
        "scan-near": scan_near, "gap": gap, "steps": steps, "gradients": gradients,
        "beta-beat": beta_beat,
    }  # fmt: skip
    names = {name for name, *_ in drawable(diagnosis)}
    return {name: figure(diagnosis) for name, figure in made.items() if name in names}


# --- parts ----------------------------------------------------------------------------------------
def _short(values: ArrayLike, digits: int = 5) -> list[float | None]:
    """Numbers rounded to so many digits; None where one is not finite."""
    return [
        float(f"{v:.{digits}g}") if np.isfinite(v) else None
        for v in np.asarray(values, dtype=float).ravel()
    ]


def as_plain(text: str) -> str:
    """Escape a text for plotly, so that it is shown literally with its lines.

    Plotly takes tags, entities and, in templates, `%{x}` for its own; `"@..."` is a colour of the
    page's style (`page.js`).
    """
    for character in "&<>%@":  # & first: the others become entities
        text = text.replace(character, f"&#{ord(character)};")
    return text.replace("\n", "<br>")


def _colour(name: str) -> str:
    return name if name.startswith("@") else str(to_hex(name))


def _trace(
    x: ArrayLike, y: ArrayLike, name: str, colour: str, *, mode: str = "lines", size: float = 1.2,
    text: Sequence[str] | None = None, hover: str = "", dash: str = "solid", marker: str = "o",
    **more: Any,
) -> Figure:  # fmt: skip
    """A line or markers; on hover a point shows its `text`, then the template `hover`."""
    style: Figure = {}
    if "lines" in mode:
        style["line"] = {"width": size, "color": _colour(colour), "dash": dash}
    if "markers" in mode:
        style["marker"] = {
            "size": 7 if style else size, "color": _colour(colour), "symbol": SYMBOLS[marker],
        }  # fmt: skip
    texts: Figure = {"hoverinfo": "skip"}
    if text is not None:
        texts = {
            "text": [as_plain(one) for one in text],
            "hovertemplate": f"%{{text}}{hover}<extra></extra>",
        }
    return {
        "type": "scatter", "x": _short(x, 6), "y": _short(y, 4), "name": as_plain(name),
        "mode": mode, **style, **texts, **more,
    }  # fmt: skip


def _axis(title: str, **more: Any) -> Figure:
    return {"title": {"text": as_plain(title)}, "automargin": True, "zeroline": False, **more}


def _layout(height: int, **axes: Any) -> Figure:
    return {
        "height": height, "margin": {"l": 10, "r": 10, "t": 30, "b": 10}, "hovermode": "closest",
        "legend": {"orientation": "h", "x": 0, "y": 1, "yanchor": "bottom",
                   "itemsizing": "constant"},
        "modebar": {"orientation": "v", "bgcolor": "rgba(0, 0, 0, 0)", "color": "#8c8c8c",
                    "activecolor": "#5c5c5c"},  # upright: next to the legend
        **axes,
    }  # fmt: skip


def _marks(diagnosis: Diagnosis) -> list[Figure]:
    """Marks of the findings, over all rows against s."""
    shapes: list[Figure] = []
    for finding in diagnosis.findings:
        ends = finding.where if finding.effect is None else (finding.s, finding.s)
        if ends is None or ends[0] is None:
            continue
        band = ends[0] != ends[1]
        shapes.append({
            "type": "rect" if band else "line", "xref": "x", "yref": "paper", "y0": 0, "y1": 1,
            "x0": ends[0], "x1": ends[1], "layer": "below",
            "line": {"color": "@culprit", "width": 0 if band else 1.2, "dash": "dot"},
            **({"fillcolor": "rgba(255,200,0,0.25)"} if band else {}),
        })  # fmt: skip
    return shapes


def strip(ring: Ring) -> list[Figure]:
    """The lattice along s, each kind one outline; on hover the name of each magnet.

    It is once in the page, and is drawn under each figure that names an axis for its `strip`.
    """
    traces = []
    widest = ring.length / 600
    for kind, colour in strip_view.COLOURS.items():
        own = [e for e in ring.elements if e.kind == kind and strip_view.shown(e)]
        if not own:
            continue
        xs: list[float | None] = []
        ys: list[float | None] = []
        for element in own:
            half = max(element.length, widest) / 2
            low, high = strip_view.extent(element)
            a, b = round(element.s - half, 2), round(element.s + half, 2)
            xs += [a, a, b, b, None]
            ys += [low, high, high, low, None]
        traces.append({
            "type": "scatter", "x": xs, "y": ys, "fill": "toself", "mode": "none",
            "fillcolor": _colour(colour), "hoverinfo": "skip", "showlegend": False,
        })  # fmt: skip
        heights = [sum(strip_view.extent(e)) / 2 for e in own]
        traces.append(
            _trace([e.s for e in own], heights, kind, colour, mode="markers", size=8, opacity=0,
                   text=[e.name for e in own], hover=f"<br>{kind}<br>s = %{{x:.2f}} m",
                   showlegend=False)
        )  # fmt: skip
    return traces


_STRIP_AXIS = {"visible": False, "range": [-1.2, 1.2], "fixedrange": True}


# --- the ring from above --------------------------------------------------------------------------
def plan(diagnosis: Diagnosis) -> Figure:
    """Magnets along the orbit, BPMs and correctors small next to it, findings marked."""
    ring, view = diagnosis.ring, survey(diagnosis.ring)
    traces = [_trace(view.ends[:, 0], view.ends[:, 1], "orbit", "@faint", showlegend=False)]
    for kind, places in plan_view.groups(diagnosis).items():
        small = kind in plan_view.SMALL
        colour = plan_view.SMALL[kind].colour if small else strip_view.COLOURS[kind]
        at = plan_view.beside(view, kind, places)
        own = [ring.elements[i] for i in places]
        trace = _trace(at[:, 0], at[:, 1], plan_view.plural(kind), colour, mode="markers",
                       size=3 if small else 4, hover=f"<br>{kind}",
                       marker=plan_view.SMALL[kind].marker if small else "o",
                       text=[f"{e.name}\ns = {e.s:.2f} m" for e in own])  # fmt: skip
        traces.append(trace)
    for number, finding, place, lines_off in plan_view.placed(diagnosis, view):
        high, side = plan_view.inwards(place, view)
        aside = "<br>\u00a0" * lines_off * (2 if high == "middle" else 1)
        name = finding.label
        traces.append({
            **_trace(place[:1], place[1:], name, "@culprit", mode="markers", size=20,
                     text=[plan_view.label(number, finding)], showlegend=False,
                     hover=f"<br>{as_plain(name)}<br>s = {_s_text(finding.s, finding.where)}"),
            "mode": "markers+text",
            "texttemplate": f"{aside[4:]}<br> %{{text}} " if aside and high == "bottom"
            else f" %{{text}} {aside}",
            "textposition": f"{high} {side}",
            "textfont": {"color": "@culprit", "size": 15},
            "marker": {"size": 20, "symbol": "circle-open", "color": "@culprit",
                       "line": {"width": 3}},
        })  # fmt: skip
    suspected = [suspect.element for suspect in diagnosis.suspects]
    if suspected:
        x, y = view.at(suspected).T
        trace = _trace(x, y, "suspects", "@amber", mode="markers", size=14,
                       text=[f"suspect: {name}" for name in suspected])  # fmt: skip
        trace["marker"]["symbol"] = "circle-open"
        traces.append(trace)
    layout = _layout(
        460, xaxis=_axis("x [m]", showgrid=False),
        yaxis=_axis("y [m]", scaleanchor="x", scaleratio=1, showgrid=False),
    )  # fmt: skip
    return {"data": traces, "layout": layout}


def _s_text(s: float | None, where: tuple[float, float] | None) -> str:
    if s is not None:
        return f"{s:.2f} m"
    return "" if where is None else f"{where[0]:.1f} to {where[1]:.1f} m"


# --- trajectories ---------------------------------------------------------------------------------
def readings(diagnosis: Diagnosis) -> Figure:
    """Residuals of each model, for the shot that the design explains worst, by BPM."""
    data, models = diagnosis.trajectories.data, models_of(diagnosis)
    monitors = diagnosis.ring.monitors
    first = slice(0, len(monitors))
    read = np.where(data.valid, data.readings, np.nan)
    shot = worst_shot(diagnosis, models[diagnosis.starting_model][0])
    s, names = zip(*((monitor.s, monitor.name) for monitor in monitors), strict=True)
    traces = []
    for plane, name in enumerate("xy"):
        for model, (predicted, colour) in models.items():
            values = 1e3 * (read - predicted)[shot, first, plane]
            traces.append(
                _trace(s, values, model, colour, text=names, showlegend=not plane,
                       hover=f"<br>s = %{{x:.2f}} m<br>{name} - {as_plain(model)}: %{{y:.4f}} mm",
                       legendgroup=model, yaxis="y2" if plane else "y")
            )  # fmt: skip
    layout = _layout(
        460, xaxis=_axis("s [m]", anchor="y3"), yaxis=_axis("residual x [mm]", domain=[0.58, 1]),
        yaxis2=_axis("residual y [mm]", domain=[0.12, 0.54]),
        yaxis3={**_STRIP_AXIS, "domain": [0, 0.08]}, shapes=_marks(diagnosis),
    )  # fmt: skip
    return {"data": traces, "layout": layout, "strip": "y3"}


def parts(diagnosis: Diagnosis) -> Figure:
    """Residuals of each measurement at each BPM in units of the noise, before and after."""
    shown = parts_along(diagnosis)
    height = 0.9 / len(shown)
    traces, axes = [], {}
    for k, (part, s) in enumerate(shown):
        axis = "y" if k == 0 else f"y{k + 1}"
        names = (diagnosis.starting_model, "with the findings")
        for model, colour, left in zip(names, (BEFORE, AFTER), part.left, strict=True):
            traces.append(
                _trace(s, left, model, colour, text=part.monitors,
                       hover=f"<br>{as_plain(part.label)}, {as_plain(model)}<br>"
                       "%{y:.3g} times the noise",
                       showlegend=not k, legendgroup=model, yaxis=axis)
            )  # fmt: skip
        top = 1 - k * height
        axes[axis.replace("y", "yaxis")] = _axis(
            f"{part.label}\nresidual / noise",
            type="log",
            dtick=1,
            domain=[top - 0.85 * height, top],
        )
    last = f"y{len(shown) + 1}"
    axes[last.replace("y", "yaxis")] = {**_STRIP_AXIS, "domain": [0, 0.06]}
    layout = _layout(120 + 180 * len(shown), xaxis=_axis("s [m]", anchor=last),
                     shapes=_marks(diagnosis), **axes)  # fmt: skip
    return {"data": traces, "layout": layout, "strip": last}


def _amount(effect: str, power_of_it: float) -> str:
    power = find(effect).power
    return amount_text(effect, float(np.sign(power_of_it) * abs(power_of_it) ** (1 / power)))


def scan(diagnosis: Diagnosis, span: tuple[float, float] | None = None) -> Figure:
    """The gain in chi-square of each hypothesis alone, before any finding (span: from and to which
    s, m: then linear, to separate neighbours)."""
    found, s = diagnosis.explanation.first, middles(diagnosis)
    low, high = span or (0.0, diagnosis.ring.length)
    drawn = np.flatnonzero((s >= low) & (s <= high) & (found.statistic > FLOOR))
    drawn = drawn[np.argsort(-found.statistic[drawn])][:MOST]
    layers, kicks = free_kicks(diagnosis)
    inside = (layers >= low) & (layers <= high)
    order_of = {group: k for k, group in enumerate(STYLES)}
    traces = [_trace(layers[inside], kicks[inside], "a free kick in each shot", "@faint")]
    by_effect: dict[str, list[int]] = {}
    for i in drawn:
        by_effect.setdefault(found.hypotheses[i][0], []).append(int(i))
    shown: set[str] = set()
    for effect, own in sorted(by_effect.items(), key=lambda item: order_of[find(item[0]).group]):
        group = find(effect).group
        colour, marker = STYLES[group]
        hover = [f"{found.hypotheses[i][1]}\n{_amount(effect, found.amount[i])}" for i in own]
        traces.append(
            _trace(s[own], found.statistic[own], group.replace("monitors", "BPMs"),
                   colour, mode="markers", size=4, marker=marker,
                   hover=f"<br>{words(effect)}<br>s = %{{x:.2f}} m<br>Δχ² %{{y}}",
                   text=hover, legendgroup=group, showlegend=group not in shown)
        )  # fmt: skip
        shown.add(group)
    named, of_kicks = thresholds(diagnosis)
    ends = [low, high]
    traces.append(_trace(ends, [named] * 2, f"threshold {named:.1f}", "@ink", dash="dash"))
    text = f"threshold of free kicks {of_kicks:.1f}"
    traces.append(_trace(ends, [of_kicks] * 2, text, "@faint", dash="dot"))
    if not inside.any():
        del traces[0], traces[-1]
    layout = _layout(
        480, xaxis=_axis("s [m]", anchor="y2"), shapes=_marks(diagnosis),
        yaxis=_axis("Δχ²", type="log", dtick=1, domain=[0.13, 1], exponentformat="power"),
        yaxis2={**_STRIP_AXIS, "domain": [0, 0.09]},
    )  # fmt: skip
    if span is not None:
        layout["xaxis"]["range"] = [low, high]
        layout["yaxis"] = _axis("Δχ²", domain=[0.13, 1], rangemode="tozero")
    return {"data": traces, "layout": layout, "strip": "y2"}


def scan_near(diagnosis: Diagnosis) -> Figure:
    """The scan around the clearest finding."""
    first = clearest(diagnosis)
    assert first is not None
    return scan(diagnosis, around(diagnosis, first))


def gap(diagnosis: Diagnosis) -> Figure:
    """The rms residual of held-out readings against the number of findings."""
    assert diagnosis.heldout is not None
    rms = [1e6 * step.rms for step in diagnosis.heldout.misfits]
    wrapped = [wrap(label, 28) for label in gap_labels(diagnosis)]
    labels = [as_plain("\n".join(lines)) for lines in wrapped]
    pitch = max(48, 10 + 17 * max(len(lines) for lines in wrapped))
    rows = list(range(len(rms)))
    noise = noise_rms(diagnosis)
    bars = {
        "type": "bar", "orientation": "h", "y": rows, "x": _short(rms), "width": 0.55,
        "marker": {"color": [_colour(BEFORE)] + [_colour(AFTER)] * (len(rms) - 1)},
        "text": [micrometres(1e-6 * value).removesuffix(" µm") for value in rms],
        "textposition": "auto",
        "hovertext": labels, "hovertemplate": "%{hovertext}<br>%{x:.3g} µm<extra></extra>",
        "showlegend": False,
    }  # fmt: skip
    line = _trace([noise, noise], [-0.5, len(rms) - 0.5], f"noise {micrometres(1e-6 * noise)}",
                  "@ink", dash="dash")  # fmt: skip
    scale = "log" if over_decades(rms) else "linear"
    layout = _layout(
        110 + pitch * len(rms),
        xaxis=_axis("held-out readings less model, rms [µm]", type=scale),
        yaxis={"tickvals": rows, "ticktext": labels, "automargin": True, "fixedrange": True,
               "range": [len(rms) - 0.4, -0.6], "zeroline": False},
    )  # fmt: skip
    return {"data": [bars, line], "layout": layout}


# --- orbit responses ------------------------------------------------------------------------------
_ONE_TWO_FIVE = [float(f"{m}e{e}") for e in range(-3, 6) for m in (1, 2, 5)]


def steps(diagnosis: Diagnosis) -> Figure:
    """Held-out rms of each step, and with the decision on each family reversed."""
    names = ["\n".join(lines) for lines in step_labels(diagnosis)]
    at = list(range(len(names)))
    traces = []
    for name, label, colour, marker in RESIDUALS:
        values = [1e6 * getattr(step, name) for step in (*diagnosis.steps, *diagnosis.families)]
        traces.append(
            _trace(values, at, label, colour, mode="markers", size=7, marker=marker,
                   text=names, hover=f"<br>{label} %{{x:.3g}} µm")
        )  # fmt: skip
        if diagnosis.families:
            fit = values[min(1, len(diagnosis.steps) - 1)]
            traces.append(_trace([fit, fit], [0, len(names) - 1], label, colour, size=0.5,
                                 showlegend=False))  # fmt: skip
    noise = 1e6 * diagnosis.gap["noise"]
    traces.append(
        _trace([noise, noise], [0, len(names) - 1], f"noise {noise:.2g} µm", "@faint", dash="dot")
    )
    layout = _layout(
        160 + 24 * len(names),
        xaxis=_axis("held-out rms [µm]", type="log", tickvals=_ONE_TWO_FIVE),
        yaxis={"tickvals": at, "ticktext": [as_plain(name) for name in names],
               "automargin": True, "zeroline": False, "autorange": "reversed"},
    )  # fmt: skip
    return {"data": traces, "layout": layout}


def gradients(diagnosis: Diagnosis) -> Figure:
    """Relative gradient error of each quadrupole, with its standard error."""
    elements, amounts, errors = zip(*gradient_errors(diagnosis), strict=True)
    hover = [f"{e.name}\n{a:+.4f} ± {sigma:.4f} %" for e, a, sigma in gradient_errors(diagnosis)]
    trace = _trace([e.s for e in elements], amounts, "gradient error", "tab:red", mode="markers",
                   size=5, text=hover, hover="<br>s = %{x:.2f} m", showlegend=False)  # fmt: skip
    trace["error_y"] = {"array": _short(errors, 3), "thickness": 1, "width": 0}
    return _above_strip(diagnosis, [trace], "gradient error [%]")


def beta_beat(diagnosis: Diagnosis) -> Figure:
    """Beta of the estimated ring relative to the design's, along the ring."""
    design, s, beats = beta_beats(diagnosis)
    ends = [*design.name, "end"]
    names = [ends[i] for i in np.searchsorted(design.s, s - 1e-9)]
    traces = []
    for plane, colour in enumerate(("C0", "C3")):
        name = "xy"[plane]
        traces.append(_trace(s, beats[:, plane], name, colour, text=names,
                             hover=f"<br>s = %{{x:.2f}} m<br>{name}: %{{y:+.3f}} %"))  # fmt: skip
    return _above_strip(diagnosis, traces, f"beta / {diagnosis.starting_model} - 1 [%]")


def _above_strip(diagnosis: Diagnosis, traces: Iterable[Figure], title: str) -> Figure:
    layout = _layout(
        340, xaxis=_axis("s [m]", anchor="y2"), yaxis=_axis(title, domain=[0.18, 1]),
        yaxis2={**_STRIP_AXIS, "domain": [0, 0.12]}, shapes=_marks(diagnosis),
    )  # fmt: skip
    return {"data": list(traces), "layout": layout, "strip": "y2"}
