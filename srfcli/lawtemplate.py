"""The files that `srf law new` writes: each a whole, commented law that passes `srf law check` as it stands."""

from __future__ import annotations

from string import Template

TOML = {
    "friction": """\
format = "srf-law/1"
kind = "friction"
name = "$name"
about = "One line for `srf laws`"
cites = ["Author, Title, Journal volume, page (year)"]

# mu is a formula in v (um/s), phi (s) and the parameters below: + - * / **, brackets,
# exp log log1p expm1 sqrt sinh cosh tanh asinh atan lambertw.
mu = "mu0 + A*log(v/V0) + B*log(1 + Vsat*phi/D0)"

# Each state has a slip length and a weight in mu. For a second one, uncomment, declare B2 and D2, use phi2 in mu.
# states = [
#   { name = "phi", length = "D0", weight = "B" },
#   { name = "phi2", length = "D2", weight = "B2" },
# ]

# Every parameter has a default; unit, bounds and about help whoever uses it. Ageing laws may name mu0, A, B, D0, V0.
[parameters]
mu0 = { default = 0.33, unit = "1", about = "friction coefficient at v = V0 of fresh contacts" }
A = { default = 0.0126, unit = "1", bounds = [0.0, 1.0], about = "direct effect of velocity" }
B = { default = 0.0241, unit = "1", bounds = [0.0, 1.0], about = "effect of age" }
D0 = { default = 0.402, unit = "um", lower = 1e-6, about = "slip length over which contacts are renewed" }
V0 = { default = 1.0, unit = "um/s", lower = 1e-12, about = "reference velocity" }
Vsat = { default = 256.0, unit = "um/s", lower = 0.0, about = "velocity beyond which age no longer counts" }

# A value worked out by hand: `srf law check` compares.
[[checks]]
quantity = "mu"
at = { v = 1.0, phi = 0.0, D0 = 0.5, mu0 = 0.3 }
value = 0.3
""",
    "ageing": """\
format = "srf-law/1"
kind = "ageing"
name = "$name"
about = "One line for `srf laws`"
cites = ["Author, Title, Journal volume, page (year)"]

# d(phi)/dt is a formula in v (um/s), phi (s), mu, mu_dot, W (N), W_dot, F_dot_over_W, in the friction law's
# mu0, A, B, D0, V0 and in the parameters below. It must fall through zero at one phi for every v.
rate = "1 - (v*phi/D0)**n"

[parameters]
n = { default = 1.0, unit = "1", bounds = [0.1, 10.0], about = "sharpness of renewal" }

# A value worked out by hand: `srf law check` compares.
[[checks]]
quantity = "rate"
at = { v = 2.0, phi = 0.1, D0 = 0.4, n = 2.0 }
value = 0.75
""",
    "modifier": """\
format = "srf-law/1"
kind = "modifier"
name = "$name"
about = "One line for `srf laws`"
cites = ["Author, Title, Journal volume, page (year)"]

# A term that is added to the rate of an ageing law, as in --ageing dieterich+$name. Same names as in an ageing law.
term = "-alpha*phi*W_dot/W"

[parameters]
alpha = { default = 0.2, unit = "1", bounds = [0.0, 1.0], about = "weight of the load's rate" }

# A value worked out by hand: `srf law check` compares.
[[checks]]
quantity = "term"
at = { phi = 2.0, W = 10.0, W_dot = -5.0, alpha = 0.3 }
value = 0.3
""",
    "interface": """\
format = "srf-law/1"
kind = "interface"
name = "$name"
about = "One line for `srf laws`"
cites = ["Author, Title, Journal volume, page (year)"]

# The shear stiffness in N/um, a formula in W (N) and the parameters below. Without this line the interface is rigid.
kappa = "W/lambda"

[parameters]
lambda = { default = 0.56, unit = "um", lower = 1e-6, about = "elastic length" }

# A value worked out by hand: `srf law check` compares.
[[checks]]
quantity = "kappa"
at = { W = 10.0, lambda = 0.5 }
value = 20.0
""",
    "effect": """\
format = "srf-law/1"
kind = "effect"
name = "$name"
about = "One line for `srf laws`"
cites = ["Author, Title, Journal volume, page (year)"]

# An effect is physics that a baseline may lack. Give a formula for one or more of
#   mu     friction coefficient
#   rate   of ageing, d(phi)/dt
#   kappa  shear stiffness of the interface, N/um
#   W      load on the asperities, N
#   force  on the slider along the track, N, with the drive
#   V      velocity of the stage, um/s
# in which the slot's own name is what was there before. A formula may hold v, phi, mu, mu_dot, W, W_dot, F_dot_over_W,
# the friction law's mu0, A, B, D0, V0, slip (um from where the track begins), stage (um), time (s), u (um), W0, K, V,
# of a modulated load theta (its phase), envelope (0 to 1), eps, f, modulated (1 or 0), and the parameters below.
rate = "rate + v*phi/D0 - (v*phi/D0)**n"

# `neutral` is the value at which the model is the baseline. Any other parameter is an inner one, which shows only where
# the size is not neutral: a diagnosis tries `scan` values of it. Bounds are those of a fit.
[parameters]
n = { default = 1.2, neutral = 1.0, unit = "1", bounds = [0.3, 3.0], about = "sharpness of renewal" }

# Numbers with a unit, which are never fitted.
# [constants]
# Wref = { value = 7.0, unit = "N", about = "reference load" }
""",
}

