"""Recordings: how an experiment is described, read, checked and written; arrays in um, s, N."""
