"""Sound files of each kind that the parsers read, small, from which damaged ones are made."""

from __future__ import annotations


def recording(rows: int) -> str:
    """A recording of so many rows, as CSV."""
    head = "time [s],load_point_velocity [um/s],normal_load [N],elongation [um]\n"
    return head + "".join(f"{i / 100},10.0,5.0,{10 + 0.01 * (i % 7)}\n" for i in range(rows))


EXPERIMENT = """format = "srf-experiment/1"
title = "their own"
[apparatus]
stiffness = "0.21 N/um"
mass = "2.37 kg"
[model]
law = "srf-vsat"
ageing = "dieterich"
[parameters]
mu0 = { value = 0.33, lower = 0.1, upper = 1.0 }
[columns]
elongation = { name = "elongation", unit = "um", scale = 1.0, offset = 0.0 }
[[runs]]
name = "one"
file = "one.csv"
window = [0.0, 1.5]
drive = [{ duration = 1.0, velocity = 10.0 }, { duration = 1.0, velocity = 20.0 }]
modulation = { frequency = 12.0, amplitude = 0.09, onset = 2.0 }
"""
SETTINGS = '[parameters]\nA = 0.01\nK = "0.21 N/um"\n[defaults]\nlaw = "srf-vsat"\ninertia = true\ntol = 1e-6\n'
THRESHOLDS = "# measured\nV [um/s],eps [%],W0c [N],sigma [N]\n10,0,7.80,0.23\n50,20.9,23.5,\n"