_HEAD = '''\
"""One line about this plugin."""

from srfcli.api import $imports

'''

PYTHON = {
    "friction": _HEAD.replace("$imports", "Check, Parameter, friction_law, log")
    + '''
@friction_law(
    name="$name",
    about="One line for `srf laws`",
    cites=["Author, Title, Journal volume, page (year)"],
    parameters=[
        Parameter("mu0", 0.33, about="friction coefficient at v = V0 of fresh contacts"),
        Parameter("A", 0.0126, lower=0.0, upper=1.0, about="direct effect of velocity"),
        Parameter("B", 0.0241, lower=0.0, upper=1.0, about="effect of age"),
        Parameter("D0", 0.402, "um", lower=1e-6, about="slip length over which contacts are renewed"),
        Parameter("V0", 1.0, "um/s", lower=1e-12, about="reference velocity"),
        Parameter("Vsat", 256.0, "um/s", lower=0.0, about="velocity beyond which age no longer counts"),
    ],
    checks=[Check("mu", (("v", 1.0), ("phi", 0.0), ("D0", 0.5), ("mu0", 0.3)), 0.3)],
)
def $function(v, phi, p):
    """Called once, with symbols: v in um/s, phi in s, p holds the parameters."""
    return p.mu0 + p.A * log(v / p.V0) + p.B * log(1 + p.Vsat * phi / p.D0)
''',
    "ageing": _HEAD.replace("$imports", "Check, Parameter, ageing_law")
    + '''
@ageing_law(
    name="$name",
    about="One line for `srf laws`",
    cites=["Author, Title, Journal volume, page (year)"],
    parameters=[Parameter("n", 1.0, lower=0.1, upper=10.0, about="sharpness of renewal")],
    checks=[Check("rate", (("v", 2.0), ("phi", 0.1), ("D0", 0.4), ("n", 2.0)), 0.75)],
)
def $function(v, phi, p):
    """Called once, with symbols; may also take mu, mu_dot, W, W_dot, F_dot_over_W. p has mu0, A, B, D0, V0 too."""
    return 1 - (v * phi / p.D0) ** p.n
''',
    "modifier": _HEAD.replace("$imports", "Check, Parameter, modifier")
    + '''
@modifier(
    name="$name",
    about="One line for `srf laws`",
    cites=["Author, Title, Journal volume, page (year)"],
    parameters=[Parameter("alpha", 0.2, lower=0.0, upper=1.0, about="weight of the load's rate")],
    checks=[Check("term", (("phi", 2.0), ("W", 10.0), ("W_dot", -5.0), ("alpha", 0.3)), 0.3)],
)
def $function(phi, W, W_dot, p):
    """Called once, with symbols; the term is added to the rate of the ageing law it is combined with."""
    return -p.alpha * phi * W_dot / W
''',
    "interface": _HEAD.replace("$imports", "Check, Parameter, interface")
    + '''
@interface(
    name="$name",
    about="One line for `srf laws`",
    cites=["Author, Title, Journal volume, page (year)"],
    parameters=[Parameter("lambda", 0.56, "um", lower=1e-6, about="elastic length")],
    checks=[Check("kappa", (("W", 10.0), ("lambda", 0.5)), 20.0)],
)
def $function(W, p):
    """Called once, with symbols: W in N; the stiffness is in N/um. p["lambda"], since lambda is a Python keyword."""
    return W / p["lambda"]
''',
    "effect": _HEAD.replace("$imports", "Parameter, effect")
    + '''
@effect(
    name="$name",
    about="One line for `srf laws`",
    cites=["Author, Title, Journal volume, page (year)"],
    parameters=[Parameter("n", 1.2, lower=0.3, upper=3.0, about="sharpness of renewal")],
    neutral={"n": 1.0},
)
def $function(rate, v, phi, p):
    """Called once, with symbols; what is returned for mu, rate, kappa, W, force or V takes the place of what was there."""
    worn = v * phi / p.D0
    return {"rate": rate + worn - worn**p.n}
''',
}


def template(kind: str, name: str, *, python: bool) -> str:
    """Return the text of a new law file."""
    function = "law_" + name.replace("-", "_")  # a law's name may begin with a digit or be a keyword
    return Template((PYTHON if python else TOML)[kind]).substitute(name=name, function=function)
