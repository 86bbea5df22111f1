"""Laws are values: frozen, stateless, comparable; their formulas are sympy expressions in named symbols."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # sympy costs a third of a second and a listing needs none of it
    import sympy


@dataclass(frozen=True)
class Parameter:
    """A number that a law or a system depends on, in the unit it is declared in; bounds are inclusive."""

    name: str
    default: float
    unit: str = "1"
    lower: float = -math.inf
    upper: float = math.inf
    about: str = ""


@dataclass(frozen=True)
class State:
    """A state variable of age type: its symbol, its characteristic slip length and its weight in mu (parameter names)."""

    name: str = "phi"
    length: str = "D0"
    weight: str = "B"


@dataclass(frozen=True)
class Check:
    """A worked value by which a law tests itself: `quantity` at the symbol values `at` equals `value`."""

    quantity: str
    at: tuple[tuple[str, float], ...]
    value: float
    rtol: float = 1e-9


@dataclass(frozen=True)
class Law:
    """What every law has: a name, parameters in declared units, prose, references, worked values and an origin."""

    name: str
    parameters: tuple[Parameter, ...] = ()
    about: str = ""
    cites: tuple[str, ...] = ()
    checks: tuple[Check, ...] = ()
    source: str = field(default="", compare=False)


@dataclass(frozen=True)
class FrictionLaw(Law):
    """mu(v, phi...): the friction coefficient as a function of slip velocity, state variables and parameters."""

    mu: sympy.Expr = None
    states: tuple[State, ...] = (State(),)


@dataclass(frozen=True)
class AgeingLaw(Law):
    """phi' = rate, written for one state `phi` of length `D0` and weight `B`; applied to each state of the friction law.

    Symbols: v, phi, mu, mu_dot (dmu/dt), W, W_dot, F_dot_over_W (d(W mu)/dt / W), and the parameters, also the friction law's.
    """

    rate: sympy.Expr = None


@dataclass(frozen=True)
class AgeingModifier(Law):
    """A term that is added to the rate of any ageing law, in the same symbols."""

    term: sympy.Expr = None


@dataclass(frozen=True)
class Interface(Law):
    """The shear stiffness kappa of the interface as a function of W and parameters; None for a rigid one."""

    kappa: sympy.Expr | None = None
