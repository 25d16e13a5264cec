"""Writes xsuite_classes.json: small rings in Xsuite's classes with what xtrack finds for them.

Run with xsuite installed (the file says which version): `python tests/lattices/referee_xsuite.py`.
Each deck is a ring of eight equal cells; it names the elements in which it differs from `elements`.
"""

import json
import warnings
from pathlib import Path

import numpy as np
import xtrack as xt

warnings.simplefilter("ignore")

CELLS = 8
PHI = np.pi / 8
CELL = ["qf", "mq", "d1", "bb", "d2", "qd", "mq", "d2", "bb", "d1", "ch"]
BASE = {
    "qf": xt.Quadrupole(k1=1.1, length=0.4),
    "qd": xt.Quadrupole(k1=-1.15, length=0.4),
    "bb": xt.Bend(angle=PHI, length=1.0),
    "mq": xt.Marker(),
    "ch": xt.Multipole(),
    "d1": xt.Drift(length=0.5),
    "d2": xt.Drift(length=0.9),
}
PARTICLE = {"mass0": xt.ELECTRON_MASS_EV, "q0": -1.0, "energy0": 3e9}
EDGE = {f"edge_{side}_{key}": value for side in ("entry", "exit")
        for key, value in (("angle", 0.1), ("hgap", 0.03), ("fint", 0.5))}  # fmt: skip
THIN_BENDS = ["qf", "mq", "d1", "tb", "d2", "qd", "mq", "d2", "tb", "d1", "ch"]
FACES = ["qf", "mq", "d1", "e", "bb", "e", "d2", "qd", "mq", "d2", "bb", "d1", "ch"]
MAP = np.eye(6)
MAP[0, 1] = MAP[2, 3] = 0.1
MAP[1, 0], MAP[1, 1], MAP[3, 2], MAP[3, 3] = -0.02, 0.998, 0.02, 1.002


def bend(**values):
    """The base ring's bend with more fields."""
    return {"bb": xt.Bend(**{"angle": PHI, "length": 1.0, **values})}


def rbend(**values):
    """A rectangular bend in its place."""
    return {"bb": xt.RBend(**{"angle": PHI, "length_straight": 1.0, **values})}


def quadrupole(**values):
    """The base ring's focusing quadrupole with more fields."""
    return {"qf": xt.Quadrupole(**{"k1": 1.1, "length": 0.4, **values})}


