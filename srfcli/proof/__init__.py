"""Concealed experiments for proving the diagnosis: their own equations, their own solver, nothing shared with the fitter."""
