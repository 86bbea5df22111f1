"""Periodic states, their stability, boundaries and maps: arrays in, arrays out; neither sympy nor click is imported here."""
