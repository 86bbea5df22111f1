"""Numerical outcomes: a failure is a value whose text is advice."""

from __future__ import annotations

from enum import Enum


class Status(Enum):
    """How a numerical result ended; `advice` is a sentence with a way out."""

    OK = "ok"
    NO_CONVERGENCE = "no-convergence"
    TOLERANCE = "tolerance-not-met"
    MAX_STEPS = "max-steps"
    STEP_TOO_SMALL = "step-too-small"
    LEFT_WINDOW = "left-window"
    CLOSED = "closed"
    NO_HOPF = "no-hopf"
    UNSETTLED = "window-not-settled"
    INTEGRATION = "integration-stopped"
    EVALUATIONS = "max-evaluations"
    INTERRUPTED = "interrupted"

    @property
    def advice(self) -> str:
        """Return one sentence that says what happened and what to try."""
        return _ADVICE[self]

    @property
    def ok(self) -> bool:
        """True where the numbers can be used as they stand."""
        return self in (Status.OK, Status.LEFT_WINDOW, Status.CLOSED)


_ADVICE = {
    Status.OK: "Converged.",
    Status.NO_CONVERGENCE: "Newton's method did not converge; start nearer, or raise --max-mesh or lower eps first.",
    Status.TOLERANCE: "The estimated error is above the tolerance on the finest mesh allowed; raise --max-mesh.",
    Status.MAX_STEPS: "The curve was cut at the step limit; raise --max-steps.",
    Status.STEP_TOO_SMALL: "The step along the curve fell below its minimum; a singular point is near.",
    Status.LEFT_WINDOW: "The curve left the window that was asked for.",
    Status.CLOSED: "The curve returned to its start.",
    Status.NO_HOPF: "Velocity strengthening: no Hopf bifurcation.",
    Status.UNSETTLED: "Crossings may lie beyond the loads looked at; look there with --window LOW:HIGH or --over W0=LOW:HIGH.",
    Status.INTEGRATION: "Time integration stopped before the end of the record; look at the motion there, or loosen rtol.",
    Status.EVALUATIONS: "The fit was cut at its limit of evaluations; raise --max-evaluations, or start nearer.",
    Status.INTERRUPTED: "what was finished is kept.",
}
