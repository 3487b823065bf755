"""The method of the paper: its signals and objective, which the genetic search minimises, and its localizer.

Everything else in `design` is built on exact signals and expected errors instead.
"""
