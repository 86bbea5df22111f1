"""srf: state-and-rate friction, from a law to its stability boundary."""

__version__ = "0.1.0"
