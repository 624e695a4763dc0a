"""Measuring: errors, bias and speed of renders, references, sweeps and what they show.

Needs the extra ``[measure]``. Nothing but the command imports it (see `cli.measuring`).
"""
