"""Concealed experiments: their own equations, their own solver, nothing shared with the fitter."""
