"""srf: state-and-rate friction, from a law to its stability boundary."""

__version__ = "0.1.0"
FORMAT = 29  # of the generated modules: raise it when their text changes, so that cached ones are built anew
