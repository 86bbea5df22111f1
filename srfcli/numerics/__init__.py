"""Numerics on generated models: arrays in, arrays out; neither sympy nor click is imported here."""