DECKS = {
    "base": {},
    "bend_edges": bend(**EDGE),
    "bend_edges_full": bend(**EDGE, edge_entry_model="full", edge_exit_model="full"),
    "bend_edges_off": bend(**EDGE, edge_entry_active=0, edge_exit_model="suppressed"),
    "bend_unequal_gaps": bend(**{**EDGE, "edge_exit_hgap": 0.01, "edge_exit_fint": 0.7}),
    "bend_feed_down": bend(**EDGE, edge_entry_angle_fdown=0.05, edge_exit_angle_fdown=0.02),
    "bend_k0": bend(k0=PHI * 1.001),
    "bend_k0_edges": bend(k0=PHI * 1.001, **EDGE),
    "bend_shift": bend(shift_x=1e-5, shift_y=2e-5, k1=-0.05),
    "bend_shift_anchor": {"ch": xt.Bend(length=0.2, angle=0.05, shift_x=1e-4, shift_s=1e-3,
                                        rot_s_rad=0.4, rot_shift_anchor=0.2)},
    "bend_roll": bend(rot_s_rad_no_frame=1e-3),
    "bend_corrector": {"ch": xt.Bend(length=0.2, k0=1e-3)},
    "bend_knl": bend(knl=[1e-4, 0.02, 0.1], ksl=[2e-4, 0.01]),
    "bend_knl_rel": bend(knl_rel=[1e-4, 0.1], ksl_rel=[0, 0.01]),
    "bend_tilt": bend(rot_s_rad=0.01),
    "rbend": rbend(),
    "rbend_negative": rbend(angle=-PHI),
    "rbend_k1": rbend(k1=0.1, edge_entry_angle=0.02),
    "rbend_k0": rbend(k0=2 * np.sin(PHI / 2) * 1.001),
    "rbend_straight": rbend(rbend_model="straight-body"),
    "rbend_angle_diff": rbend(rbend_angle_diff=0.1),
    "rbend_suppressed": rbend(edge_entry_model="suppressed", edge_exit_model="suppressed"),
    "quadrupole_k1s": quadrupole(k1s=0.05),
    "quadrupole_knl": quadrupole(k1=1.0, knl=[1e-4, 0.04, 0.1], ksl=[2e-4, 0.01]),
    "quadrupole_knl_rel": quadrupole(k1=1.0, knl_rel=[1e-4, 0.1], ksl_rel=[0, 0.01]),
    "quadrupole_shift": quadrupole(shift_x=1e-4, shift_y=-2e-4),
    "quadrupole_shift_s": quadrupole(shift_s=0.01),
    "quadrupole_tilt": quadrupole(rot_s_rad=0.05),
    "quadrupole_roll": quadrupole(rot_s_rad_no_frame=0.05),
    "quadrupole_edges": quadrupole(edge_entry_active=1, edge_exit_active=1),
    "quadrupole_one_kick": quadrupole(
        model="drift-kick-drift-expanded", integrator="uniform", num_multipole_kicks=1
    ),
    "quadrupole_teapot": quadrupole(
        model="drift-kick-drift-exact", integrator="teapot", num_multipole_kicks=3
    ),
    "magnet": {"qf": xt.Magnet(k1=1.1, length=0.4)},
    "magnet_bend": {
        "bb": xt.Magnet(angle=PHI, length=1.0, k1=0.05, edge_entry_angle=0.1, edge_exit_angle=0.05)
    },
    "magnet_straight_faces": {
        "ch": xt.Magnet(length=0.2, k0=1e-3, k1=0.1, edge_entry_angle=0.1, edge_exit_angle=0.1)
    },
    "magnet_corrector": {"ch": xt.Magnet(k0=1e-3, k0s=2e-3, length=0.1)},
    "sextupole": {"ch": xt.Sextupole(k2=2.0, length=0.2, shift_x=1e-3, knl=[1e-5])},
    "octupole": {"ch": xt.Octupole(k3=20.0, length=0.2, knl=[0, 0.01])},
    "multipole_kick": {"ch": xt.Multipole(knl=[1e-4], ksl=[2e-4], length=0.3)},
    "multipole_thick": {"ch": xt.Multipole(knl=[0, 0.05], ksl=[1e-4], length=0.1, isthick=True)},
    "replica": {"qf": xt.Quadrupole(k1=1.1, length=0.4), "q2": xt.Replica("qf"),
                "cell": ["q2", *CELL[1:]]},
    "thin_bend": {"tb": xt.Multipole(knl=[PHI], hxl=PHI, length=1.0), "cell": THIN_BENDS},
    "thin_bend_error": {"tb": xt.Multipole(knl=[PHI + 1e-4], hxl=PHI), "cell": THIN_BENDS},
    "thin_bend_k1": {"tb": xt.Multipole(knl=[PHI, 0.05], hxl=PHI), "cell": THIN_BENDS},
    "simple_thin_bend": {"tb": xt.SimpleThinBend(knl=[PHI], hxl=PHI), "cell": THIN_BENDS},
    "simple_thin_quadrupole": {"tq": xt.SimpleThinQuadrupole(knl=[0, 0.44]),
                               "cell": ["tq", *CELL[1:]]},
    "dipole_edge": {"e": xt.DipoleEdge(k=PHI, e1=0.1, hgap=0.02, fint=0.6), "cell": FACES},
    "dipole_edge_feed_down": {"e": xt.DipoleEdge(k=PHI, e1=0.1, e1_fd=0.03), "cell": FACES},
    "cavity": {"rf": xt.Cavity(voltage=1e5, frequency=5e8, length=0.2)},
    "cavity_harmonic": {"rf": xt.Cavity(voltage=1e5, harmonic=80)},
    "cavity_off": {"rf": xt.Cavity()},
    "uniform_solenoid": {"so": xt.UniformSolenoid(ks=0.2, length=0.3)},
    "solenoid": {"so": xt.Solenoid(ks=0.2, length=0.3)},
    "variable_solenoid": {"so": xt.VariableSolenoid(ks_profile=[0.1, 0.3], length=0.3)},
    "s_rotation": {"ro": xt.SRotation(angle=1.5)},
    "rotation": {"ro": xt.Rotation(rot_s_rad=0.03)},
    "xy_shift": {"xy": xt.XYShift(dx=1e-4, dy=2e-4)},
    "translation": {"xy": xt.Translation(shift_x=1e-4, shift_y=2e-4)},
    "first_order_map": {"ma": xt.FirstOrderTaylorMap(
        length=0.1, m0=[0, 1e-5, 0, 2e-5, 0, 0], m1=MAP)},
    "apertures": {"la": xt.LimitEllipse(a=0.03, b=0.02), "lb": xt.LimitRect(min_x=-0.1),
                  "dx": xt.DriftExact(length=0.1), "zs": xt.ZetaShift(dzeta=1e-3)},
}  # fmt: skip
REFUSED = {
    "straight_body_gradient": rbend(k1=0.1, rbend_model="straight-body"),
    "quadrupole_yaw": quadrupole(rot_y_rad=1e-3),
    "solenoid_shift": {"so": xt.UniformSolenoid(ks=0.2, length=0.3, x0=1e-3)},
    "line_segment": {"ls": xt.LineSegmentMap(length=1.0, qx=0.1, qy=0.2, betx=1.0, bety=1.0)},
    "energy_increase": {"up": xt.ReferenceEnergyIncrease(Delta_p0c=1e6)},
    "y_rotation": {"ro": xt.YRotation(angle=0.5)},
    "wire": {"wi": xt.Wire(current=100.0, L_phy=1.0, L_int=2.0, xma=0.01, yma=0.0)},
    "rf_multipole": {"rm": xt.RFMultipole(knl=[0, 0.1], frequency=4e8)},
}


def ring(changes, slicing=None):
    """The environment and the ring of a deck."""
    changes = dict(changes)
    cell = changes.pop("cell", None)
    env = xt.Environment()
    for name, element in {**BASE, **changes}.items():
        env.elements[name] = element.copy()
    if cell is None:
        cell = [*CELL, *(name for name in changes if name not in BASE)]
    if slicing:
        one = env.new_line(components=cell)
        one.slice_thick_elements(slicing_strategies=[xt.Strategy(slicing)])
        cell = list(one.element_names)
    line = env.new_line(components=cell * CELLS)
    line.particle_ref = xt.Particles(**PARTICLE)
    return env, line, cell


def deck(changes, slicing=None, figures=True):
    """A deck as data, with what xtrack finds for it."""
    env, line, cell = ring(changes, slicing)
    own = {}
    for name in dict.fromkeys(cell):
        content = json.loads(json.dumps(env.elements.get(name).to_dict(), cls=xt.json.JEncoder))
        if content != base_elements().get(name):
            own[name] = content
    for name in [e["parent_name"] for e in own.values() if "parent_name" in e]:
        own.setdefault(name, env.elements.get(name).to_dict())
    out = {"elements": own, "cell": cell if cell != CELL else None}
    if figures:
        twiss = line.twiss(method="4d")
        out |= {
            "length": line.get_length(),
            "tunes": [twiss.qx, twiss.qy],
            "orbit": [float(np.abs(twiss.x).max()), float(np.abs(twiss.y).max())],
            "momentum_compaction": twiss.momentum_compaction_factor,
        }
    return {key: value for key, value in out.items() if value is not None}


def base_elements():
    """The elements that decks share."""
    return {n: json.loads(json.dumps(e.to_dict(), cls=xt.json.JEncoder)) for n, e in BASE.items()}


def composed():
    """An environment as xtrack writes it, with a line whose elements have positions."""
    env = xt.Environment()
    for name, element in BASE.items():
        env.elements[name] = element.copy()
    env["at_qd"] = 3.1
    cell = env.new_line(name="cell", compose=True, length=5.6)
    cell.place("qf", at=0.0, anchor="start")
    cell.place("mq")
    cell.place("bb", at=0.5, from_="mq@end", anchor="start")
    cell.place("qd", at="at_qd - 0.1", anchor="center")
    cell.place("mq", at="qd@end")
    cell.place("bb", at=4.6)
    cell.place("ch", at=5.6)
    line = env.new_line(name="ring", components=["cell"] * CELLS, compose=True)
    env.particle_ref = xt.Particles(**PARTICLE)
    content = json.loads(json.dumps(env.to_dict(), cls=xt.json.JEncoder))
    line.end_compose()
    line.particle_ref = env.particle_ref
    twiss = line.twiss(method="4d")
    for part in content["lines"].values():
        part.pop("_extra_config")
        part.pop("config")
    kept = {k: content["particle_ref"][k] for k in ("mass0", "q0", "p0c", "gamma0", "beta0")}
    return {"file": {**content, "particle_ref": kept}, "length": line.get_length(),
            "tunes": [twiss.qx, twiss.qy]}  # fmt: skip


def main():
    """Write the decks."""
    decks = {name: deck(changes) for name, changes in DECKS.items()}
    for base in ("base", "bend_edges", "rbend_k1", "uniform_solenoid", "cavity", "quadrupole_knl"):
        decks[f"{base}_thick_slices"] = deck(DECKS[base], xt.Uniform(3, mode="thick"))
        if "solenoid" not in base:
            decks[f"{base}_thin_slices"] = deck(DECKS[base], xt.Teapot(3))
    particle = xt.Particles(**PARTICLE)
    content = {
        "versions": {"xtrack": xt.__version__},
        "particle": {"mass0": particle.mass0, "q0": particle.q0, "p0c": particle.p0c.tolist()},
        "elements": base_elements(),
        "cell": CELL,
        "cells": CELLS,
        "decks": decks,
        "refused": {name: deck(changes, figures=False) for name, changes in REFUSED.items()},
        "composed": composed(),
    }
    path = Path(__file__).with_name("xsuite_classes.json")
    text = json.dumps(content, cls=xt.json.JEncoder, sort_keys=True, separators=(",", ":"))
    path.write_text(text.replace('},"', '},\n"') + "\n")


if __name__ == "__main__":
    main()
